"""Default number of decoding threads, from the free cores and memory of the machine.

Batches do not depend on it, so that every start decides again.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from storage.machine import allowed_cores, free_memory

if TYPE_CHECKING:
    from train.settings import TrainSettings

MAX_THREADS = 8
"""Maximum number of threads; more would wait for Python's lock. When threads only decode, two to
three saturate it (study S56); tracing for the view stage `hits` releases it."""

SCENES_AT_WORK = 4
"""Memory of a thread, in scenes as a batch holds them: decoded and waiting ones."""

_BYTES_OF_PIXEL = 12


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Resources of this node that the processes of a run share."""

    cores: float
    """Number of allowed cores, or the smaller CPU quota of their control group."""
    free_bytes: int | None = None
    """Free memory in bytes; None if unknown."""
    processes: int = 1
    """Number of the run's processes on this node."""


def detect_machine(root: Path = Path("/")) -> Machine:
    """Detect cores, memory and processes of this node; `root` is that of the file system."""
    return Machine(
        cores=allowed_cores(root),
        free_bytes=free_memory(root),
        processes=max(int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1),
    )


def choose_workers(
    machine: Machine, settings: "TrainSettings", *, on_gpu: bool, busy_threads: int
) -> tuple[int, str]:
    """Return the number of decoding threads, 1 or more, and its reason as a sentence.

    Args:
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
    return threads, f"{decision} samples, by {reason}"
