"""What a run minimises."""

from dataclasses import dataclass
from typing import Literal, get_args

from storage.errors import TrilightError

Perceptual = Literal["lpips", "ms_ssim", "none"]
"""`lpips` is the recipe's and needs published weights; `ms_ssim` needs none and is another term."""


@dataclass(frozen=True, kw_only=True)
class LossSettings:
    """Terms of the loss (Zeng et al. 2025, section 4) and how views are weighed."""

    perceptual: Perceptual
    """The second term, on tone-mapped pictures."""
    perceptual_weight: float = 0.05
    """Its factor beside the first term, the L1 error of log10(1 + radiance)."""
    noise_half: float = 0.0
    """Root mean square noise of log10(1 + radiance) at which a view counts half; 0 weighs none."""

    def __post_init__(self) -> None:
        for name, got, expected, right in (
            ("perceptual", self.perceptual, "lpips, ms_ssim or none", self._is_known),
            (
                "perceptual_weight",
                self.perceptual_weight,
                "at least 0",
                self.perceptual_weight >= 0,
            ),
            ("noise_half", self.noise_half, "at least 0", self.noise_half >= 0),
        ):
            if not right:
                raise TrilightError(f"train settings: {name} is {got!r}; expected {expected}.")

    @property
    def _is_known(self) -> bool:
        return self.perceptual in get_args(Perceptual)
