"""How pictures are shown to people: how bright, by which curve, how large; EXR is for measuring."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.rendering.tone_maps import ToneMap, tone_mapped

SHOWN_PX = 256
"""Narrower pictures are enlarged to this width or more, by a whole number."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What the user chose."""

    tone_map: ToneMap = "plain"
    """Curve from radiance to what a screen shows."""
    exposure_ev: float = 0.0
    """Stops by which radiance is brightened before: each doubles it."""


def shown(radiance_rgb: NDArray[np.float32], look: Look) -> NDArray[np.uint8]:
    """Return what a person sees of linear radiance [R, R, 3], enlarged as `enlarged` does."""
    exposed = radiance_rgb * np.float32(2.0**look.exposure_ev)
    return enlarged(tone_mapped(exposed, look.tone_map))


def enlargement(width: int) -> int:
    """Return how many pixels of the screen, each way, stand for a pixel of such a picture."""
    return -(-SHOWN_PX // width)


def enlarged(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture [R, R, 3] in which each pixel is a square; as it is from SHOWN_PX on."""
    factor = enlargement(len(pixels))
    return pixels.repeat(factor, axis=0).repeat(factor, axis=1)
