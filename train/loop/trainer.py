"""The loop: step, log, validate, save, and stop when asked to."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from storage.errors import TrilightError
from train.data.buckets import bucket_scenes
from train.data.scenes import TrainingScene
from train.evaluation.judge import Judge
from train.folder import RunFolder
from train.loop.checkpoint import save_checkpoint
from train.loop.interrupts import deferred_interrupts
from train.loop.metrics_log import MetricsLog
from train.loop.optim import learning_rate
from train.loop.state import TrainState
from train.loop.step import StepReport, train_step
from train.progress import Progress
from train.settings import TrainSettings

MOST_SKIPPED_IN_A_ROW = 10
"""A few steps may overflow; this many say that the weights themselves are lost."""


@dataclass(kw_only=True)
class Window:
    """What happened since the last row of the log."""

    losses: list[float] = field(default_factory=list)
    """The finite ones."""
    steps: int = 0
    """Steps done."""
    began: float = field(default_factory=time.monotonic)
    """Clock at its start."""
    waited_s: float = 0.0
    """Time in which the network waited for data."""

    def seconds(self) -> float:
        """Return its length so far, above 0."""
        return max(time.monotonic() - self.began, 1e-9)


class Trainer:
    """Drives one run from the state's step to its last one."""

    def __init__(
        self,
        *,
        state: TrainState,
        settings: TrainSettings,
        folder: RunFolder,
        data_digest: str,
        judge: Judge,
        progress: Progress,
    ) -> None:
        self.state = state
        self.settings = settings
        self.folder = folder
        self.data_digest = data_digest
        self.judge = judge
        self.progress = progress
        self.log = MetricsLog(folder.metrics, first_step=state.step)
        self.window = Window()
        self.skipped_in_a_row = 0

    def run(self, batches: Iterator[list[TrainingScene]]) -> None:
        """Take all remaining steps; `batches` begins with that of the state's step.

        Raises:
            TrilightError: a signal asked to stop (the state is saved), or the steps keep failing.
        """
        with deferred_interrupts() as asked_to_stop:
            while self.state.step < self.settings.num_steps:
                report = self._step(batches)
                self._after_step(report)
                if asked_to_stop() and self.state.step < self.settings.num_steps:
                    self._save()
                    raise TrilightError(
                        f"training: stopped at step {self.state.step} by a signal, nothing is "
                        "lost. Run the same command with --resume to go on."
                    )

    def _step(self, batches: Iterator[list[TrainingScene]]) -> StepReport:
        asked = time.monotonic()
        drawn = next(batches)
        self.window.waited_s += time.monotonic() - asked
        report = train_step(
            self.state.model,
            self.state.optimizer,
            bucket_scenes(drawn),
            resolution=self.settings.resolution,
            learning_rate=learning_rate(self.state.step, self.settings),
            grad_clip=self.settings.grad_clip,
        )
        self.state.step += 1
        if report.applied:
            self.skipped_in_a_row = 0
        else:
            self._skip()
        return report

    def _skip(self) -> None:
        self.state.skipped_steps += 1
        self.skipped_in_a_row += 1
        if self.skipped_in_a_row == MOST_SKIPPED_IN_A_ROW:
            raise TrilightError(
                f"training: {MOST_SKIPPED_IN_A_ROW} steps in a row up to step {self.state.step} "
                "had a loss or gradient that was not finite; the weights are unchanged by them. "
                "Start again with a lower learning_rate."
            )

    def _after_step(self, report: StepReport) -> None:
        settings, step = self.settings, self.state.step
        if math.isfinite(report.loss):
            self.window.losses.append(report.loss)
        self.window.steps += 1
        self.progress.advance(
            step=step,
            loss=report.loss,
            learning_rate=learning_rate(step - 1, settings),
            views_per_s=self._views_per_s(),
        )
        last = step == settings.num_steps
        if last or step % settings.log_every == 0:
            self._write_row(report)
        if last or step % settings.validate_every == 0:
            self._validate()
        if last or step % settings.checkpoint_every == 0:
            self._save()

    def _views_per_s(self) -> float:
        views = self.window.steps * self.settings.scenes_per_step * self.settings.views_per_scene
        return views / self.window.seconds()

    def _write_row(self, report: StepReport) -> None:
        losses = self.window.losses
        self.log.append(
            {
                "step": self.state.step,
                "loss": sum(losses) / len(losses) if losses else None,
                "learning_rate": learning_rate(self.state.step - 1, self.settings),
                "grad_norm": report.grad_norm if math.isfinite(report.grad_norm) else None,
                "skipped_steps": self.state.skipped_steps,
                "views_per_s": self._views_per_s(),
                "data_wait_share": self.window.waited_s / self.window.seconds(),
            }
        )
        self.window = Window()

    def _validate(self) -> None:
        scores = self.judge.judge(self.state.model).scores
        self.log.append({"step": self.state.step, "validation": scores})
        self.progress.validated(step=self.state.step, scores=scores)
        self.window.began = time.monotonic()

    def _save(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.state, self.settings, self.data_digest)
