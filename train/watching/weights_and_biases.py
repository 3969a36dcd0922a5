"""Weights & Biases beside TensorBoard, where it is asked for and installed."""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from PIL import Image

from storage.errors import TrilightError
from train.watching.scalars import scalars


class BiasesBoard:
    """Logs the rows of a run to a project; each call of the trainer is a run of its group.

    Nothing leaves the machine unless WANDB_MODE says `online`: `wandb sync` sends it later.
    """

    def __init__(self, project: str, folder: Path, settings: Mapping[str, Any]) -> None:
        """Begin a run.

        Args:
            project: its project.
            folder: of the training; files lie in `wandb/` in it, and its name is the group's.
            settings: what is shown as the configuration.

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
        # rows of a spike come later than those of its step: the step is a number like the others
        self._run.define_metric("*", step_metric="step")

    def scalars(self, row: Mapping[str, Any]) -> None:
        """Add a row of the log."""
        if found := scalars(row):
            self._run.log({**found, "step": row["step"]})

    def sheet(self, step: int, sheet: Image.Image) -> None:
        """Add a sheet of validation pictures."""
        self._run.log({"validation": self._wandb.Image(sheet), "step": step})

    def close(self) -> None:
        """End the run."""
        self._run.finish()


def require_wandb(project: str | None) -> None:
    """Refuse a run that asks for the package where it is missing, before anything is read.

    Raises:
        TrilightError: it is asked for and not installed.
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
