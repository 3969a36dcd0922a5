"""Monitoring of one training process: time, norms, spikes, traces, memory, slow processes, hangs.

Time is measured by phase, and norms by layer once a window. Spikes in loss and gradient norm are
recorded with the scenes that may cause them. Some steps are traced by PyTorch's profiler, in the
folder of the run. A watchdog detects hung steps and reports the stacks of every process.
"""

import faulthandler
import itertools
import math
import os
import re
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from storage.errors import TrilightError
from train.loop.distributed import DistributedContext
from train.settings import WatchSettings

if TYPE_CHECKING:
    from train.loop.step import StepReport

PHASES = {
    "data": "waiting for data",
    "forward": "forward pass and loss",
    "backward": "backward pass",
    "device": "waiting for the device",
    "exchange": "exchange with the other processes",
    "optimiser": "clipping and moving the weights",
    "validation": "validation",
    "saving": "saving a checkpoint",
    "other": "batching, counting and writing the log",
}
"""Description of each phase of training, by name."""


class Activity:
    """Timer of phases: each moment belongs to exactly one.

    It measures host time, and never waits for a device. On a CPU a phase is the time of its work. A
    GPU works asynchronously: `forward` and `backward` are then the time to enqueue kernels, and
    their work appears as `device`, where the host first waits for a result (with several processes
    also as `exchange`). `data` and `saving` mean the same everywhere.

    Another thread may read `now` at any time.
    """

    def __init__(self) -> None:
        self.now = ("other", time.monotonic())
        """Name of the phase in progress, one of PHASES, and its start."""
        self._taken_s = dict.fromkeys(PHASES, 0.0)

    def begin(self, phase: str) -> None:
        """End the current phase, and begin another."""
        moment_s = time.monotonic()
        before, since_s = self.now
        self._taken_s[before] += moment_s - since_s
        self.now = (phase, moment_s)

    @contextmanager
    def during(self, phase: str) -> Iterator[None]:
        """Assign the time of a block to a phase, then return to the previous one."""
        before, _ = self.now
        self.begin(phase)
        try:
            yield
        finally:
            self.begin(before)

    def working_seconds(self) -> float:
        """Return the seconds, above 0, since `pop_seconds` without validations and checkpoints."""
        self.begin(self.now[0])
        pauses_s = self._taken_s["validation"] + self._taken_s["saving"]
        return max(sum(self._taken_s.values()) - pauses_s, 1e-9)

    def pop_seconds(self) -> dict[str, float]:
        """Return the seconds of each phase since the last call, and reset them."""
        self.begin(self.now[0])
        taken_s = self._taken_s
        self._taken_s = dict.fromkeys(PHASES, 0.0)
        return taken_s


_GROUP = re.compile(r"[^.]+(\.[^.]+(\.\d+)?)?")
_DIGITS = 4


class LayerNorms:
    """Norms of one expected update; other updates cost nothing.

    The weights are copied during that update, after the activations were freed, so that peak memory
    does not rise. The norms stay on the device until the row of the log asks for them.
    """

    def __init__(self, model: nn.Module) -> None:
        self._groups: dict[str, list[nn.Parameter]] = {}
        for name, weight in model.named_parameters():
            self._groups.setdefault(layer_of(name), []).append(weight)
        self.is_due = False
        """True if the next update is measured."""
        self._norms: Tensor | None = None

    @contextmanager
    @torch.no_grad()
    def measured_update(self) -> Iterator[None]:
        """Measure the update in a block if it is due, without a wait for the device.

        The block begins when gradients are complete and not clipped yet.
        """
        if not self.is_due:
            yield
            return
        self.is_due = False
        groups = self._groups.values()
        grads = [_length([w.grad for w in group if w.grad is not None], group) for group in groups]
        before = [[weight.clone() for weight in group] for group in groups]
        yield
        columns = []
        for grad, weights, old_weights in zip(grads, groups, before, strict=True):
            length = _length(old_weights, weights)
            moved = [weight - old for weight, old in zip(weights, old_weights, strict=True)]
            ratio = _length(moved, weights) / length.clamp(min=torch.finfo(length.dtype).tiny)
            columns.append(torch.stack([grad, length, ratio]))
        self._norms = torch.stack(columns)

    def pop_row(self) -> dict[str, list[float | None]]:
        """Return LAYER_COLUMNS by layer of the measured update once; empty if there is none.

        It waits for the device. A number that is not finite is None.
        """
        if self._norms is None:
            return {}
        rows = self._norms.tolist()
        self._norms = None
        return {
            layer: [float(f"{each:.{_DIGITS}g}") if math.isfinite(each) else None for each in row]
            for layer, row in zip(self._groups, rows, strict=True)
        }


