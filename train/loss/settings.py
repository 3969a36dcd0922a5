"""What a run minimises."""

from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within

Perceptual = Literal["lpips", "ms_ssim", "none"]
"""`lpips` is the recipe's and needs published weights; `ms_ssim` needs none and is another term."""


@checked("train settings")
class LossSettings:
    """Terms of the loss (Zeng et al. 2025, section 4) and how views are weighed."""

    perceptual: Perceptual
    """The second term, on tone-mapped pictures."""
    perceptual_weight: Annotated[float, Within(0, 1000)] = 0.05
    """Its factor beside the first term, the L1 error of log10(1 + radiance)."""
    noise_half: Annotated[float, Within(0, 10)] = 0.0
    """Root mean square noise of log10(1 + radiance) at which a view counts half; 0 weighs none."""
