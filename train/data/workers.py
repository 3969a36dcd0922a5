"""How many threads decode samples, where nobody says it: what the machine has to spare.

Execution, not meaning: batches are the same with any number, so every start decides anew.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from train.settings import TrainSettings

MOST_THREADS = 8
"""More threads of one process wait for Python's lock. Where they only decode, two to three fill it
(study S56); tracing for the view stage `hits` lets it go."""

SCENES_AT_WORK = 4
"""Memory that a thread takes, in scenes as a batch holds them: what it decodes, and what waits."""

_BYTES_OF_PIXEL = 12
_NO_LIMIT = 1 << 60
"""Old control groups write a limit beyond any memory where there is none."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """What the processes of a run may use on this node."""

    cores: float
    """Cores that they may run on, or their control group's share of time where that is less."""
    free_bytes: int | None = None
    """Memory that is free; None where nothing says it."""
    processes: int = 1
    """How many of them share it."""


@dataclass(frozen=True, kw_only=True)
class Workers:
    """A number of threads, and what it comes from."""

    threads: int
    """Threads that decode samples."""
    because: str
    """One line."""


def this_machine(root: Path = Path("/")) -> Machine:
    """Return what the system and the launcher of processes say; `root` is of the file system."""
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


def fitting_workers(
    machine: Machine, settings: "TrainSettings", *, on_card: bool, busy_threads: int
) -> Workers:
    """Return how many threads should decode.

    Args:
        machine: what there is.
        settings: of the run: its scenes take memory.
        on_card: whether the network is on a card, which the main thread has to drive from a core.
        busy_threads: with which the network computes where it is on none.
    """
    share = machine.cores / machine.processes
    spare = share - (1 if on_card else busy_threads)
    threads = min(max(int(spare), 1), MOST_THREADS)
    shown = f"{machine.cores:g} cores"
    if machine.processes > 1:
        shown += f" for {machine.processes} processes"
    if machine.free_bytes is not None:
        scene = _BYTES_OF_PIXEL * settings.views_per_scene * settings.resolution**2
        fits = machine.free_bytes // 2 // machine.processes // (SCENES_AT_WORK * scene)
        if fits < threads:
            threads = max(fits, 1)
            shown += f" and {machine.free_bytes / 2**30:.1f} GiB of free memory"
    said = "1 thread decodes" if threads == 1 else f"{threads} threads decode"
    return Workers(threads=threads, because=f"{said} samples, by {shown}")


def _all_cores() -> int:
    return os.cpu_count() or 1


def _control_groups(root: Path) -> Iterator[Path]:
    """Yield the folders that limit this process: its group and those around it, old and new."""
    base = root / "sys/fs/cgroup"
    yield from (base, base / "cpu", base / "memory")
    for line in _lines(root / "proc/self/cgroup"):
        number, _, path = line.split(":", 2)
        if number == "0":
            inside = base / path.strip("/")
            yield from (each for each in (inside, *inside.parents) if base in each.parents)


def _quotas(folder: Path) -> Iterator[float]:
    """Yield cores' worth of time that a control group has, where it is limited."""
    for line in _lines(folder / "cpu.max"):
        quota, period = line.split()
        if quota != "max":
            yield int(quota) / int(period)
    old = [_lines(folder / f"cpu.cfs_{name}_us") for name in ("quota", "period")]
    if all(old) and int(old[0][0]) > 0:
        yield int(old[0][0]) / int(old[1][0])


def _free_in(folder: Path) -> Iterator[int]:
    """Yield the memory that a control group has left or can take back, where it is limited."""
    old = ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for limit, used in (("memory.max", "memory.current"), old):
        lines = [_lines(folder / name) for name in (limit, used)]
        if all(lines) and lines[0][0] != "max" and int(lines[0][0]) < _NO_LIMIT:
            held = int(lines[1][0]) - _files_held(folder)
            yield max(int(lines[0][0]) - held, 0)


def _files_held(folder: Path) -> int:
    """Return the bytes of files that a control group holds until somebody wants the memory.

    They count as used: after an epoch, the shards that were read fill every group.
    """
    words = (line.split() for line in _lines(folder / "memory.stat"))
    counts = {name: int(value) for name, value in words}
    return counts.get("total_inactive_file", counts.get("inactive_file", 0))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