def layer_of(parameter: str) -> str:
    """Return the layer of a parameter, such as `encoder.layers.3` or `decoder.head`."""
    match = _GROUP.match(parameter)
    assert match is not None
    return match[0]


def _length(tensors: Sequence[Tensor], like: Sequence[Tensor]) -> Tensor:
    if not tensors:
        return torch.zeros((), device=like[0].device)
    return nn.utils.get_total_norm(tensors)


REMEMBERED = 200
"""Number of recent steps that a new one is compared with."""

LEAST_REMEMBERED = 40
"""Minimum number of recent steps; a median of fewer is unreliable."""

LEAST_DEVIATION = 0.02
"""Minimum standard deviation as a fraction of the median; otherwise a nearly constant loss would
spike at the smallest change."""

_MAD_TO_DEVIATION = 1.4826
"""Ratio of standard deviation to median absolute deviation of normal numbers."""


Spike = dict[str, Any]
"""Loss or gradient norm of a step above its bound: the `step`, from 1; `what`, `loss` or
`grad_norm`; its `value` and upper `bound`; and `keys`, of this process's samples in the step."""


class SpikeDetector:
    """Compares each step with the median of recent ones, in robust standard deviations.

    A median is robust to earlier spikes, and a falling loss, as at the start of a training, is no
    spike. Steps that are not finite are ignored here: they are skipped and reported elsewhere.
    """

    def __init__(self, deviations: float) -> None:
        self._deviations = deviations
        self._recent = {what: deque[float](maxlen=REMEMBERED) for what in ("loss", "grad_norm")}

    def add(self, step: int, report: "StepReport", keys: Sequence[str]) -> list[Spike]:
        """Add a step, counted from 1, and return its spikes."""
        spikes = list[Spike]()
        for what, recent in self._recent.items():
            value = getattr(report, what)
            if not math.isfinite(value):
                continue
            bound = spike_bound(recent, self._deviations)
            if bound is not None and value > bound:
                spike = {"step": step, "what": what, "value": value, "bound": bound}
                spikes.append({**spike, "keys": list(keys)})
            recent.append(value)
        return spikes


def spike_bound(recent: Sequence[float], deviations: float) -> float | None:
    """Return the median plus so many robust deviations, or None for too few values."""
    if len(recent) < LEAST_REMEMBERED:
        return None
    median = statistics.median(recent)
    spread = statistics.median(abs(value - median) for value in recent)
    deviation = max(_MAD_TO_DEVIATION * spread, LEAST_DEVIATION * abs(median))
    return median + deviations * deviation


SKIPPED_STEPS = 3
"""Number of warm-up steps of a call before the first one that is traced."""

_ROWS = 40


