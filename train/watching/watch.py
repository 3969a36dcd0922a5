"""All that watches one training process, as the loop calls it: at steps, at pauses, at windows."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from train.folder import RunFolder
from train.loop.crew import Crew
from train.loop.step import Stepper, StepReport
from train.settings import TrainSettings
from train.watching.process_memory import memory_mb
from train.watching.profiler import StepProfiler
from train.watching.ranks import own_seconds, slowest, told
from train.watching.settings import WatchSettings
from train.watching.spikes import Spike, SpikeWatch
from train.watching.watchdog import Watchdog


class Watch:
    """Sees every step of this process, and tells the other processes once a window."""

    def __init__(
        self,
        settings: TrainSettings,
        watched: WatchSettings,
        stepper: Stepper,
        crew: Crew,
        folder: RunFolder,
        *,
        noted: Callable[[str], None],
        hung: Callable[[str], None],
    ) -> None:
        """Take the run, what to look for, and who is told; see `Watchdog` for the last two."""
        self._settings, self._crew = settings, crew
        self._activity, self._layers = stepper.activity, stepper.layers
        self._spikes = SpikeWatch(watched.spike_bound)
        self._found: list[Spike] = []
        self._steps = 0
        self._named: int | None = None
        self._noted = noted
        traced = watched.profile if crew.is_first else 0
        self._profiler = StepProfiler(traced, crew.device, folder.watching, noted)
        self._dog = Watchdog(watched, self._activity, crew, folder.watching, noted=noted, hung=hung)
        self._step = 0

    def __enter__(self) -> "Watch":
        self._dog.__enter__()
        self._activity.taken()  # what passed before the first step belongs to none
        return self

    def __exit__(self, *error: object) -> None:
        self._dog.__exit__(*error)
        self._profiler.close(self._step)

    def begins(self, step: int) -> None:
        """Begin a step, from 1."""
        self._step = step
        self._dog.begins("step", step)
        self._profiler.begins(step)
        self._layers.expect(self._crew.is_first and self.ends_window(step))

    def ends(self) -> None:
        """End the step, as far as the host has to do with it."""
        self._steps += 1
        self._profiler.ends(self._step)

    def read(self, step: int, report: StepReport, keys: Sequence[str]) -> None:
        """Hear what a step did; `keys` are those of this process's scenes."""
        self._found += self._spikes.add(step, report, keys)

    def ends_window(self, step: int) -> bool:
        """Return whether a row of the log follows a step."""
        return step == self._settings.num_steps or step % self._settings.log_every == 0

    @contextmanager
    def pause(self, part: str) -> Iterator[None]:
        """Spend a block on `validation` or `saving`; in all processes, though one does it."""
        self._dog.begins(part, self._step)
        with self._activity.during(part):
            yield

    @contextmanager
    def exchange(self) -> Iterator[None]:
        """Spend a block on waiting for the other processes."""
        with self._activity.during("exchange"):
            yield

    def window(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """End a window: return what its row gets beside the rest, and rows of spikes.

        All processes must call it. In the row: `time_s`, seconds of the window by part
        (watching.activity); `memory_mb`; `layers` (watching.layers); and with several processes
        `own_s`, the seconds of a step that each spent on its own work.
        """
        taken_s = self._activity.taken()
        row: dict[str, Any] = {
            "time_s": {part: round(seconds, 4) for part, seconds in taken_s.items()},
            "memory_mb": memory_mb(self._crew.device),
            "layers": self._layers.row(),
        }
        own_s, found = own_seconds(taken_s, self._steps), self._found
        self._steps, self._found = 0, []
        spikes = [asdict(spike) for spike in found]
        with self.exchange():
            words = told(self._crew, {"own_s": round(own_s, 4), "spikes": spikes})
        if self._crew.world_size > 1:
            row["own_s"] = [said["own_s"] for said in words]
            self._name_slow(row["own_s"])
        return row, _joined([said["spikes"] for said in words])

    def _name_slow(self, own_s: Sequence[float]) -> None:
        """Name a process that the others wait for, once until another one is the slow one."""
        rank = slowest(own_s)
        if rank is not None and rank != self._named:
            self._noted(
                f"process {rank} of {len(own_s)} is the slow one: {own_s[rank]:.2g} s of its own "
                f"in each of the last steps, the fastest {min(own_s):.2g} s; all wait for it"
            )
        self._named = rank


def _joined(by_rank: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return rows of spikes with the scenes of all processes, which see the same figures."""
    rows = []
    for spike in by_rank[0]:
        alike = [
            other["keys"]
            for found in by_rank
            for other in found
            if (other["step"], other["what"]) == (spike["step"], spike["what"])
        ]
        keys = [key for of_rank in alike for key in of_rank]
        rest = {name: spike[name] for name in ("what", "value", "bound")}
        rows.append({"step": spike["step"], "spike": {**rest, "keys": keys}})
    return rows
