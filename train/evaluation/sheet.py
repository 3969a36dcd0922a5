"""The sheet that a person looks at: target, prediction and error of validation scenes."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from storage.atomic import write_atomically
from storage.conventions import log10_radiance, preview_srgb8

TILE_PX = 192
"""Width of a tile, where a whole multiple of the pictures fits."""

CAPTION_PX = 20
"""Height of one line of text."""

GAP_PX = 8
BLOCKS_PER_LINE = 2

ERROR_WHITE = 0.5
"""|log10(1 + a) - log10(1 + b)| that the error picture shows as white."""

INK, PAPER = (30, 30, 30), (250, 250, 248)


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetView:
    """One view on the sheet."""

    name: str
    """Scene and view."""
    scores: str
    """One line of figures."""
    target_rgb: NDArray
    """[R, R, 3] linear radiance."""
    predicted_rgb: NDArray
    """[R, R, 3] linear radiance."""


def write_sheet(path: Path, views: Sequence[SheetView], title: Sequence[str]) -> None:
    """Draw and write the sheet as PNG; `title` is one or more lines."""
    blocks = [_block(view) for view in views]
    height, width = blocks[0].height + GAP_PX, blocks[0].width + 2 * GAP_PX
    top = len(title) * CAPTION_PX + 2 * GAP_PX
    lines = -(-len(blocks) // BLOCKS_PER_LINE)
    sheet = Image.new("RGB", (BLOCKS_PER_LINE * width, top + lines * height), PAPER)
    for row, text in enumerate(title):
        _write(sheet, (GAP_PX, GAP_PX + row * CAPTION_PX), text)
    for index, block in enumerate(blocks):
        line, column = divmod(index, BLOCKS_PER_LINE)
        sheet.paste(block, (GAP_PX + column * width, top + line * height))
    data = io.BytesIO()
    sheet.save(data, "PNG")
    write_atomically(path, data.getvalue())


def error_picture(predicted_rgb: NDArray, target_rgb: NDArray) -> NDArray[np.uint8]:
    """Return [R, R, 3]: the channels' mean error of log10(1 + radiance), black to red to white."""
    difference = np.abs(log10_radiance(predicted_rgb) - log10_radiance(target_rgb))
    level = np.clip(difference.mean(axis=-1) / ERROR_WHITE, 0, 1)[..., None]
    ramp = np.clip(3 * level - np.array([0, 1, 2]), 0, 1)
    return np.round(255 * ramp).astype(np.uint8)


def _block(view: SheetView) -> Image.Image:
    pictures = {
        "target": preview_srgb8(view.target_rgb),
        "prediction": preview_srgb8(view.predicted_rgb),
        f"error (white: {ERROR_WHITE})": error_picture(view.predicted_rgb, view.target_rgb),
    }
    scale = max(TILE_PX // view.target_rgb.shape[0], 1)
    tile = scale * view.target_rgb.shape[0]
    width = len(pictures) * (tile + GAP_PX) - GAP_PX
    block = Image.new("RGB", (width, tile + 3 * CAPTION_PX), PAPER)
    for column, (caption, pixels) in enumerate(pictures.items()):
        left = column * (tile + GAP_PX)
        enlarged = Image.fromarray(pixels).resize((tile, tile), Image.Resampling.NEAREST)
        block.paste(enlarged, (left, CAPTION_PX))
        _write(block, (left, 0), caption)
    _write(block, (0, CAPTION_PX + tile), view.name)
    _write(block, (0, 2 * CAPTION_PX + tile), view.scores)
    return block


def _write(image: Image.Image, at: tuple[int, int], text: str) -> None:
    font = ImageFont.load_default(size=CAPTION_PX - 6)
    ImageDraw.Draw(image).text((at[0], at[1] + 1), text, fill=INK, font=font)
