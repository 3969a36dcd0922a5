"""From radiance to what a screen shows: the plain curve of previews, or a film-like one.

The film-like curve is the Academy's ACES 2.0 output transform for screens of 100 nits, as
OpenColorIO carries it: highlights roll off and lose colour instead of being clipped.
"""

import functools
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from storage.conventions import preview_srgb8
from storage.errors import TrilightError

ToneMap = Literal["plain", "filmic"]
TONE_MAPS: tuple[ToneMap, ...] = get_args(ToneMap)

_CONFIG = "cg-config-v4.0.0_aces-v2.0_ocio-v2.5"
"""One of the configurations that OpenColorIO has built in, by version: pictures stay the same."""
_OURS = "Linear Rec.709 (sRGB)"
_DISPLAY, _VIEW = "sRGB - Display", "ACES 2.0 - SDR 100 nits (Rec.709)"


def require_tone_map(name: str) -> ToneMap:
    """Return the tone map of a name; raises TrilightError where there is none, or no library."""
    found = next((known for known in TONE_MAPS if known == name), None)
    if found is None:
        raise TrilightError(f"--tone-map is {name}; expected {' or '.join(TONE_MAPS)}.")
    if found == "filmic":
        _filmic()
    return found


def tone_mapped(radiance_rgb: NDArray[np.float32], tone_map: ToneMap) -> NDArray[np.uint8]:
    """Return a picture [H, W, 3] for people, sRGB-encoded, of linear radiance of at least 0.

    `plain` is storage.conventions.preview_srgb8. `filmic` shows a radiance of 0.18 as middle grey
    (about a tenth of the screen's light), and 1 at about half of it.
    """
    if tone_map == "plain":
        return preview_srgb8(radiance_rgb)
    shown = np.ascontiguousarray(radiance_rgb, np.float32).copy()
    _filmic().applyRGB(shown)
    return np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8)


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
