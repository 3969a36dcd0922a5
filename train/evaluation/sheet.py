"""Contact sheet of an evaluation: target, prediction, error, and error relative to the noise.

Errors are shown in false color. Imports no torch.
"""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from storage.atomic import write_atomically
from storage.conventions import log10_radiance, preview_srgb8

ERROR_WHITE = 0.5
"""|log10(1 + a) - log10(1 + b)| that the error picture shows as white."""


def error_picture(predicted_rgb: NDArray, target_rgb: NDArray) -> NDArray[np.uint8]:
    """Return the error of log10(1 + radiance) [R, R, 3], from black over red to white."""
    return heat_colors(mean_error(predicted_rgb, target_rgb) / ERROR_WHITE)


def mean_error(predicted_rgb: NDArray, target_rgb: NDArray) -> NDArray:
    """Return |log10(1 + a) - log10(1 + b)| [R, R], averaged over channels."""
    error: NDArray = np.abs(log10_radiance(predicted_rgb) - log10_radiance(target_rgb))
    return error.mean(axis=-1)


def heat_colors(level_RR: NDArray) -> NDArray[np.uint8]:
    """Map 0 to 1 to black, red, yellow and white."""
    ramp = np.clip(3 * level_RR[..., None] - np.array([0, 1, 2]), 0, 1)
    return np.round(255 * ramp).astype(np.uint8)


TILE_PX = 160
"""Maximum width of a tile, which is a whole multiple of the picture's width."""

CAPTION_PX = 20
"""Height of one line of text."""

GAP_PX = 8
BLOCKS_PER_LINE = 2

NOISE_WHITE = 16.0
"""Multiple of the noise that the last picture shows as white; black is the noise itself."""

INK = (30, 30, 30)
PAPER = (250, 250, 248)


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetView:
    """Pictures and captions of one view on a sheet."""

    name: str
    """First caption line, with scene and view."""
    scores: str
    """Second caption line, with the scores."""
    target_rgb: NDArray
    """[R, R, 3] linear radiance."""
    predicted_rgb: NDArray
    """[R, R, 3] linear radiance."""
    noise: float
    """Root mean square noise of the target's log10(1 + radiance)."""
    extra_rgb: Mapping[str, NDArray] = field(default_factory=dict)
    """[R, R, 3] linear radiance of other methods by name; all views of a sheet have the same."""


def draw_sheet(views: Sequence[SheetView], title: Sequence[str]) -> Image.Image:
    """Draw a sheet; `title` has one or more lines."""
    blocks = [_block(view) for view in views]
    height = blocks[0].height + GAP_PX
    width = blocks[0].width + 2 * GAP_PX
    top = len(title) * CAPTION_PX + 2 * GAP_PX
    lines = -(-len(blocks) // BLOCKS_PER_LINE)
    sheet = Image.new("RGB", (BLOCKS_PER_LINE * width, top + lines * height), PAPER)
    for row, text in enumerate(title):
        _write(sheet, (GAP_PX, GAP_PX + row * CAPTION_PX), text)
    for index, block in enumerate(blocks):
        line, column = divmod(index, BLOCKS_PER_LINE)
        sheet.paste(block, (GAP_PX + column * width, top + line * height))
    return sheet


def write_picture(path: Path, picture: Image.Image) -> None:
    """Write a picture as PNG, whole or not at all."""
    data = io.BytesIO()
    picture.save(data, "PNG")
    write_atomically(path, data.getvalue())


def noise_picture(view: SheetView) -> NDArray[np.uint8]:
    """Return the error relative to the view's noise [R, R, 3], on a log scale, black at the noise.

    The noise is one number for the whole view, its stated error.
    """
    error = mean_error(view.predicted_rgb, view.target_rgb)
    times = np.maximum(error / max(view.noise, 1e-6), 1.0)
    return heat_colors(np.log(times) / np.log(NOISE_WHITE))


def _block(view: SheetView) -> Image.Image:
    # a diverged network predicts NaN, which is shown as white
    predicted = np.nan_to_num(view.predicted_rgb, nan=1e6, posinf=1e6)
    view = dataclasses.replace(view, predicted_rgb=predicted)
    pictures = {
        "target": preview_srgb8(view.target_rgb),
        "prediction": preview_srgb8(view.predicted_rgb),
        **{name: preview_srgb8(picture) for name, picture in view.extra_rgb.items()},
        f"error (white: {ERROR_WHITE})": error_picture(view.predicted_rgb, view.target_rgb),
        f"... / noise (white: {NOISE_WHITE:.0f})": noise_picture(view),
    }
    scale = max(TILE_PX // view.target_rgb.shape[0], 1)
    tile = scale * view.target_rgb.shape[0]
    width = len(pictures) * (tile + GAP_PX) - GAP_PX
    block = Image.new("RGB", (width, tile + 3 * CAPTION_PX), PAPER)
    for column, (caption, pixels) in enumerate(pictures.items()):
        x_px = column * (tile + GAP_PX)
        enlarged = Image.fromarray(pixels).resize((tile, tile), Image.Resampling.NEAREST)
        block.paste(enlarged, (x_px, CAPTION_PX))
        _write(block, (x_px, 0), caption)
    _write(block, (0, CAPTION_PX + tile), view.name)
    _write(block, (0, 2 * CAPTION_PX + tile), view.scores)
    return block


def _write(image: Image.Image, at: tuple[int, int], text: str) -> None:
    font = ImageFont.load_default(size=CAPTION_PX - 6)
    ImageDraw.Draw(image).text((at[0], at[1] + 1), text, fill=INK, font=font)
