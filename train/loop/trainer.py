"""The loop: step, log, validate, save, and stop when asked to."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch

from model.costs import Workload, training_flops
from storage.errors import TrilightError
from train.data.arrival import CopyStream, StepScenes
from train.folder import RunFolder
from train.loop.background import Background
from train.loop.checkpoints import keep_checkpoint
from train.loop.crew import Crew
from train.loop.enough_memory import enough_memory
from train.loop.interrupts import Stopped, ValidationLeft, deferred_interrupts
from train.loop.recorder import Recorder
from train.loop.schedule import decay_begins, learning_rate
from train.loop.state import TrainState
from train.loop.step import Stepper, StepReport, Unread
from train.loop.window import Window, device_peak
from train.loss.objective import Objective
from train.progress import TrainProgress
from train.settings import TrainSettings
from train.watching.settings import WatchSettings
from train.watching.watch import Watch

WATCHED_STEPS = 50
"""Number of steps after the warm-up that are looked at, once."""

DEAD_BRIGHTNESS = 0.01
"""Pictures with less than this share of the targets' brightness are black in all but name. The L1
error does not tell: a fast start overshoots, and is then worse than black while it learns."""


class StartWatch:
    """Notices a run whose pictures stay black in the first steps after the warm-up.

    An output that is pushed below 0 can lose its gradient for good: with the loss behind the ELU
    six of nine small runs ended so. Ours is taken before it and none has, but a wrong setting can
    still do it, and a night later is too late to hear of it.
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.due = settings.warmup_steps + WATCHED_STEPS
        self._reports: deque[StepReport] = deque(maxlen=WATCHED_STEPS)
        self._is_judged = False

    def add(self, step: int, report: StepReport) -> None:
        """Look at one step, from 1, when it is known what it did."""
        if step <= self.due:
            self._reports.append(report)

    def verdict(self, step: int) -> TrilightError | None:
        """Return the error if the start is dead, looked at once, after `due` steps; else None.

        A run that is resumed after that step is not looked at again. `step` is the last one of
        which it is known what it did.
        """
        if step < self.due or self._is_judged:
            return None
        self._is_judged = True
        if len(self._reports) < WATCHED_STEPS:
            return None
        brightest = max(report.brightness for report in self._reports)
        if not brightest < DEAD_BRIGHTNESS:
            return None
        return TrilightError(
            f"training: collapsed at the start: after {step} steps the pictures are still black, "
            f"with at most {brightest:.2%} of the brightness of their targets. Start again with "
            "another seed or learning_rate; --resume continues all the same."
        )


PRODUCTS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""Types of the network's products, by `precision`."""
MOST_SKIPPED_IN_A_ROW = 10
"""A few steps may overflow; this many in a row mean that the weights themselves are lost."""


MOST_UNREAD = 100
"""Steps after which a card is waited for, however rare the rows of the log are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Taken:
    """A step that was taken, and of which the host does not know yet what it did."""

    step: int
    """Its number, from 1."""
    keys: Sequence[str]
    """Of this process's scenes."""
    unread: Unread
    """What will be read."""


def scene_flops(settings: TrainSettings, num_triangles: int) -> int:
    """Return what a scene of so many triangles costs in a step of a run."""
    workload = Workload(
        triangles=num_triangles,
        views=settings.views_per_scene,
        resolution=settings.resolution,
    )
    return training_flops(settings.model, workload)


