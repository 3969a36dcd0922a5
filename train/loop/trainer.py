"""Training loop: step, log, validate, save, and stop on a signal.

A step is launched, and later synced: until then it is in `Trainer.pending`. Steps are synced at
once on a CPU, at each row of the log on a GPU, and before every validation and checkpoint.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any

import torch

from model.costs import Workload, training_flops
from storage.errors import TrilightError
from train.data.buckets import CopyStream, StepScenes
from train.folder import RunFolder
from train.loop.checkpoints import BackgroundWriter, save_checkpoint
from train.loop.distributed import DistributedContext
from train.loop.interrupts import Stopped, ValidationInterrupted, deferred_interrupts
from train.loop.optimizer import PRODUCTS
from train.loop.recorder import Recorder
from train.loop.step import PendingStats, Stepper, StepReport, explain_out_of_memory
from train.loop.train_state import TrainState
from train.loss.training_loss import TrainingLoss
from train.monitoring.process_monitor import ProcessMonitor
from train.progress import TrainProgress
from train.settings import TrainSettings, WatchSettings, decay_start_step, learning_rate


class Window:
    """Accumulates steps until a row of the log is written."""

    def __init__(self, reports: list[StepReport]) -> None:
        """Begin with steps of an earlier call, whose losses count and whose time does not.

        Args:
            reports: reports of those steps, to which the caller appends further ones.
        """
        self._reports = reports
        self._began = time.monotonic()
        self.views = 0
        """Number of views over all processes."""
        self.waited_s = 0.0
        """Seconds in which the network waited for data."""
        self.flops = 0.0
        """FLOPs of this process's scenes, without padding."""

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Exclude the time of a block from the window's, for validation and checkpoints."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._began += time.monotonic() - began

    @property
    def views_per_s(self) -> float:
        """Views of all processes per second so far."""
        return self.views / self._seconds()

    def row(self, peak_flops_per_s: float) -> dict[str, Any]:
        """Return the log's values of these steps; a mean is None if no step was finite."""
        return {
            "loss": _finite_mean(report.loss for report in self._reports),
            "l1": _finite_mean(report.l1 for report in self._reports),
            "grad_norm": _finite_mean(report.grad_norm for report in self._reports),
            "views_per_s": self.views_per_s,
            "data_wait_share": self.waited_s / self._seconds(),
            "flops_per_s": self.flops / self._seconds(),
            "peak_share": self.flops / self._seconds() / peak_flops_per_s,
        }

    def _seconds(self) -> float:
        return max(time.monotonic() - self._began, 1e-9)


def _finite_mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


PEAK_WIDTH = {"cpu": 1024, "cuda": 8192}
"""Width of the square matrix product that measures a device's peak speed, by device type."""


@lru_cache
def device_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the FLOPs per second of a large square matrix product: the best of five.

    Measuring takes some milliseconds, once. The data sheet's figure is not used, since no program
    reaches it.
    """
    width = PEAK_WIDTH[device.type]
    matrix = torch.ones(width, width, dtype=dtype, device=device)
    best = float("inf")
    for _ in range(5):
        began = time.perf_counter()
        product = matrix @ matrix
        product[0, 0].item()  # waits until it is done
        best = min(best, time.perf_counter() - began)
    return 2 * width**3 / best


WATCHED_STEPS = 50
"""Number of steps after the warm-up whose pictures are checked, once."""

DEAD_BRIGHTNESS = 0.01
"""Fraction of the targets' brightness below which pictures count as black. The L1 error cannot
tell: a fast start overshoots, and is then worse than black while it learns."""


class DeadStartDetector:
    """Detects a run whose pictures stay black in the first steps after the warm-up.

    An output that is pushed below 0 can lose its gradient for good: with the loss after the ELU six
    of nine small runs ended so. Ours is taken before it and none has, but a wrong setting can still
    cause it, and would waste a night of training.
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.due = settings.warmup_steps + WATCHED_STEPS
        self._seen: list[float] = []

    def add(self, step: int, report: StepReport) -> None:
        """Add the report of one step, counted from 1."""
        if self.due - WATCHED_STEPS < step <= self.due:
            self._seen.append(report.brightness)

    def verdict(self, step: int) -> TrilightError | None:
        """Return the error of a dead start, checked once after `due` steps; else None.

        A run that is resumed after that step is not checked again. `step` is the last one whose
        report was added.
        """
        if step < self.due or len(self._seen) < WATCHED_STEPS:
            return None
        brightest = max(self._seen)
        self._seen = []
        if not brightest < DEAD_BRIGHTNESS:
            return None
        return TrilightError(
            f"training: collapsed at the start: after {step} steps the pictures are still black, "
            f"with at most {brightest:.2%} of the brightness of their targets. Start again with "
            "another seed or learning_rate; --resume continues all the same."
        )