@contextmanager
def profiled_steps(
    steps: int, done: int, device: torch.device, folder: Path, note: Callable[[str], None]
) -> Iterator[Callable[[], None]]:
    """Trace some steps of a block, and yield the function that ends a step.

    A block that ends earlier leaves an incomplete trace.

    Args:
        steps: number of steps to trace; 0 traces none and costs nothing.
        done: number of steps before the block.
        folder: folder of the trace and the table.
        note: called with a message that names the files.
    """
    if not steps:
        yield lambda: None
        return
    from torch.profiler import ProfilerActivity, profile, schedule

    first = done + SKIPPED_STEPS + 1
    traces: list[Path] = []

    def write(profiler: Any) -> None:
        last = max(first, done + profiler.step_num)  # it may end within the first one
        trace = folder / f"profile-steps-{first}-to-{last}.json.gz"
        traces.append(trace)  # before anything can fail: there was something to write
        folder.mkdir(parents=True, exist_ok=True)
        table = trace.with_name(trace.name.replace(".json.gz", ".txt"))
        profiler.export_chrome_trace(str(trace))
        order = f"self_{device.type}_time_total"
        table.write_text(profiler.key_averages().table(sort_by=order, row_limit=_ROWS))
        note(
            f"steps {first} to {last} were profiled: open {trace} at chrome://tracing in Chromium "
            f"or at ui.perfetto.dev; {table.name} beside it lists the dearest operators"
        )

    on_gpu = [ProfilerActivity.CUDA] if device.type == "cuda" else []
    planned = schedule(skip_first=SKIPPED_STEPS - 1, wait=0, warmup=1, active=steps, repeat=1)
    try:
        with profile(
            activities=[ProfilerActivity.CPU, *on_gpu], schedule=planned, on_trace_ready=write
        ) as profiler:
            yield profiler.step
    finally:
        if not traces:
            note(
                f"nothing was profiled: the run ended before step {SKIPPED_STEPS + 1} of this call"
            )