class Trainer:
    """Drives one run from the state's step to its last one, in step with the other processes."""

    def __init__(
        self,
        *,
        state: TrainState,
        settings: TrainSettings,
        objective: Objective,
        crew: Crew,
        folder: RunFolder,
        data_digest: str,
        recorder: Recorder | None,
        watched: WatchSettings | None = None,
    ) -> None:
        """Take the parts; the recorder is the first process's, None in the others."""
        self.state = state
        self.settings = settings
        self.crew = crew
        self.folder = folder
        self.data_digest = data_digest
        self.recorder = recorder
        self.stepper = Stepper(state, settings, objective, crew)
        self.copies = CopyStream(crew.device)
        self.start_watch = StartWatch(settings)
        self.window = Window(state.reports)
        self.taken: list[_Taken] = []
        self.asked_to_stop = False
        self.num_noted = 0
        self.saved_step: int | None = None
        self.writing = Background()
        progress = TrainProgress() if recorder is None else recorder.progress
        self.progress = progress
        self.watch = Watch(
            settings,
            watched or WatchSettings(),
            self.stepper,
            crew,
            folder,
            noted=self._note,
            hung=progress.hung,
        )

    def run(self, steps: Iterator[StepScenes]) -> None:
        """Take all remaining steps; `steps` begins with that of the state's step.

        Raises:
            TrilightError: a signal asked to stop or the start went dead (the state is saved), or
                the steps keep failing.
        """
        with (
            self.watch,
            self.writing,
            deferred_interrupts(self.progress.interrupted) as asked_to_stop,
        ):
            self._catch_up(asked_to_stop)
            while self.state.step < self.settings.num_steps:
                self._step(steps, asked_to_stop)
                waited = self._after_step(asked_to_stop)
                self._leave_if_asked(asked_to_stop, together=waited)
                if self.state.step == self.settings.num_steps:
                    return
                if not self.taken and (verdict := self.start_watch.verdict(self.state.step)):
                    self._leave(verdict)

    def _catch_up(self, asked_to_stop: Callable[[], bool]) -> None:
        """Make up for the validation that a signal ended, after which the state was saved."""
        if self.state.step == 0 or not self._validates():
            return
        missing = self.recorder is not None and not self.recorder.has_validated(self.state.step)
        if self.crew.any(missing):
            self._validate(asked_to_stop)
            self._leave_if_asked(asked_to_stop, together=True)

    def _leave_if_asked(self, asked_to_stop: Callable[[], bool], *, together: bool) -> None:
        """Leave where a process was asked to; all stop at the same step.

        One may be signalled before another. Several are told with what a step did, when that is
        read; `together` they tell each other now, which waits.
        """
        stopping = self.asked_to_stop
        if together or self.crew.world_size == 1:
            with self.watch.exchange():
                stopping = self.crew.any(asked_to_stop())
        if stopping:
            self._leave(Stopped(self.state.step))

    def _leave(self, reason: TrilightError) -> None:
        with self.watch.pause("saving"):
            if self.saved_step != self.state.step:
                self._save()
            self.writing.wait()
            # a barrier: torchrun ends all processes with the first that ends, so wait for the file
            self.crew.any(False)
        raise reason

    def _step(self, steps: Iterator[StepScenes], asked_to_stop: Callable[[], bool]) -> None:
        self.watch.begins(self.state.step + 1)
        self.stepper.activity.begin("data")
        asked = time.monotonic()
        drawn = next(steps)
        waited_s = time.monotonic() - asked
        self.stepper.activity.begin("other")
        settings, step = self.settings, self.state.step
        with enough_memory(settings, step):
            batches, rate = self.copies.send(drawn.batches), learning_rate(step, settings)
            unread = self.stepper.take(batches, rate, asked_to_stop=asked_to_stop())
        self._note_unusable()
        while self.stepper.remarks:
            self._note(self.stepper.remarks.pop(0))
        self.window.spend(
            views=settings.scenes_per_step * settings.views_per_scene,
            waited_s=waited_s,
            flops=sum(scene_flops(settings, count) for count in drawn.num_triangles),
        )
        self.state.step += 1
        self.watch.ends()
        self.taken.append(_Taken(step=self.state.step, keys=drawn.keys, unread=unread))
        known = not self.stepper.is_late or self.watch.ends_window(self.state.step)
        if known or len(self.taken) == MOST_UNREAD:
            self._read()

    def _read(self) -> None:
        """Learn what the steps did that were taken since the last time; waits for them."""
        taken, self.taken = self.taken, []
        if not taken:
            return
        read = self.stepper.read([each.unread for each in taken])
        self.asked_to_stop = read.asked_to_stop
        for each, report in zip(taken, read.reports, strict=True):
            self.window.add(report)
            self.start_watch.add(each.step, report)
            self.watch.read(each.step, report, each.keys)
            if report.applied:
                self.state.skipped_in_a_row = 0
            else:
                self._skip(each)
        self.progress.advance(
            step=self.state.step,
            loss=read.reports[-1].loss,
            learning_rate=learning_rate(self.state.step - 1, self.settings),
            views_per_s=self.window.views_per_s,
        )

    def _note_unusable(self) -> None:
        """Name each damaged sample or shard once, when it has been left out."""
        messages = self.state.unusable.messages
        for message in messages[self.num_noted :]:
            self._note(f"left out: {message.rstrip('.')}")
        self.num_noted = len(messages)

    def _skip(self, taken: _Taken) -> None:
        """Count a skipped step, and name this process's scenes."""
        self.state.skipped_steps += 1
        self._note(
            f"step {taken.step} was skipped, since its loss or gradient was not finite; "
            f"its scenes were {', '.join(taken.keys)}",
            taken.step,
        )
        self.state.skipped_in_a_row += 1
        if self.state.skipped_in_a_row == MOST_SKIPPED_IN_A_ROW:
            raise TrilightError(
                f"training: {MOST_SKIPPED_IN_A_ROW} steps in a row up to step {taken.step} "
                "had a loss or gradient that was not finite; the weights are unchanged by them. "
                "Resumed as it is, it would come here again. Go on with --resume --change "
                f"learning_rate={self.settings.learning_rate / 2:g}, or with another order of the "
                f"data, --change seed={self.settings.seed + 1}; or from an earlier checkpoint in "
                "another folder, --branch."
            )

    def _validates(self) -> bool:
        """Return whether a validation follows the state's step."""
        step, settings = self.state.step, self.settings
        return step == settings.num_steps or step % settings.validate_every == 0

    def _validate(self, asked_to_stop: Callable[[], bool]) -> None:
        def between() -> None:
            if asked_to_stop():
                raise ValidationLeft

        with self.window.pause(), self.watch.pause("validation"), suppress(ValidationLeft):
            if self.recorder is not None:
                self.recorder.validate(self.state, between)

    def _after_step(self, asked_to_stop: Callable[[], bool]) -> bool:
        """Do what is due after a step; return whether the processes waited for each other."""
        settings, step = self.settings, self.state.step
        if self.watch.ends_window(step):
            self._end_window()
        validates = self._validates()
        last = step == settings.num_steps
        saves = last or step % settings.checkpoint_every == 0 or step == decay_begins(settings)
        if validates or saves:
            self._read()  # a card's work on steps counts as such, and not as a pause
        if validates:
            self._validate(asked_to_stop)
        if saves:
            with self.window.pause(), self.watch.pause("saving"):
                self._save()
        return validates or saves

    def _end_window(self) -> None:
        """Exchange what was seen since the last window, and write the row."""
        seen, spikes = self.watch.window()
        if self.recorder is not None:
            self._write_window(self.recorder, seen, spikes)
        self.state.reports = []
        self.window = Window(self.state.reports)

    def _write_window(
        self, recorder: Recorder, seen: Mapping[str, Any], spikes: Sequence[Mapping[str, Any]]
    ) -> None:
        for spike in spikes:
            recorder.row(spike)
        peak = device_peak(self.crew.device, PRODUCTS[self.settings.precision])
        row = {
            "step": self.state.step,
            "learning_rate": learning_rate(self.state.step - 1, self.settings),
            "skipped_steps": self.state.skipped_steps,
            **self.window.row(peak),
        }
        assert all(value is None or math.isfinite(value) for value in row.values())
        recorder.row({**row, **seen})

    def _note(self, text: str, step: int | None = None) -> None:
        """Tell the user, in the first process; of the last step, unless said."""
        if self.recorder is not None:
            self.recorder.note(self.state.step if step is None else step, text)

    def _save(self) -> None:
        self._read()
        self.saved_step = self.state.step
        if self.crew.is_first:
            keep_checkpoint(
                self.folder.checkpoints,
                self.state,
                self.settings,
                data_digest=self.data_digest,
                world_size=self.crew.world_size,
                begin=self.writing.begin,
            )
