"""What the first process writes during a run, beside checkpoints: metrics.jsonl and TensorBoard."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from storage.atomic import write_atomically, write_error
from train.evaluation.judge import Judge
from train.evaluation.sheet import drawn_validation_sheet
from train.folder import RunFolder
from train.loop.state import TrainState
from train.progress import TrainProgress
from train.settings import TrainSettings


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
        flat = {name: value for name, value in row.items() if name != "step"}
        for name, value in (flat.pop("validation", None) or {}).items():
            flat[f"validation/{name}"] = value
        for name, value in flat.items():
            if isinstance(value, int | float):
                tag = name if "/" in name else f"train/{name}"
                self._writer.add_scalar(tag, value, step)

    def sheet(self, step: int, sheet: Image.Image) -> None:
        """Add a sheet of validation pictures."""
        self._writer.add_image("validation", np.asarray(sheet), step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._writer.close()


class Recorder:
    """Writes to metrics.jsonl and TensorBoard, and reports to the progress display."""

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        judge: Judge | None,
        progress: TrainProgress,
        *,
        first_step: int,
    ) -> None:
        self.progress = progress
        self._settings = settings
        self._judge = judge
        self._log = MetricsLog(folder.metrics, first_step=first_step)
        self._board = Board(folder.tensorboard, first_step=first_step)

    def row(self, row: Mapping[str, Any]) -> None:
        """Write one row of the log."""
        self._log.append(row)
        self._board.scalars(row)

    def validate(self, state: TrainState) -> None:
        """Judge the network on the validation split, if there is one, and write down how it did."""
        if self._judge is None:
            return
        judgement = self._judge.judge(state.shown)
        self.row({"step": state.step, "validation": judgement.scores})
        sheet = drawn_validation_sheet(self._settings, self._judge, judgement, state.step)
        self._board.sheet(state.step, sheet)
        self.progress.validated(step=state.step, scores=judgement.scores)

    def close(self) -> None:
        """Write what is still in memory."""
        self._board.close()


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


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the whole rows of a log; a missing file has none."""
    if not path.exists():
        return []
    whole_lines = path.read_text().split("\n")[:-1]
    return [json.loads(line) for line in whole_lines]


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(row, sort_keys=True) + "\n"
