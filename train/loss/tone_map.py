"""The tone map of everything perceptual: clamp(log2(1 + I), 0, 1) (Zeng et al. 2025, section 4)."""

import math

from torch import Tensor

LOG10_OF_2 = math.log10(2.0)


def tone_mapped(log10_rgb: Tensor) -> Tensor:
    """Return log10(1 + radiance), any shape, as clamp(log2(1 + radiance), 0, 1).

    Radiance above 1 is white and has no gradient here; the L1 term sees it. `preview_srgb8` of
    storage.conventions is the same curve, sRGB-encoded for people.
    """
    return (log10_rgb / LOG10_OF_2).clamp(0.0, 1.0)
