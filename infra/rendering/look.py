"""How pictures are shown to people: how bright, by which curve, how large; EXR is for measuring.

The film-like curve is the Academy's ACES 2.0 output transform for screens of 100 nits, as
OpenColorIO carries it: highlights roll off and lose colour instead of being clipped.
"""

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from storage.conventions import preview_srgb8
from storage.errors import TrilightError

ToneMap = Literal["plain", "filmic"]

SHOWN_PX = 256
"""Narrower pictures are enlarged to this width or more, by a whole number."""

_CONFIG = "cg-config-v4.0.0_aces-v2.0_ocio-v2.5"
"""One of the configurations that OpenColorIO has built in, by version: pictures stay the same."""
_OURS = "Linear Rec.709 (sRGB)"
_DISPLAY = "sRGB - Display"
_VIEW = "ACES 2.0 - SDR 100 nits (Rec.709)"


@dataclass(frozen=True, kw_only=True)
class Look:
    """How the user wants to see pictures.

    Raises:
        TrilightError: the tone map needs a library that is not installed.
    """

    tone_map: ToneMap = "plain"
    """Curve from radiance to what a screen shows."""
    exposure_ev: float = 0.0
    """Stops by which radiance is brightened before: each doubles it."""

    def __post_init__(self) -> None:
        if self.tone_map == "filmic":
            _filmic()


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


def tone_mapped(radiance_rgb: NDArray[np.float32], tone_map: ToneMap) -> NDArray[np.uint8]:
    """Return a picture [H, W, 3] for people, sRGB-encoded, of linear radiance of at least 0.

    `plain` is storage.conventions.preview_srgb8. `filmic` shows a radiance of 0.18 as middle grey
    (about a tenth of the screen's light), and 1 at about half of it.
    """
    if tone_map == "plain":
        return preview_srgb8(radiance_rgb)
    pixels = np.ascontiguousarray(radiance_rgb, np.float32).copy()
    _filmic().applyRGB(pixels)
    return np.round(255 * np.clip(pixels, 0, 1)).astype(np.uint8)


@functools.cache
def _filmic() -> Any:
    try:
        import PyOpenColorIO as ocio
    except ImportError as error:
        raise TrilightError(
            "--tone-map is filmic, and OpenColorIO is not installed; expected it: "
            "pip install opencolorio, or make setup-all."
        ) from error
    config = ocio.Config.CreateFromBuiltinConfig(_CONFIG)
    transform = ocio.DisplayViewTransform(src=_OURS, display=_DISPLAY, view=_VIEW)
    return config.getProcessor(transform).getDefaultCPUProcessor()
