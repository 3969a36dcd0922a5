"""What the first process writes during a run beside checkpoints: its log and notes."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from storage.atomic import write_atomically, write_error
from storage.settings.described import settings_record
from train.evaluation.judge import Judge
from train.evaluation.sheet import drawn_validation_sheet
from train.folder import RunFolder
from train.loop.state import TrainState
from train.progress import TrainProgress
from train.settings import TrainSettings
from train.watching.notes import add_note
from train.watching.rows import read_rows
from train.watching.scalars import scalars
from train.watching.weights_and_biases import BiasesBoard


class Board:
    """TensorBoard: the log's numbers as curves, and the validation sheets.

    Rows after the first step of a resumed run are written again.
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
        """Write what is still in memory."""
        self._writer.close()


class Recorder:
    """Writes log, notes and curves, and reports to the progress display."""

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        judge: Judge | None,
        progress: TrainProgress,
        *,
        first_step: int,
        wandb: str | None = None,
    ) -> None:
        self.progress = progress
        self._folder = folder
        self._settings = settings
        self._judge = judge
        self._log = MetricsLog(folder.metrics, first_step=first_step)
        self._boards: list[Board | BiasesBoard] = [Board(folder.tensorboard, first_step=first_step)]
        if wandb is not None:
            self._boards.append(BiasesBoard(wandb, folder.root, settings_record(settings)))

    def row(self, row: Mapping[str, Any]) -> None:
        """Write one row of the log."""
        self._log.append(row)
        for board in self._boards:
            board.scalars(row)

    def note(self, step: int, text: str) -> None:
        """Tell the user something, and keep it; a sentence without its full stop."""
        self.progress.noted(text)
        add_note(self._folder.notes, step, text)

    def has_validated(self, step: int) -> bool:
        """Return whether the log has a validation of a step, or there is nothing to judge on."""
        rows = read_rows(self._folder.metrics)
        return self._judge is None or any(
            "validation" in row and row["step"] == step for row in rows
        )

    def validate(self, state: TrainState, between: Callable[[], None] = lambda: None) -> None:
        """Judge the network on the validation split, if there is one, and write down how it did.

        Args:
            state: of the run.
            between: as `Judge.judge` takes it; where it raises, nothing is written.
        """
        if self._judge is None:
            return
        judgement = self._judge.judge(state.shown, between)
        self.row({"step": state.step, "validation": judgement.scores})
        sheet = drawn_validation_sheet(self._settings, self._judge, judgement, state.step)
        median = {"median_picture_log_l1": self._judge.median_scores["log_l1"]}
        for board in self._boards:
            board.scalars({"step": state.step, "validation": median})
            board.sheet(state.step, sheet)
        self.progress.validated(step=state.step, scores=judgement.scores)

    def close(self) -> None:
        """Write what is still in memory."""
        for board in self._boards:
            board.close()


class MetricsLog:
    """metrics.jsonl: one JSON object per line, each with the step after which it was taken."""

    def __init__(self, path: Path, *, first_step: int) -> None:
        """Cut the log back to `first_step`, the checkpoint: later rows will be written again.

        A line that a kill cut short is dropped with them, since it is the last.
        """
        self.path = path
        kept = [row for row in read_rows(path) if row["step"] <= first_step]
        write_atomically(path, "".join(_line(row) for row in kept).encode())

    def append(self, row: Mapping[str, Any]) -> None:
        """Write one row at once, so that it can be followed while the run goes on."""
        try:
            with self.path.open("a") as stream:
                stream.write(_line(row))
        except OSError as error:
            raise write_error(self.path, error) from error


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row, sort_keys=True) + "\n"
