"""Resources of this process: cores by affinity and container limits, GPUs by name."""

import math
import os
import subprocess
from pathlib import Path

from storage.errors import TrilightError

_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")
_GPUS = Path("/proc/driver/nvidia/gpus")
_ASK_S = 20

_MOST_CHILDREN = 4
"""Of a graphics card: of one H200, eight and twelve were no quicker."""

_CHILD_BYTES, _PIXEL_BYTES = 1 << 30, 2400
"""Memory of a card that a render child needs, and more for each pixel: a pass of 64 samples, whose
arrays Dr.Jit rounds up to powers of two and keeps."""

_USED = 0.9
"""Part of a card's memory that render children may fill."""


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


def visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip() not in ("", "-1"))
    try:
        return tuple(str(number) for number in range(len(list(_GPUS.iterdir()))))
    except OSError:
        return ()


def gpu_memory_bytes() -> int:
    """Return the memory of the smallest graphics card that is seen; 0 where nobody says."""
    ask = ["nvidia-smi", "--query-gpu=memory.total", "--format=csv,noheader,nounits"]
    try:
        said = subprocess.run(ask, capture_output=True, text=True, timeout=_ASK_S, check=True)
        return min(int(line) for line in said.stdout.split()) << 20
    except (OSError, ValueError, subprocess.SubprocessError):
        return 0


def children_of_gpu(resolution: int, memory_bytes: int) -> int:
    """Return how many render children keep a graphics card busy and fit into its memory.

    Args:
        resolution: of their pictures, in pixels.
        memory_bytes: of the card.
    """
    needed = _CHILD_BYTES + _PIXEL_BYTES * resolution**2
    return min(_MOST_CHILDREN, max(1, int(_USED * memory_bytes) // needed))


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
