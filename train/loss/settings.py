"""What a run minimises."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from storage.errors import TrilightError
from storage.ranges import Within, check_ranges

Perceptual = Literal["lpips", "ms_ssim", "none"]
"""`lpips` is the recipe's and needs published weights; `ms_ssim` needs none and is another term."""


@dataclass(frozen=True, kw_only=True)
class LossSettings:
    """Terms of the loss (Zeng et al. 2025, section 4) and how views are weighed."""

    perceptual: Perceptual
    """The second term, on tone-mapped pictures."""
    perceptual_weight: Annotated[float, Within(0, 1000)] = 0.05
    """Its factor beside the first term, the L1 error of log10(1 + radiance)."""
    noise_half: Annotated[float, Within(0, 10)] = 0.0
    """Root mean square noise of log10(1 + radiance) at which a view counts half; 0 weighs none."""

    def __post_init__(self) -> None:
        check_ranges(self, "train settings: ")
        if self.perceptual not in get_args(Perceptual):
            raise TrilightError(
                f"train settings: perceptual is {self.perceptual!r}; expected lpips, ms_ssim or "
                "none."
            )
