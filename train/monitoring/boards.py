"""Rows of the log as named scalars, for TensorBoard and Weights & Biases (W&B).

TensorBoard always, Weights & Biases if requested and installed.
"""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from storage.errors import TrilightError
from train.monitoring.rows import LAYER_COLUMNS

_GROUPED = ("validation", "time_s", "memory_mb")


def scalars(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a row by `group/name`; other values are left out."""
    numbers: dict[str, Any] = {}
    for name, value in row.items():
        if name in _GROUPED:
            numbers |= {f"{name}/{inner}": number for inner, number in (value or {}).items()}
        elif name == "layers":
            for layer, figures in value.items():
                numbers |= {
                    f"{column}/{layer}": figure
                    for column, figure in zip(LAYER_COLUMNS, figures, strict=True)
                }
        elif name == "own_s":
            numbers |= {f"own_s/process {rank}": seconds for rank, seconds in enumerate(value)}
        elif name not in ("step", "spike"):
            numbers[f"train/{name}"] = value
    return {
        name: value
        for name, value in numbers.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


class TensorBoardLogger:
    """Writes the log's numbers and the validation sheets for TensorBoard.

    A resumed run writes its rows after the first step again.
    """

    def __init__(self, folder: Path, *, first_step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # half a second to import

        self._writer = SummaryWriter(str(folder), purge_step=first_step + 1)

    def scalars(self, row: Mapping[str, Any]) -> None:
        """Add a row of the log; values that are not numbers are left out."""
        step = row["step"]
        for name, value in scalars(row).items():
            self._writer.add_scalar(name, value, step)

    def sheet(self, step: int, sheet: Image.Image) -> None:
        """Add a sheet of validation pictures."""
        self._writer.add_image("validation", np.asarray(sheet), step, dataformats="HWC")

    def close(self) -> None:
        """Flush and close the files."""
        self._writer.close()


class WandbLogger:
    """Logs the rows of a run to a project; each call of the trainer is one run in a group.

    Nothing leaves the machine unless WANDB_MODE is `online`: `wandb sync` uploads it later.
    """

    def __init__(self, project: str, folder: Path, settings: Mapping[str, Any]) -> None:
        """Start a run of the project.

        Args:
            folder: folder of the training, with files in `wandb/`; its name is that of the group.
            settings: configuration of the run to display.

        Raises:
            TrilightError: the package is not installed.
        """
        self._wandb = _package()
        name = folder.resolve().name
        self._run = self._wandb.init(
            project=project,
            group=name,
            dir=str(folder),
            config=dict(settings),
            mode=os.environ.get("WANDB_MODE", "offline"),
        )
        # a spike's row comes after later steps, so the step is logged as an ordinary value
        self._run.define_metric("*", step_metric="step")

    def scalars(self, row: Mapping[str, Any]) -> None:
        """Add a row of the log."""
        if numbers := scalars(row):
            self._run.log({**numbers, "step": row["step"]})

    def sheet(self, step: int, sheet: Image.Image) -> None:
        """Add a sheet of validation pictures."""
        self._run.log({"validation": self._wandb.Image(sheet), "step": step})

    def close(self) -> None:
        """End the run."""
        self._run.finish()


def require_wandb(project: str | None) -> None:
    """Raise early if the package is requested and missing.

    Raises:
        TrilightError: a project is named and wandb is not installed.
    """
    if project is not None:
        _package()


def _package() -> Any:
    try:
        return import_module("wandb")
    except ImportError as error:
        raise TrilightError(
            f"wandb is not installed, and the log is to go there too; expected `pip install wandb` "
            f"before, or no --wandb ({error})."
        ) from error