MAX_SKIPPED_IN_A_ROW = 10
"""A few steps may overflow; this many in a row mean that the weights themselves are lost."""


MAX_PENDING = 100
"""Maximum number of pending steps before the GPU is synced, however rare rows of the log are."""


_PendingStep = tuple[int, Sequence[str], PendingStats]
"""A launched step that the host has not read yet: its number from 1, sample keys of this process's
scenes, and statistics, still on the device."""


def scene_flops(settings: TrainSettings, num_triangles: int) -> int:
    """Return the FLOPs of a scene with so many triangles in a training step."""
    workload = Workload(
        triangles=num_triangles,
        views=settings.views_per_scene,
        resolution=settings.resolution,
    )
    return training_flops(settings.model, workload)


class Trainer:
    """Training loop: runs all remaining steps, in lockstep with the other processes.

    Attributes:
        pending: launched steps that are not synced yet, oldest first.
        asked_to_stop: True once a synced step says that a process received a signal.
        saved_step: step of the last checkpoint of this call; None before the first.
        num_reported_bad: messages about damaged data that were already reported.
        dead_start: checks once, after the warm-up, that pictures are not black.
    """

    def __init__(
        self,
        state: TrainState,
        objective: TrainingLoss,
        dist_context: DistributedContext,
        folder: RunFolder,
        recorder: Recorder | None,
        watched: WatchSettings,
    ) -> None:
        """Create the trainer; `recorder` is None in all processes but the first."""
        self.state = state
        self.settings = settings = state.settings
        self.dist_context = dist_context
        self.folder = folder
        self.recorder = recorder
        self.stepper = Stepper(state, objective, dist_context)
        self.copies = CopyStream(dist_context.device)
        self.dead_start = DeadStartDetector(settings)
        self.window = Window(state.reports)
        self.pending: list[_PendingStep] = []
        self.asked_to_stop = False
        self.num_reported_bad = 0
        self.saved_step: int | None = None
        self.writing = BackgroundWriter()
        progress = TrainProgress() if recorder is None else recorder.progress
        self.progress = progress
        self.watch = ProcessMonitor(
            settings,
            watched,
            self.stepper,
            dist_context,
            folder,
            note=self._note,
            report_hang=progress.report_hang,
        )

    def train(self, steps: Iterator[StepScenes]) -> None:
        """Take all remaining steps; `steps` begins with that of the state's step.

        Raises:
            TrilightError: a signal stops the run or the start is dead (the state is saved), or too
                many steps in a row fail.
        """
        with (
            self.watch,
            self.writing,
            deferred_interrupts(self.progress.report_interrupt) as asked_to_stop,
        ):
            self._catch_up(asked_to_stop)
            while self.state.step < self.settings.num_steps:
                self._step(steps, asked_to_stop)
                waited = self._after_step(asked_to_stop)
                self._stop_if_asked(asked_to_stop, together=waited)
                if self.state.step == self.settings.num_steps:
                    return
                if not self.pending and (verdict := self.dead_start.verdict(self.state.step)):
                    self._save_and_raise(verdict)

    def _catch_up(self, asked_to_stop: Callable[[], bool]) -> None:
        """Repeat the validation that a signal interrupted before the state was saved."""
        if self.state.step == 0 or not self._is_validation_due():
            return
        missing = self.recorder is not None and not self.recorder.has_validated(self.state.step)
        if self.dist_context.any(missing):
            self._validate(asked_to_stop)
            self._stop_if_asked(asked_to_stop, together=True)

    def _stop_if_asked(self, asked_to_stop: Callable[[], bool], *, together: bool) -> None:
        """Save and stop if any process received a signal; all stop at the same step.

        One process may be signaled before another. Several processes exchange the flag with the
        statistics of a step; with `together` they exchange it now, which waits.
        """
        stopping = self.asked_to_stop
        if together or self.dist_context.world_size == 1:
            with self.watch.exchange():
                stopping = self.dist_context.any(asked_to_stop())
        if stopping:
            self._save_and_raise(Stopped(self.state.step))

    def _save_and_raise(self, reason: TrilightError) -> None:
        with self.watch.pause("saving"):
            if self.saved_step != self.state.step:
                self._save()
            self.writing.wait()
            # torchrun ends all processes with the first that ends, so wait for the file
            self.dist_context.barrier()
        raise reason

    def _step(self, steps: Iterator[StepScenes], asked_to_stop: Callable[[], bool]) -> None:
        self.watch.begin_step(self.state.step + 1)
        self.stepper.activity.begin("data")
        wait_began_s = time.monotonic()
        scenes = next(steps)
        waited_s = time.monotonic() - wait_began_s
        self.stepper.activity.begin("other")
        settings = self.settings
        step = self.state.step
        with explain_out_of_memory(settings, step):
            batches = self.copies.send(scenes.batches)
            rate = learning_rate(step, settings)
            stats = self.stepper.launch(batches, rate, asked_to_stop=asked_to_stop())
        messages = self.state.bad_samples.messages
        for message in messages[self.num_reported_bad :]:
            self._note(f"left out: {message.rstrip('.')}")
        self.num_reported_bad = len(messages)
        while self.stepper.remarks:
            self._note(self.stepper.remarks.pop(0))
        self.window.views += settings.scenes_per_step * settings.views_per_scene
        self.window.waited_s += waited_s
        self.window.flops += sum(scene_flops(settings, count) for count in scenes.num_triangles)
        self.state.step += 1
        self.watch.end_step()
        self.pending.append((self.state.step, scenes.keys, stats))
        syncs = not self.stepper.defer_sync or self.watch.is_window_end(self.state.step)
        if syncs or len(self.pending) == MAX_PENDING:
            self._sync()

    def _sync(self) -> None:
        """Wait for the pending steps, and process their reports."""
        pending = self.pending
        self.pending = []
        if not pending:
            return
        reports, self.asked_to_stop = self.stepper.sync([stats for _, _, stats in pending])
        for (step, keys, _), report in zip(pending, reports, strict=True):
            self.state.reports.append(report)
            self.dead_start.add(step, report)
            self.watch.add_report(step, report, keys)
            if report.applied:
                self.state.skipped_in_a_row = 0
            else:
                self._skip(step, keys)
        self.progress.advance(
            step=self.state.step,
            loss=reports[-1].loss,
            learning_rate=learning_rate(self.state.step - 1, self.settings),
            views_per_s=self.window.views_per_s,
        )

    def _skip(self, step: int, keys: Sequence[str]) -> None:
        """Count a skipped step and report its scenes; raise after too many in a row."""
        self.state.skipped_steps += 1
        self._note(
            f"step {step} was skipped, since its loss or gradient was not finite; "
            f"its scenes were {', '.join(keys)}",
            step,
        )
        self.state.skipped_in_a_row += 1
        if self.state.skipped_in_a_row == MAX_SKIPPED_IN_A_ROW:
            raise TrilightError(
                f"training: {MAX_SKIPPED_IN_A_ROW} steps in a row up to step {step} "
                "had a loss or gradient that was not finite; the weights are unchanged by them. "
                "Resumed as it is, it would come here again. Go on with --resume --change "
                f"learning_rate={self.settings.learning_rate / 2:g}, or with another order of the "
                f"data, --change seed={self.settings.seed + 1}; or from an earlier checkpoint in "
                "another folder, --branch."
            )

    def _is_validation_due(self) -> bool:
        """Return whether the state's step is followed by a validation."""
        step = self.state.step
        settings = self.settings
        return step == settings.num_steps or step % settings.validate_every == 0

    def _validate(self, asked_to_stop: Callable[[], bool]) -> None:
        def between() -> None:
            if asked_to_stop():
                raise ValidationInterrupted

        with self.window.pause(), self.watch.pause("validation"), suppress(ValidationInterrupted):
            if self.recorder is not None:
                self.recorder.validate(self.state, between)

    def _after_step(self, asked_to_stop: Callable[[], bool]) -> bool:
        """Log, validate and save if due; return whether the processes waited for each other."""
        settings = self.settings
        step = self.state.step
        if self.watch.is_window_end(step):
            self._end_window()
        validates = self._is_validation_due()
        last = step == settings.num_steps
        saves = last or step % settings.checkpoint_every == 0 or step == decay_start_step(settings)
        if validates or saves:
            self._sync()  # the GPU's work on steps must not count as a pause
        if validates:
            self._validate(asked_to_stop)
        if saves:
            with self.window.pause(), self.watch.pause("saving"):
                self._save()
        return validates or saves

    def _end_window(self) -> None:
        """Exchange statistics with the other processes, and write the row of the log."""
        seen, spikes = self.watch.end_window()
        if self.recorder is not None:
            for spike in spikes:
                self.recorder.row(spike)
            peak = device_peak(self.dist_context.device, PRODUCTS[self.settings.precision])
            row = {
                "step": self.state.step,
                "learning_rate": learning_rate(self.state.step - 1, self.settings),
                "skipped_steps": self.state.skipped_steps,
                **self.window.row(peak),
            }
            assert all(value is None or math.isfinite(value) for value in row.values())
            self.recorder.row({**row, **seen})
        self.state.reports = []
        self.window = Window(self.state.reports)

    def _note(self, text: str, step: int | None = None) -> None:
        """Report a note in the first process; by default about the last step."""
        if self.recorder is not None:
            self.recorder.note(self.state.step if step is None else step, text)

    def _save(self) -> None:
        self._sync()
        self.saved_step = self.state.step
        if self.dist_context.is_first:
            save_checkpoint(
                self.folder.checkpoints,
                self.state,
                world_size=self.dist_context.world_size,
                submit=self.writing.begin,
            )
