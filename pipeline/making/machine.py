"""What of this machine is ours: cores by affinity and container limits, graphics cards by name."""

import math
import os
from pathlib import Path

from storage.errors import TrilightError

_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")
_CARDS = Path("/proc/driver/nvidia/gpus")


def cores_owned() -> int:
    """Return how many cores this process may keep busy.

    That is TRILIGHT_CORES where it is set (several workers of one machine share it that way), and
    else the smaller of the affinity, which Slurm and taskset set, and the container's limit.

    Raises:
        TrilightError: TRILIGHT_CORES is not a number from 1.
    """
    if asked := os.environ.get("TRILIGHT_CORES"):
        if not asked.isdecimal() or int(asked) < 1:
            raise TrilightError(f"TRILIGHT_CORES is {asked!r}; expected a number from 1.")
        return int(asked)
    return min(_affinity(), _container_limit())


def visible_gpus() -> tuple[str, ...]:
    """Return the graphics cards that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip() not in ("", "-1"))
    try:
        return tuple(str(number) for number in range(len(list(_CARDS.iterdir()))))
    except OSError:
        return ()


def _affinity() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _container_limit() -> int:
    """Return the limit of cgroup v2, rounded up; very many where there is none."""
    try:
        quota, period = _CPU_MAX.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError):  # `max` is no number: no limit
        return 1 << 30
