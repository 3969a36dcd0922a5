"""Resources of this process: cores by affinity and limits, and how many children share a GPU."""

import math
import os
from pathlib import Path

from storage.errors import TrilightError

_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")

_MOST_CHILDREN = 4
"""Children of a GPU. One that only renders fills an H200 (60,700 views an hour, four 58,500), but a
child also composes, checks and encodes on the CPU meanwhile."""

_CHILD_BYTES = 1 << 30
"""GPU memory of a render child; four used 4.6 GB in all on an H200."""

_PIXEL_BYTES = 2400
"""More of it for each pixel: a pass of 64 samples, which Dr.Jit rounds up to powers of two."""

_USED = 0.9
"""Fraction of a GPU's memory that render children may fill."""


def available_cores() -> int:
    """Return the number of cores that this process may keep busy.

    TRILIGHT_CORES sets it, so that several workers can share one machine; by default it is the
    smaller of the affinity, which Slurm and taskset set, and the container's limit.

    Raises:
        TrilightError: TRILIGHT_CORES is not a number from 1.
    """
    if value := os.environ.get("TRILIGHT_CORES"):
        if not value.isdecimal() or int(value) < 1:
            raise TrilightError(f"TRILIGHT_CORES is {value!r}; expected a number from 1.")
        return int(value)
    return min(_affinity(), _container_limit())


def children_of_gpu(resolution: int, memory_bytes: int) -> int:
    """Return how many render children keep a GPU busy and fit into its memory.

    Args:
        resolution: of their pictures, in pixels.
        memory_bytes: of the GPU.
    """
    child_bytes = _CHILD_BYTES + _PIXEL_BYTES * resolution**2
    return min(_MOST_CHILDREN, max(1, int(_USED * memory_bytes) // child_bytes))


def _affinity() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _container_limit() -> int:
    """Return the core limit of cgroup v2, rounded up; 2^30 if there is none."""
    try:
        quota, period = _CPU_MAX.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError):  # `max` means no limit
        return 1 << 30
