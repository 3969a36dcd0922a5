"""Default number of decoding threads, from the free cores and memory of the machine.

Batches do not depend on it, so that every start decides again.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from train.settings import TrainSettings

MAX_THREADS = 8
"""Maximum number of threads; more would wait for Python's lock. When threads only decode, two to
three saturate it (study S56); tracing for the view stage `hits` releases it."""

SCENES_AT_WORK = 4
"""Memory of a thread, in scenes as a batch holds them: decoded and waiting ones."""

_BYTES_OF_PIXEL = 12
_NO_LIMIT = 1 << 60
"""Threshold of memory limits: old control groups store a larger number for no limit."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Resources of this node that the processes of a run share."""

    cores: float
    """Number of allowed cores, or the smaller CPU quota of their control group."""
    free_bytes: int | None = None
    """Free memory in bytes; None if unknown."""
    processes: int = 1
    """Number of the run's processes on this node."""


@dataclass(frozen=True, kw_only=True)
class WorkerResult:
    """Number of decoding threads, with its reason."""

    threads: int
    """Number of threads that decode samples, 1 or more."""
    reason: str
    """Sentence for the user, without a full stop."""


def detect_machine(root: Path = Path("/")) -> Machine:
    """Detect cores, memory and processes of this node; `root` is that of the file system."""
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(_all_cores())
    groups = list(_control_groups(root))
    quotas = [quota for folder in groups for quota in _quotas(folder)]
    free = [size for folder in groups for size in _free_in(folder)]
    available = (line.split() for line in _lines(root / "proc/meminfo"))
    free += [1024 * int(words[1]) for words in available if words[0] == "MemAvailable:"]
    return Machine(
        cores=min([float(len(allowed)), *quotas]),
        free_bytes=min(free, default=None),
        processes=max(int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1),
    )


def choose_workers(
    machine: Machine, settings: "TrainSettings", *, on_gpu: bool, busy_threads: int
) -> WorkerResult:
    """Return the number of decoding threads.

    Args:
        machine: resources of the node.
        settings: settings of the run, which determine the memory of its scenes.
        on_gpu: True if the network is on a GPU, for which the main thread needs a core.
        busy_threads: CPU threads of a network that is not on a GPU.
    """
    cores = machine.cores / machine.processes
    spare = cores - (1 if on_gpu else busy_threads)
    threads = min(max(int(spare), 1), MAX_THREADS)
    reason = f"{machine.cores:g} cores"
    if machine.processes > 1:
        reason += f" for {machine.processes} processes"
    if machine.free_bytes is not None:
        scene = _BYTES_OF_PIXEL * settings.views_per_scene * settings.resolution**2
        fits = machine.free_bytes // 2 // machine.processes // (SCENES_AT_WORK * scene)
        if fits < threads:
            threads = max(fits, 1)
            reason += f" and {machine.free_bytes / 2**30:.1f} GiB of free memory"
    decision = "1 thread decodes" if threads == 1 else f"{threads} threads decode"
    return WorkerResult(threads=threads, reason=f"{decision} samples, by {reason}")


def _all_cores() -> int:
    return os.cpu_count() or 1


def _control_groups(root: Path) -> Iterator[Path]:
    """Yield the folders of this process's control group and its parents, versions 1 and 2."""
    base = root / "sys/fs/cgroup"
    yield from (base, base / "cpu", base / "memory")
    for line in _lines(root / "proc/self/cgroup"):
        number, _, path = line.split(":", 2)
        if number == "0":
            inside = base / path.strip("/")
            yield from (each for each in (inside, *inside.parents) if base in each.parents)


def _quotas(folder: Path) -> Iterator[float]:
    """Yield the CPU quotas of a control group, in cores."""
    for line in _lines(folder / "cpu.max"):
        quota, period = line.split()
        if quota != "max":
            yield int(quota) / int(period)
    old = [_lines(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period")]
    if all(old) and int(old[0][0]) > 0:
        yield int(old[0][0]) / int(old[1][0])


def _free_in(folder: Path) -> Iterator[int]:
    """Yield the free and reclaimable bytes of a control group that has a memory limit."""
    old = ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for limit, used in (("memory.max", "memory.current"), old):
        lines = [_lines(folder / name) for name in (limit, used)]
        if all(lines) and lines[0][0] != "max" and int(lines[0][0]) < _NO_LIMIT:
            held = int(lines[1][0]) - _files_held(folder)
            yield max(int(lines[0][0]) - held, 0)


def _files_held(folder: Path) -> int:
    """Return the reclaimable bytes of cached files in a control group.

    The kernel counts them as used: after an epoch, cached shards fill every group.
    """
    words = (line.split() for line in _lines(folder / "memory.stat"))
    counts = {name: int(value) for name, value in words}
    return counts.get("total_inactive_file", counts.get("inactive_file", 0))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