def merge_spikes(by_rank: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Merge the spikes of all processes, which have equal values and different scenes.

    Processors of two kinds differ by rounding, so that one alone may see a spike at the bound.
    """
    rows = []
    for spike in by_rank[0]:
        keys = [
            key
            for other in itertools.chain(*by_rank)
            if (other["step"], other["what"]) == (spike["step"], spike["what"])
            for key in other["keys"]
        ]
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


MIN_SAMPLES = 3
"""Number of measured sections of a kind from which their usual time is known."""

UNKNOWN_FACTOR = 5.0
"""Multiple of `hang_after_s` after which a section without a known usual time counts as hung."""

POLL_S = 1.0
"""Interval of the watchdog's checks; shorter if `hang_after_s` is only a few of these."""

MAX_FILES = 50
"""Maximum number of stack files of one process; later hangs are only reported."""

GRACE_S = 5.0
"""Time that a run waits for the other processes' files before it stops on a hang."""


@dataclass(kw_only=True, eq=False)
class _Stretch:
    """A step, validation or saving in progress, and what was reported if it hangs."""

    kind: str
    step: int
    since_s: float
    usual_s: float | None
    limit_s: float
    hung_s: float | None = None
    """time.monotonic() at which it was seen to hang; None if it does not."""
    next_s: float = 0.0
    """time.monotonic() of the next report."""
    is_stopped: bool = False
    """True after the run was asked to stop."""
    passed_on: set[Path] = field(default_factory=set)
    """Stack files of other processes whose first line was already reported."""

    @property
    def name(self) -> str:
        """Display name in messages."""
        if self.kind == "step":
            return f"step {self.step}"
        return f"the {self.kind} after step {self.step}"


class Watchdog:
    """Monitors the duration of steps, validations and savings from a thread, in every process.

    Every process writes its stacks to a file; the first process reports the first line of each to
    the user. A hang in native code that holds Python's lock is not detected.
    """

    def __init__(
        self,
        settings: WatchSettings,
        activity: Activity,
        dist_context: DistributedContext,
        folder: Path,
        *,
        note: Callable[[str], None],
        report_hang: Callable[[str], None],
    ) -> None:
        """Create the watchdog.

        Args:
            note: called with a message about a hang, in the watchdog's thread.
            report_hang: called GRACE_S after a hang if the run is to stop on one.
        """
        self._settings = settings
        self._activity = activity
        self._dist_context = dist_context
        self._folder = folder
        self._report_hang = report_hang
        self._note = note
        self._usual_s: dict[str, deque[float]] = {}
        self._stretch: _Stretch | None = None
        self._closed = threading.Event()
        self._files = 0
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> "Watchdog":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join()

    def begin(self, kind: str, step: int) -> None:
        """End the current section, and begin another.

        Args:
            kind: kind of the section; sections of one kind take about the same time.
            step: step that the section belongs to, from 1.
        """
        now_s = time.monotonic()
        before = self._stretch
        if before is not None:
            known = self._usual_s.setdefault(before.kind, deque(maxlen=100))
            known.append(now_s - before.since_s)
        known = self._usual_s.get(kind, deque())
        usual_s = statistics.median(known) if len(known) >= MIN_SAMPLES else None
        limit_s = UNKNOWN_FACTOR * self._settings.hang_after_s
        if usual_s is not None:
            limit_s = max(self._settings.hang_after_s, self._settings.hang_factor * usual_s)
        self._stretch = _Stretch(
            kind=kind, step=step, since_s=now_s, usual_s=usual_s, limit_s=limit_s
        )

    def _watch(self) -> None:
        hang: _Stretch | None = None
        while not self._closed.wait(min(POLL_S, self._settings.hang_after_s / 5)):
            now_s = time.monotonic()
            stretch = self._stretch
            if hang is not None and stretch is not hang:
                self._note_safely(f"{hang.name} went on after all")
                hang = None
            if stretch is None or now_s - stretch.since_s < stretch.limit_s:
                continue
            hang = stretch
            if hang.hung_s is None:
                hang.hung_s = now_s
                self._files += 1
            if now_s >= hang.next_s:
                self._report(hang, now_s)
                hang.next_s = hang.since_s + 2 * (now_s - hang.since_s)  # ever more rarely
            if self._dist_context.is_first:
                self._forward_reports(hang, now_s)
                should_stop = self._settings.on_hang == "stop" and not hang.is_stopped
                if should_stop and now_s - hang.hung_s >= GRACE_S:
                    hang.is_stopped = True
                    self._report_hang(
                        f"training: {hang.name} hangs, and the run was asked to stop then"
                    )

    def _report(self, stretch: _Stretch, now_s: float) -> None:
        """Write the stacks, and report the current phase of this process."""
        phase, began_s = self._activity.now
        path = self._path(stretch.step, self._dist_context.rank)
        usual = "" if stretch.usual_s is None else f", where {stretch.usual_s:.2g} s is usual"
        line = (
            f"process {self._dist_context.rank} of {self._dist_context.world_size}: {stretch.name} "
            f"has taken {now_s - stretch.since_s:.1f} s{usual}; for "
            f"{now_s - began_s:.1f} s it has been in: {PHASES[phase]}"
        )
        written = ""
        if self._files <= MAX_FILES:
            with suppress(OSError):
                _write_stacks(path, line, appends=stretch.next_s > 0)
                written = f". Stacks of its threads: {path}"
        self._note_safely(line + written)

    def _note_safely(self, text: str) -> None:
        with suppress(TrilightError):  # a full disk must not end the watchdog
            self._note(text)

    def _path(self, step: int, rank: int | str) -> Path:
        return self._folder / f"hang-step-{step:09d}-rank-{rank}.txt"

    def _forward_reports(self, hang: _Stretch, now_s: float) -> None:
        """Report new stack files of the other processes about the same step."""
        began_unix_s = time.time() - (now_s - hang.since_s)
        hang.passed_on.add(self._path(hang.step, self._dist_context.rank))
        pattern = self._path(hang.step, "*").name
        for path in sorted(set(self._folder.glob(pattern)) - hang.passed_on):
            with suppress(OSError):
                lines = path.read_text().splitlines()
                if lines and path.stat().st_mtime >= began_unix_s:
                    hang.passed_on.add(path)
                    self._note_safely(f"{lines[0]}. Stacks of its threads: {path}")


def _write_stacks(path: Path, line: str, *, appends: bool) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a" if appends else "w") as stream:
        stream.write(f"{line}\n\n")
        stream.flush()
        faulthandler.dump_traceback(stream, all_threads=True)
        stream.write("\n")
