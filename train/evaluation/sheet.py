"""Contact sheet of an evaluation: target, prediction, error, and error relative to the noise."""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from storage.atomic import write_atomically
from storage.conventions import preview_srgb8
from train.evaluation.error_colors import (
    ERROR_WHITE,
    error_picture,
    heat_colors,
    mean_error,
)
from train.evaluation.validation import Judge, ValidationResult
from train.settings import TrainSettings

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


SHEET_SCENES = 8
"""Maximum number of scenes on a validation sheet, one view each."""


def draw_validation_sheet(
    settings: TrainSettings, judge: Judge, validation: ValidationResult, step: int
) -> Image.Image:
    """Draw the sheet of the first validation scenes after a step."""
    views = []
    at = 0
    scene_pictures = zip(judge.scenes, validation.pictures, strict=True)
    for judged, pictures in list(scene_pictures)[:SHEET_SCENES]:
        score = validation.views[at]
        median = judge.median_views[at]
        at += len(pictures)
        views.append(
            SheetView(
                name=f"scene {judged.scene.key}, view 0",
                scores=(
                    f"log L1 {score['log_l1']:.4f} (median picture {median['log_l1']:.4f}), "
                    f"{score['psnr_log_db']:.1f} dB log, {score['psnr_linear_db']:.1f} dB linear"
                ),
                target_rgb=judged.target_VRR3[0],
                predicted_rgb=pictures[0],
                noise=float(judged.scene.noise_V[0]),
            )
        )
    title = (
        f"run {settings.run}, step {step} of {settings.num_steps}, {settings.resolution} pixels: "
        f"validation scenes, never trained on",
        f"log L1 {validation.scores['log_l1']:.4f}, median picture of the training views "
        f"{judge.median_scores['log_l1']:.4f}, "
        f"{validation.scores['better_than_median']:.0%} of views better than it",
    )
    return draw_sheet(views, title)
