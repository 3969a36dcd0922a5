"""Comparison of two engines' pictures of one view: side by side, and the flicker of their error.

In motion an error that stays at its pixels is hardly seen; one that jumps is
(storage.metrics.flicker_log_db).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from infra.render.tone_mapping import Look, display_pixels, enlarge
from pipeline.exchange.formats import FORMATS, SceneSource
from storage.conventions import log10_radiance
from storage.metrics import flicker_log_db, psnr_log_db
from train.evaluation.error_colors import ERROR_WHITE, error_picture

_CAPTION_PX = 24
_GAP_PX = 8
_FONT_PX = 14
_INK = (30, 30, 30)
_PAPER = (250, 250, 248)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Data of one view by both engines, with which the next frame is compared."""

    source: SceneSource
    error_RR3: NDArray
    """[R, R, 3] the network's error of log10(1 + radiance) against the traced picture."""
    noise_floor_db: float
    """Stated error of the traced picture as psnr_log_db."""


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """Change of the network's error between two consecutive frames; at most 100 dB."""

    db: float
    """Flicker in dB; a higher value is calmer."""
    noise_db: float
    """Flicker in dB of the traced pictures' noise alone, an upper bound for any network."""


def log_error(neural_rgb: NDArray[np.float32], traced_rgb: NDArray[np.float32]) -> NDArray:
    """Return the error [R, R, 3] of log10(1 + radiance)."""
    error: NDArray = log10_radiance(neural_rgb) - log10_radiance(traced_rgb)
    return error


def flicker(before: Frame | None, now: Frame) -> Flicker | None:
    """Return the flicker from one frame to the next; None where their scenes do not belong."""
    if before is None:
        return None
    # one scene or frames of one stage, unlike the scenes of a shard
    is_stage = not FORMATS[now.source.path.suffix.lower()].always_many
    if before.source != now.source and not (is_stage and before.source.path == now.source.path):
        return None
    noise = 10 ** (-before.noise_floor_db / 10) + 10 ** (-now.noise_floor_db / 10)
    noise_db = float(-10 * np.log10(max(noise, 1e-10)))
    return Flicker(db=flicker_log_db(before.error_RR3, now.error_RR3), noise_db=noise_db)


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
        (f"mitsuba{stops}", display_pixels(traced_rgb, look)),
        (f"neural, {agreement:.1f} dB (log){stops}", display_pixels(neural_rgb, look)),
        (f"error (white: {ERROR_WHITE} log10)", enlarge(error_picture(neural_rgb, traced_rgb))),
    )
    width = len(tiles[0][1])
    sheet = Image.new("RGB", (3 * width + 2 * _GAP_PX, width + _CAPTION_PX), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=_FONT_PX)
    for column, (caption, pixels) in enumerate(tiles):
        column_px = column * (width + _GAP_PX)
        sheet.paste(Image.fromarray(pixels), (column_px, _CAPTION_PX))
        draw.text((column_px + 2, 3), caption, fill=_INK, font=font)
    return np.asarray(sheet)
