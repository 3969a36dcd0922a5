"""All that the first process writes down while a run goes on, but for checkpoints."""

from collections.abc import Mapping
from typing import Any

from train.evaluation.judge import Judge
from train.evaluation.validation_sheet import drawn_validation_sheet
from train.folder import RunFolder
from train.loop.board import Board
from train.loop.metrics_log import MetricsLog
from train.loop.state import TrainState
from train.progress import TrainProgress
from train.settings import TrainSettings


class Recorder:
    """metrics.jsonl, TensorBoard and whoever watches."""

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
