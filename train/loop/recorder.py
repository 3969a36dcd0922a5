"""Log, notes and curves that the first process writes during a run."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from model.renderformer import count_parameters
from storage.atomic import append_line, write_atomically
from storage.settings.described import settings_record
from train.evaluation.sheet import draw_validation_sheet
from train.evaluation.validation import Judge
from train.folder import RunFolder
from train.loop.train_state import TrainState
from train.monitoring.boards import TensorBoardLogger, WandbLogger
from train.monitoring.rows import add_note, read_rows
from train.progress import TrainProgress
from train.settings import TrainSettings


class Recorder:
    """Writes log, notes and curves, and reports to the progress display; first process only."""

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        judge: Judge | None,
        progress: TrainProgress,
        state: TrainState,
        *,
        wandb: str | None = None,
    ) -> None:
        """Report the start of the run at `state`, whose step is the last one of the log."""
        progress.begin(
            step=state.step,
            num_steps=settings.num_steps,
            num_parameters=count_parameters(state.model),
            median_scores=judge.median_scores if judge else None,
        )
        self.progress = progress
        self._folder = folder
        self._settings = settings
        self._judge = judge
        self._log = MetricsLog(folder.metrics, first_step=state.step)
        self._boards: list[TensorBoardLogger | WandbLogger] = [
            TensorBoardLogger(folder.tensorboard, first_step=state.step)
        ]
        if wandb is not None:
            self._boards.append(WandbLogger(wandb, folder.root, settings_record(settings)))

    def row(self, row: Mapping[str, Any]) -> None:
        """Write one row of the log."""
        self._log.append(row)
        for board in self._boards:
            board.scalars(row)

    def note(self, step: int, text: str) -> None:
        """Report a sentence without its full stop, and append it to notes.jsonl."""
        self.progress.note(text)
        add_note(self._folder.notes, step, text)

    def has_validated(self, step: int) -> bool:
        """Return whether the log has a validation of a step, or there is no validation split."""
        rows = read_rows(self._folder.metrics)
        return self._judge is None or any(
            "validation" in row and row["step"] == step for row in rows
        )

    def validate(self, state: TrainState, between: Callable[[], None] = lambda: None) -> None:
        """Evaluate the network on the validation split, if there is one, and write its scores.

        Args:
            between: as in `Judge.judge`; if it raises, nothing is written.
        """
        if self._judge is None:
            return
        validation = self._judge.judge(state.eval_model, between)
        self.row({"step": state.step, "validation": validation.scores})
        sheet = draw_validation_sheet(self._settings, self._judge, validation, state.step)
        median = {"median_picture_log_l1": self._judge.median_scores["log_l1"]}
        for board in self._boards:
            board.scalars({"step": state.step, "validation": median})
            board.sheet(state.step, sheet)
        self.progress.report_validation(step=state.step, scores=validation.scores)

    def close(self) -> None:
        """Flush and close all loggers."""
        for board in self._boards:
            board.close()


class MetricsLog:
    """Writer of metrics.jsonl: one JSON object per line, each with its step."""

    def __init__(self, path: Path, *, first_step: int) -> None:
        """Drop rows after `first_step`, the step of the checkpoint: they will be written again.

        An incomplete last line, left by a kill, is dropped too.
        """
        self.path = path
        rows = [row for row in read_rows(path) if row["step"] <= first_step]
        lines = [f"{json.dumps(row, sort_keys=True)}\n" for row in rows]
        write_atomically(path, "".join(lines).encode())

    def append(self, row: Mapping[str, Any]) -> None:
        """Append one row and close the file, so that readers can follow the run."""
        append_line(self.path, json.dumps(row, sort_keys=True))
