"""Training loop: step, log, validate, save, and stop on a signal.

A step is launched, and later synced: until then it is in `Trainer.pending`. Steps are synced at
once on a CPU, at each row of the log on a GPU, and before every validation and checkpoint.
"""

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache

import torch

from model.costs import Workload, training_flops
from model.precision import PRECISIONS
from storage.errors import TrilightError
from train.data.buckets import CopyStream, StepScenes
from train.folder import RunFolder
from train.loop.checkpoints import BackgroundWriter, save_checkpoint
from train.loop.distributed import DistributedContext
from train.loop.interrupts import Stopped, ValidationInterrupted, deferred_interrupts
from train.loop.recorder import Recorder
from train.loop.step import PendingStats, Stepper, StepReport, explain_out_of_memory
from train.loop.train_state import TrainState
from train.loss.training_loss import TrainingLoss
from train.monitoring.process_monitor import (
    Spike,
    SpikeDetector,
    Watchdog,
    memory_mb,
    merge_spikes,
    own_seconds,
    profiled_steps,
    slowest_rank,
)
from train.progress import TrainProgress
from train.settings import TrainSettings, WatchSettings, decay_start_step, learning_rate


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
        found_spikes: spikes since the last row of the log.
        slow_rank: process that the last row of the log found slow; None for none.
        window_steps: steps since the last row of the log in this call.
        window_flops: FLOPs of this process's scenes in them, without padding.
        num_profiled: number of steps to trace with PyTorch's profiler.
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
        self.activity = self.stepper.activity
        self.pending: list[_PendingStep] = []
        self.asked_to_stop = False
        self.num_reported_bad = 0
        self.saved_step: int | None = None
        self.writing = BackgroundWriter()
        self.progress = TrainProgress() if recorder is None else recorder.progress
        self.spikes = SpikeDetector(watched.spike_bound)
        self.found_spikes: list[Spike] = []
        self.slow_rank: int | None = None
        self.window_steps = 0
        self.window_flops = 0.0
        self.num_profiled = watched.profile if dist_context.is_first else 0
        self.watchdog = Watchdog(
            watched,
            self.activity,
            dist_context,
            folder.monitoring,
            note=self._note,
            report_hang=self.progress.report_hang,
        )

    def train(self, steps: Iterator[StepScenes]) -> None:
        """Take all remaining steps; `steps` begins with that of the state's step.

        Raises:
            TrilightError: a signal stops the run or the start is dead (the state is saved), or too
                many steps in a row fail.
        """
        traces = self.num_profiled, self.state.step, self.dist_context.device
        with (
            profiled_steps(*traces, self.folder.monitoring, self._note) as end_step,
            self.watchdog,
            self.writing,
            deferred_interrupts(self.progress.report_interrupt) as asked_to_stop,
        ):
            self.activity.pop_seconds()  # drop the time before the first step
            self._catch_up(asked_to_stop)
            while self.state.step < self.settings.num_steps:
                self._step(steps, asked_to_stop)
                end_step()
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
            with self.activity.during("exchange"):
                stopping = self.dist_context.any(asked_to_stop())
        if stopping:
            self._save_and_raise(Stopped(self.state.step))

    def _save_and_raise(self, reason: TrilightError) -> None:
        with self._pause("saving"):
            if self.saved_step != self.state.step:
                self._save()
            self.writing.wait()
            # torchrun ends all processes with the first that ends, so wait for the file
            self.dist_context.barrier()
        raise reason

    def _step(self, steps: Iterator[StepScenes], asked_to_stop: Callable[[], bool]) -> None:
        settings = self.settings
        step = self.state.step
        self.watchdog.begin("step", step + 1)
        is_measured = self.dist_context.is_first and self._is_window_end(step + 1)
        self.stepper.layers.is_due = is_measured
        with self.activity.during("data"):
            scenes = next(steps)
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
        self.window_steps += 1
        self.window_flops += sum(scene_flops(settings, count) for count in scenes.num_triangles)
        self.state.step += 1
        self.pending.append((self.state.step, scenes.keys, stats))
        syncs = not self.stepper.defer_sync or self._is_window_end(self.state.step)
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
            self.found_spikes += self.spikes.add(step, report, keys)
            if report.applied:
                self.state.skipped_in_a_row = 0
            else:
                self._skip(step, keys)
        self.progress.advance(
            step=self.state.step,
            loss=reports[-1].loss,
            learning_rate=learning_rate(self.state.step - 1, self.settings),
            views_per_s=self._views_per_s(self.activity.working_seconds()),
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

    def _views_per_s(self, seconds: float) -> float:
        """Return the views of all processes per second since the last row of the log."""
        views = self.window_steps * self.settings.scenes_per_step * self.settings.views_per_scene
        return views / seconds

    def _is_window_end(self, step: int) -> bool:
        """Return whether a row of the log is written after a step."""
        return step == self.settings.num_steps or step % self.settings.log_every == 0

    @contextmanager
    def _pause(self, part: str) -> Iterator[None]:
        """Time a block as `validation` or `saving`, in all processes, though one does the work."""
        self.watchdog.begin(part, self.state.step)
        with self.activity.during(part):
            yield

    def _is_validation_due(self) -> bool:
        """Return whether the state's step is followed by a validation."""
        step = self.state.step
        settings = self.settings
        return step == settings.num_steps or step % settings.validate_every == 0

    def _validate(self, asked_to_stop: Callable[[], bool]) -> None:
        def between() -> None:
            if asked_to_stop():
                raise ValidationInterrupted

        with self._pause("validation"), suppress(ValidationInterrupted):
            if self.recorder is not None:
                self.recorder.validate(self.state, between)

    def _after_step(self, asked_to_stop: Callable[[], bool]) -> bool:
        """Log, validate and save if due; return whether the processes waited for each other."""
        settings = self.settings
        step = self.state.step
        if self._is_window_end(step):
            self._end_window()
        validates = self._is_validation_due()
        last = step == settings.num_steps
        saves = last or step % settings.checkpoint_every == 0 or step == decay_start_step(settings)
        if validates or saves:
            self._sync()  # the GPU's work on steps must not count as a pause
        if validates:
            self._validate(asked_to_stop)
        if saves:
            with self._pause("saving"):
                self._save()
        return validates or saves

    def _end_window(self) -> None:
        """Exchange statistics with the other processes, and write the row of the log."""
        working_s = self.activity.working_seconds()
        taken_s = self.activity.pop_seconds()
        ours = {
            "own_s": round(own_seconds(taken_s, self.window_steps), 4),
            "spikes": self.found_spikes,
        }
        with self.activity.during("exchange"):
            texts = self.dist_context.gather_text(json.dumps(ours))
        by_rank = [json.loads(text) for text in texts]
        own_s = [said["own_s"] for said in by_rank] if len(by_rank) > 1 else []
        self._note_slow_rank(own_s)
        if self.recorder is not None:
            for spike in merge_spikes([said["spikes"] for said in by_rank]):
                self.recorder.row(spike)
            device = self.dist_context.device
            flops_per_s = self.window_flops / working_s
            reports = self.state.reports
            row = {
                "step": self.state.step,
                "learning_rate": learning_rate(self.state.step - 1, self.settings),
                "skipped_steps": self.state.skipped_steps,
                "loss": _finite_mean(report.loss for report in reports),
                "l1": _finite_mean(report.l1 for report in reports),
                "grad_norm": _finite_mean(report.grad_norm for report in reports),
                "views_per_s": self._views_per_s(working_s),
                "data_wait_share": taken_s["data"] / working_s,
                "flops_per_s": flops_per_s,
                "peak_share": flops_per_s
                / device_peak(device, PRECISIONS[self.settings.precision].dtype),
            }
            assert all(value is None or math.isfinite(value) for value in row.values())
            seen = {
                "time_s": {part: round(seconds, 4) for part, seconds in taken_s.items()},
                "memory_mb": memory_mb(device),
                "layers": self.stepper.layers.pop_row(),
                **({"own_s": own_s} if own_s else {}),
            }
            self.recorder.row({**row, **seen})
        self.state.reports = []
        self.found_spikes = []
        self.window_steps = 0
        self.window_flops = 0.0

    def _note_slow_rank(self, own_s: Sequence[float]) -> None:
        """Report a process that the others wait for, once until another one is the slowest."""
        rank = slowest_rank(own_s)
        if rank is not None and rank != self.slow_rank:
            self._note(
                f"process {rank} of {len(own_s)} is the slow one: {own_s[rank]:.2g} s of its own "
                f"in each of the last steps, the fastest {min(own_s):.2g} s; all wait for it"
            )
        self.slow_rank = rank

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
