"""Two engines' pictures of one view: side by side, and how their difference flickers.

An error that stays where it is on the screen is hardly seen in motion; one that jumps is
(storage.metrics.flicker_log_db).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from infra.rendering.look import Look, enlarged, shown
from pipeline.exchange.formats import FORMATS, SceneSource
from storage.conventions import log10_radiance
from storage.metrics import flicker_log_db, psnr_log_db
from train.evaluation.error_colours import ERROR_WHITE, error_picture

_CAPTION_PX = 24
_GAP_PX = 8
_FONT_PX = 14
_INK = (30, 30, 30)
_PAPER = (250, 250, 248)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """What is remembered of one view by both engines, to compare the next frame with it."""

    source: SceneSource
    """Its scene."""
    error_RR3: NDArray
    """The network's error of log10(1 + radiance) against the traced picture."""
    noise_floor_db: float
    """Of the traced picture."""


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """How much of the network's error changes between two frames in a row; 100 dB at most."""

    db: float
    """Higher is calmer."""
    noise_db: float
    """What the noise of the traced pictures alone would show: no network can measure higher."""


def log_error(neural_rgb: NDArray[np.float32], traced_rgb: NDArray[np.float32]) -> NDArray:
    """Return the error [R, R, 3] of log10(1 + radiance)."""
    error: NDArray = log10_radiance(neural_rgb) - log10_radiance(traced_rgb)
    return error


def flicker(before: Frame | None, now: Frame) -> Flicker | None:
    """Return the flicker from one frame to the next; None where the scenes are strangers."""
    if before is None or not _goes_on(before.source, now.source):
        return None
    noise = 10 ** (-before.noise_floor_db / 10) + 10 ** (-now.noise_floor_db / 10)
    return Flicker(db=flicker_log_db(before.error_RR3, now.error_RR3), noise_db=_db(noise))


def comparison_sheet(
    traced_rgb: NDArray[np.float32], neural_rgb: NDArray[np.float32], look: Look
) -> NDArray[np.uint8]:
    """Return [H, W, 3]: path traced, neural, and the error of the second against the first.

    Both [R, R, 3] linear radiance. Height and width are even, as videos need them. Exposure changes
    the first two, and no error.
    """
    agreement = psnr_log_db(neural_rgb, traced_rgb)
    stops = f", {look.exposure_ev:+g} EV" if look.exposure_ev else ""
    tiles = (
        (f"mitsuba{stops}", shown(traced_rgb, look)),
        (f"neural, {agreement:.1f} dB (log){stops}", shown(neural_rgb, look)),
        (f"error (white: {ERROR_WHITE} log10)", enlarged(error_picture(neural_rgb, traced_rgb))),
    )
    width = len(tiles[0][1])
    sheet = Image.new("RGB", (3 * width + 2 * _GAP_PX, width + _CAPTION_PX), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=_FONT_PX)
    for column, (caption, pixels) in enumerate(tiles):
        left = column * (width + _GAP_PX)
        sheet.paste(Image.fromarray(pixels), (left, _CAPTION_PX))
        draw.text((left + 2, 3), caption, fill=_INK, font=font)
    return np.asarray(sheet)


def _goes_on(before: SceneSource, now: SceneSource) -> bool:
    """Return whether both are one scene, or moments of one stage, unlike the scenes of a shard."""
    if before == now:
        return True
    return before.path == now.path and not FORMATS[now.path.suffix.lower()].always_many


def _db(mean_square: float) -> float:
    return float(-10 * np.log10(max(mean_square, 1e-10)))
