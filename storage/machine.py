"""Processor of this machine; cores and memory that this process may use.

They are limited by affinity, control groups and TRILIGHT_CORES.
"""

import math
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from storage.errors import TrilightError

_ROOT = Path("/")
_NO_LIMIT = 1 << 60
"""Threshold of memory limits: old control groups store a larger number for no limit."""


def processor() -> str:
    """Return the name of the processor; empty if the system does not state it."""
    lines = [line for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name")]
    return lines[0].split(":")[1].strip() if lines else platform.processor()


def available_cores() -> int:
    """Return the number of cores that this process may keep busy, rounded up.

    TRILIGHT_CORES sets it, so that several workers can share one machine; by default it is the
    smaller of the affinity, which Slurm and taskset set, and the quota of its control groups.

    Raises:
        TrilightError: TRILIGHT_CORES is not a number from 1.
    """
    if value := os.environ.get("TRILIGHT_CORES"):
        if not value.isdecimal() or int(value) < 1:
            raise TrilightError(f"TRILIGHT_CORES is {value!r}; expected a number from 1.")
        return int(value)
    return max(1, math.ceil(allowed_cores()))


def allowed_cores(root: Path = _ROOT) -> float:
    """Return the cores of the affinity, or the smaller quota of the control groups below `root`."""
    if hasattr(os, "sched_getaffinity"):
        allowed = len(os.sched_getaffinity(0))
    else:
        allowed = os.cpu_count() or 1
    groups = _control_groups(root)
    return min([float(allowed), *(quota for folder in groups for quota in _quotas(folder))])


def free_memory(root: Path = _ROOT) -> int | None:
    """Return the free bytes of the machine, or the fewer of its control groups; None if unknown."""
    free = [size for folder in _control_groups(root) for size in _free_in(folder)]
    available = (line.split() for line in _lines(root / "proc/meminfo"))
    free += [1024 * int(words[1]) for words in available if words[0] == "MemAvailable:"]
    return min(free, default=None)


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
