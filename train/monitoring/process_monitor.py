"""Monitoring of one training process: hooks for steps, pauses and windows of the loop."""

import json
import os
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from train.folder import RunFolder
from train.loop.distributed import DistributedContext
from train.loop.step import Stepper, StepReport
from train.monitoring.profiler import StepProfiler
from train.monitoring.settings import WatchSettings
from train.monitoring.spikes import Spike, SpikeDetector
from train.monitoring.watchdog import Watchdog
from train.settings import TrainSettings


class ProcessMonitor:
    """Monitors every step of this process, and exchanges statistics once a window."""

    def __init__(
        self,
        settings: TrainSettings,
        watched: WatchSettings,
        stepper: Stepper,
        dist_context: DistributedContext,
        folder: RunFolder,
        *,
        note: Callable[[str], None],
        report_hang: Callable[[str], None],
    ) -> None:
        """Create the monitors; `note` and `report_hang` are as in `Watchdog`."""
        self._settings = settings
        self._dist_context = dist_context
        self._activity = stepper.activity
        self._layers = stepper.layers
        self._spikes = SpikeDetector(watched.spike_bound)
        self._spikes_found: list[Spike] = []
        self._steps = 0
        self._named_rank: int | None = None
        self._note = note
        traced = watched.profile if dist_context.is_first else 0
        self._profiler = StepProfiler(traced, dist_context.device, folder.monitoring, note)
        self._watchdog = Watchdog(
            watched,
            self._activity,
            dist_context,
            folder.monitoring,
            note=note,
            report_hang=report_hang,
        )
        self._step = 0

    def __enter__(self) -> "ProcessMonitor":
        self._watchdog.__enter__()
        self._activity.pop_seconds()  # drop the time before the first step
        return self

    def __exit__(self, *error: object) -> None:
        self._watchdog.__exit__(*error)
        self._profiler.close(self._step)

    def begin_step(self, step: int) -> None:
        """Begin a step, counted from 1."""
        self._step = step
        self._watchdog.begin("step", step)
        self._profiler.begin_step(step)
        self._layers.expect_update(self._dist_context.is_first and self.is_window_end(step))

    def end_step(self) -> None:
        """End the step on the host; a GPU may still work on it."""
        self._steps += 1
        self._profiler.end_step(self._step)

    def add_report(self, step: int, report: StepReport, keys: Sequence[str]) -> None:
        """Check the report of a step; `keys` are those of this process's scenes."""
        self._spikes_found += self._spikes.add(step, report, keys)

    def is_window_end(self, step: int) -> bool:
        """Return whether a row of the log is written after a step."""
        return step == self._settings.num_steps or step % self._settings.log_every == 0

    @contextmanager
    def pause(self, part: str) -> Iterator[None]:
        """Time a block as `validation` or `saving`, in all processes, though one does the work."""
        self._watchdog.begin(part, self._step)
        with self._activity.during(part):
            yield

    def exchange(self) -> AbstractContextManager[None]:
        """Time a block as waiting for the other processes."""
        return self._activity.during("exchange")

    def end_window(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """End a window; return additional values of its row, and rows of spikes.

        All processes must call it. The values: `time_s`, seconds of the window by phase
        (monitoring.activity); `memory_mb`; `layers` (monitoring.layers); and with several processes
        `own_s`, the seconds of a step that each spent on its own work.
        """
        taken_s = self._activity.pop_seconds()
        row: dict[str, Any] = {
            "time_s": {part: round(seconds, 4) for part, seconds in taken_s.items()},
            "memory_mb": memory_mb(self._dist_context.device),
            "layers": self._layers.pop_row(),
        }
        own_s = own_seconds(taken_s, self._steps)
        ours = {"own_s": round(own_s, 4), "spikes": [asdict(spike) for spike in self._spikes_found]}
        self._steps = 0
        self._spikes_found = []
        with self.exchange():
            texts = self._dist_context.gather_text(json.dumps(ours))
        by_rank = [json.loads(text) for text in texts]
        if self._dist_context.world_size > 1:
            row["own_s"] = [said["own_s"] for said in by_rank]
            self._note_slow_rank(row["own_s"])
        return row, _merge_spikes([said["spikes"] for said in by_rank])

    def _note_slow_rank(self, own_s: Sequence[float]) -> None:
        """Report a process that the others wait for, once until another one is the slowest."""
        rank = slowest_rank(own_s)
        if rank is not None and rank != self._named_rank:
            self._note(
                f"process {rank} of {len(own_s)} is the slow one: {own_s[rank]:.2g} s of its own "
                f"in each of the last steps, the fastest {min(own_s):.2g} s; all wait for it"
            )
        self._named_rank = rank


def _merge_spikes(by_rank: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Merge the spikes of all processes, which have equal values and different scenes."""
    rows = []
    for spike in by_rank[0]:
        alike = [
            other["keys"]
            for rows_of_rank in by_rank
            for other in rows_of_rank
            if (other["step"], other["what"]) == (spike["step"], spike["what"])
        ]
        keys = [key for of_rank in alike for key in of_rank]
        rest = {name: spike[name] for name in ("what", "value", "bound")}
        rows.append({"step": spike["step"], "spike": {**rest, "keys": keys}})
    return rows


_STATM = Path("/proc/self/statm")


def memory_mb(device: torch.device) -> dict[str, float]:
    """Return memory use in megabytes (1e6 bytes) by name.

    `process`: resident memory of the process, shared libraries included; on Linux only.
    `device_peak`: peak of the tensors on a GPU since the last call, from the host's own counts.
    """
    megabytes = {}
    if _STATM.exists():
        pages = int(_STATM.read_text().split()[1])
        megabytes["process"] = round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
    if device.type == "cuda" and torch.cuda.is_initialized():
        megabytes["device_peak"] = round(torch.cuda.max_memory_allocated(device) / 1e6, 1)
        torch.cuda.reset_peak_memory_stats(device)
    return megabytes


OWN_PHASES = ("data", "forward", "backward", "device", "optimiser", "other")
"""Phases that do not wait for another process. On a GPU `device` does, since the exchange of
gradients is the GPU's work: there only `data` and host time reveal a slow process."""

SLOW_FACTOR = 1.5
"""Multiple of the others' median time from which a process counts as slow."""

LEAST_LOST_S = 0.05
"""Minimum seconds per step that a slow process costs before it is reported."""


def own_seconds(taken_s: Mapping[str, float], steps: int) -> float:
    """Return the seconds per step that a process spent on its own work."""
    return sum(taken_s[part] for part in OWN_PHASES) / max(steps, 1)


def slowest_rank(own_s: Sequence[float]) -> int | None:
    """Return the rank that all others wait for, or None if no process is slow."""
    if len(own_s) < 2:
        return None
    worst = max(range(len(own_s)), key=own_s.__getitem__)
    typical_s = statistics.median(value for rank, value in enumerate(own_s) if rank != worst)
    stands_out = own_s[worst] > SLOW_FACTOR * typical_s and own_s[worst] - typical_s > LEAST_LOST_S
    return worst if stands_out else None
