"""Display of pictures for people: exposure, tone mapping and enlargement; EXR is for measuring.

The filmic curve is the Academy's ACES 2.0 output transform for screens of 100 nits from
OpenColorIO: highlights roll off and lose color instead of being clipped.
"""

import functools
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from storage.conventions import preview_srgb8
from storage.errors import TrilightError

ToneMap = Literal["plain", "filmic"]

SHOWN_PX = 256
"""Width in pixels to which narrower pictures are enlarged at least, by a whole factor."""

_CONFIG = "cg-config-v4.0.0_aces-v2.0_ocio-v2.5"
"""Built-in configuration of OpenColorIO by version, so that pictures stay the same."""
_OURS = "Linear Rec.709 (sRGB)"
_DISPLAY = "sRGB - Display"
_VIEW = "ACES 2.0 - SDR 100 nits (Rec.709)"


def enlargement(width: int) -> int:
    """Return the factor by which pictures of a width are enlarged."""
    return -(-SHOWN_PX // width)


def enlarge(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture [R, R, 3] whose pixels are repeated; unchanged from SHOWN_PX on."""
    factor = enlargement(len(pixels))
    return pixels.repeat(factor, axis=0).repeat(factor, axis=1)


def tone_mapped(
    radiance_rgb: NDArray[np.float32], tone_map: ToneMap, exposure_ev: float = 0.0
) -> NDArray[np.uint8]:
    """Return linear radiance of at least 0 as an sRGB-encoded picture [H, W, 3].

    `plain` is storage.conventions.preview_srgb8. `filmic` maps a radiance of 0.18 to middle gray
    (about a tenth of the screen's light), and 1 to about half of the screen's light. Before that,
    each stop of exposure doubles the radiance.
    """
    exposed = radiance_rgb * np.float32(2.0**exposure_ev)
    if tone_map == "plain":
        return preview_srgb8(exposed)
    pixels = np.ascontiguousarray(exposed, np.float32)
    load_filmic().applyRGB(pixels)
    return np.round(255 * np.clip(pixels, 0, 1)).astype(np.uint8)


@functools.cache
def load_filmic() -> Any:
    """Return the filmic curve; raises TrilightError where OpenColorIO is not installed."""
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
