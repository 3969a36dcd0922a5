"""Logging to Weights & Biases, if requested and installed."""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from PIL import Image

from storage.errors import TrilightError
from train.monitoring.scalars import scalars


class WandbLogger:
    """Logs the rows of a run to a project; each call of the trainer is one run in a group.

    Nothing leaves the machine unless WANDB_MODE is `online`: `wandb sync` uploads it later.
    """

    def __init__(self, project: str, folder: Path, settings: Mapping[str, Any]) -> None:
        """Start a run of the project.

        Args:
            project: name of the project.
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
