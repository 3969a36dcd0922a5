"""Two engines' pictures of one view side by side, with the map of their difference."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from infra.rendering.look import Look, enlarged, shown
from storage.metrics import psnr_log_db
from train.evaluation.sheet import ERROR_WHITE, error_picture

_CAPTION_PX, _GAP_PX, _FONT_PX = 24, 8, 14
_INK, _PAPER = (30, 30, 30), (250, 250, 248)


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
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=_FONT_PX)
    for column, (caption, pixels) in enumerate(tiles):
        left = column * (width + _GAP_PX)
        sheet.paste(Image.fromarray(pixels), (left, _CAPTION_PX))
        draw.text((left + 2, 3), caption, fill=_INK, font=font)
    return np.asarray(sheet)
