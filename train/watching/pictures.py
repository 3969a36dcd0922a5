"""How the same few views came to look: small pictures of some validations, kept for the page."""

import numpy as np
from PIL import Image

from storage.conventions import preview_srgb8
from train.evaluation.judge import Judge, ValidationJudgement
from train.evaluation.sheet import write_picture
from train.folder import RunFolder

KEPT_VIEWS = 4
"""Validation scenes whose first view is kept."""

MOST_STEPS = 12
"""Validations whose pictures are kept, spread over the run."""

MOST_PX = 128
"""Largest width of one picture."""

TARGET = "target.png"


def keep_pictures(
    folder: RunFolder, judge: Judge, judgement: ValidationJudgement, step: int
) -> None:
    """Write this validation's pictures, above each other, and delete what is too much.

    Raises:
        TrilightError: the folder is full or cannot be written.
    """
    if not (folder.pictures / TARGET).exists():
        targets = [scene.target_VRR3[0] for scene in judge.scenes[:KEPT_VIEWS]]
        write_picture(folder.pictures / TARGET, _column(targets))
    shown = [np.nan_to_num(views[0], nan=1e6, posinf=1e6) for views in judgement.pictures]
    write_picture(folder.pictures / f"step-{step:09d}.png", _column(shown[:KEPT_VIEWS]))
    for dropped in dropped_steps(kept_steps(folder)):
        (folder.pictures / f"step-{dropped:09d}.png").unlink(missing_ok=True)


def kept_steps(folder: RunFolder) -> list[int]:
    """Return the steps of which there are pictures, oldest first."""
    names = [path.stem.removeprefix("step-") for path in folder.pictures.glob("step-*.png")]
    return sorted(int(name) for name in names if name.isdecimal())


def dropped_steps(steps: list[int]) -> list[int]:
    """Return which of the steps, oldest first, have to go so that MOST_STEPS stay.

    Each time it is the one that leaves the smallest gap, never the first nor the last.
    """
    steps, dropped = list(steps), []
    while len(steps) > MOST_STEPS:
        gaps = [after - before for before, after in zip(steps, steps[2:], strict=False)]
        dropped.append(steps.pop(1 + gaps.index(min(gaps))))
    return dropped


def _column(pictures: list[np.ndarray]) -> Image.Image:
    """Return [R, R, 3] linear radiance of each as one picture, above each other."""
    tiles = [Image.fromarray(preview_srgb8(picture)) for picture in pictures]
    px = min(tiles[0].width, MOST_PX)
    column = Image.new("RGB", (px, px * len(tiles)))
    for row, tile in enumerate(tiles):
        small = tile if tile.width == px else tile.resize((px, px), Image.Resampling.BOX)
        column.paste(small, (0, row * px))
    return column
