"""Log, notes and curves that the first process writes during a run.

Rows of the log go as named scalars to TensorBoard always, and from there to Weights & Biases (W&B)
if requested and installed.
"""

import json
import os
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

from model.renderformer import count_parameters
from storage.atomic import append_line
from storage.errors import TrilightError
from storage.settings.described import settings_record
from train.evaluation.validation import Judge, ValidationResult, draw_validation_sheet
from train.folder import RunFolder, add_note, copy_rows, read_rows
from train.loop.train_state import TrainState
from train.progress import TrainProgress

LAYER_COLUMNS = ("grad_norm", "weight_norm", "update_ratio")
"""Values of a layer in a row: norm of its gradient before clipping, norm of its weights, and norm
of the update divided by that of the weights."""

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


def require_wandb(project: str | None) -> Any:
    """Return the package if a project is named; raises TrilightError where it is not installed."""
    if project is None:
        return None
    try:
        return import_module("wandb")
    except ImportError as error:
        raise TrilightError(
            f"wandb is not installed, and the log is to go there too; expected `pip install wandb` "
            f"before, or no --wandb ({error})."
        ) from error


class Recorder:
    """Writes log, notes and curves, and reports to the progress display; first process only."""

    def __init__(
        self,
        folder: RunFolder,
        judge: Judge | None,
        progress: TrainProgress,
        state: TrainState,
        *,
        wandb: str | None = None,
    ) -> None:
        """Report the start of the run at `state`, whose step is the last one of the log."""
        progress.begin(
            step=state.step,
            num_steps=state.settings.num_steps,
            num_parameters=count_parameters(state.model),
            median_scores=judge.median_scores if judge else None,
        )
        self.progress = progress
        self._folder = folder
        self.judge = judge
        self.validation: ValidationResult | None = None
        """Last validation of this call; None if nothing was trained."""
        copy_rows(folder.metrics, folder.metrics, state.step)  # later ones will be written again
        self._wandb_run = None
        # It begins before the writer, whose files it follows; each call of the trainer is one in a
        # group. Nothing leaves the machine unless WANDB_MODE is `online`: `wandb sync` uploads it.
        if wandb is not None:
            self._wandb_run = require_wandb(wandb).init(
                project=wandb,
                group=folder.root.resolve().name,
                dir=str(folder.root),
                config=settings_record(state.settings),
                mode=os.environ.get("WANDB_MODE", "offline"),
                sync_tensorboard=True,
            )
        from torch.utils.tensorboard import SummaryWriter  # half a second to import

        # a resumed run writes its rows after this step again
        self._board = SummaryWriter(str(folder.tensorboard), purge_step=state.step + 1)

    def row(self, row: Mapping[str, Any]) -> None:
        """Write one row of the log."""
        append_line(self._folder.metrics, json.dumps(row, sort_keys=True))
        self._show_scalars(row)

    def _show_scalars(self, row: Mapping[str, Any]) -> None:
        for name, value in scalars(row).items():
            self._board.add_scalar(name, value, row["step"])

    def note(self, step: int, text: str) -> None:
        """Report a sentence without its full stop, and append it to notes.jsonl."""
        self.progress.note(text)
        add_note(self._folder.notes, step, text)

    def has_validated(self, step: int) -> bool:
        """Return whether the log has a validation of a step, or there is no validation split."""
        rows = read_rows(self._folder.metrics)
        return self.judge is None or any(
            "validation" in row and row["step"] == step for row in rows
        )

    def validate(self, state: TrainState, between: Callable[[], None] = lambda: None) -> None:
        """Evaluate the network on the validation split, if there is one, and write its scores.

        Args:
            between: as in `Judge.judge`; if it raises, nothing is written.
        """
        if self.judge is None:
            return
        self.validation = validation = self.judge.judge(state.eval_model, between)
        self.row({"step": state.step, "validation": validation.scores})
        sheet = draw_validation_sheet(state.settings, self.judge, validation, state.step)
        median = {"median_picture_log_l1": self.judge.median_scores["log_l1"]}
        self._show_scalars({"step": state.step, "validation": median})
        self._board.add_image("validation", np.asarray(sheet), state.step, dataformats="HWC")
        self.progress.report_validation(step=state.step, scores=validation.scores)

    def close(self) -> None:
        """Flush and close the files of TensorBoard, and end the run of W&B."""
        self._board.close()
        if self._wandb_run is not None:
            self._wandb_run.finish()
