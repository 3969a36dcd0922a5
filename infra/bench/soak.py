"""Thousands of tiny scenes through the whole line: does anything grow, slow down or stay behind?

One `trilight generate` as a user starts it, watched from outside: memory, open files and processes
of everything that it started, the time of each scene from the dataset's own logs, and what is left
when it has ended.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.figure
import numpy as np

from infra.bench.harness import Options, Result
from storage.layout import DatasetFolder
from storage.scene_log import read_scene_logs

NAME = "soak"
PARTS = 10
"""Of the run, in the order in which scenes were finished."""
_EVERY_S, _GRACE_S = 0.5, 10.0
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, kw_only=True)
class Part:
    """A tenth of the scenes."""

    seconds_a_scene: float
    """Median wall time."""
    megabytes: float
    """Most resident memory of all processes together while they were made."""
    open_files: int
    """Most, of all processes together."""
    processes: int
    """Most."""


@dataclass(frozen=True, kw_only=True)
class Soak(Result):
    """A run, tenth by tenth."""

    num_scenes: int
    """Scenes that were made."""
    seconds: float
    """Wall time."""
    parts: tuple[Part, ...]
    """In order."""
    processes_left: int
    """Of the run, ten seconds after its end."""
    files_left: int
    """In the folder for temporary files."""


@dataclass(frozen=True, kw_only=True)
class _Look:
    """One look at the run's processes."""

    unix_s: float
    megabytes: float
    open_files: int
    processes: int


def num_rounds(options: Options) -> int:
    """Return how often `round_done` is called."""
    return 1


def run(options: Options, round_done: Callable[[], None]) -> Soak:
    """Make the scenes and return what was seen."""
    result = soaked(options.objects[0], 200 if options.quick else 3000)
    round_done()
    return result


def soaked(objects: str, num_scenes: int) -> Soak:
    """Return what was seen of a run of so many tiny scenes; of 20 or more, two to each tenth.

    Raises:
        RuntimeError: `generate` failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        temporary, out = Path(folder, "tmp"), Path(folder, "set")
        temporary.mkdir()
        started = time.monotonic()
        process = subprocess.Popen(
            _command(objects, out, num_scenes),
            env={**os.environ, "TMPDIR": str(temporary)},
            stdout=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # the processes of a session are found by its number
        )
        looks = []
        try:
            while process.poll() is None:
                looks.append(_look(process.pid))
                time.sleep(_EVERY_S)
        finally:
            _end(process)
        if process.returncode:
            raise RuntimeError(f"generate ended with {process.returncode}")
        return Soak(
            name=NAME,
            num_scenes=num_scenes,
            seconds=time.monotonic() - started,
            parts=_parts(DatasetFolder(out), looks),
            processes_left=_left(process.pid),
            files_left=sum(path.is_file() for path in temporary.rglob("*")),
        )


def rows(result: Soak) -> list[tuple[str, str]]:
    """Return what is printed."""
    found = [
        (
            f"tenth {number}",
            f"{1000 * part.seconds_a_scene:.0f} ms a scene, {part.megabytes:.0f} MB, "
            f"{part.open_files} files, {part.processes} processes",
        )
        for number, part in enumerate(result.parts, 1)
    ]
    left = f"{result.processes_left} processes, {result.files_left} temporary files"
    return [*found, ("scenes", str(result.num_scenes)), ("left behind", left)]


def plot(result: Soak, path: Path) -> None:
    """Draw time and memory by tenths."""
    figure = matplotlib.figure.Figure(figsize=(8, 3), layout="constrained")
    tenths = np.arange(1, PARTS + 1)
    columns: list[tuple[str, list[float]]] = [
        ("milliseconds a scene", [1000 * part.seconds_a_scene for part in result.parts]),
        ("megabytes of all processes", [part.megabytes for part in result.parts]),
        ("open files", [part.open_files for part in result.parts]),
    ]
    for axes, (label, values) in zip(figure.subplots(1, len(columns)), columns, strict=True):
        axes.plot(tenths, values, "o-")
        axes.set(
            xlabel=f"tenth of {result.num_scenes} scenes", ylabel=label, ylim=(0, 1.1 * max(values))
        )
    figure.savefig(path, dpi=120)


def _command(objects: str, out: Path, num_scenes: int) -> list[str]:
    settings = {
        "scenes.num_views": 1,
        "splits.scenes_per_shard": 50,
        "renders.min_spp": 8,
        "renders.max_spp": 8,
        "renders.min_mean_radiance": 0.0,
    }
    words = [sys.executable, "-m", "trilight", "generate", "smoke", "--out", str(out)]
    words += ["--objects", objects, "--scenes", str(num_scenes)]
    words += ["--resolution", "16", "--noise-floor", "10"]
    return words + [
        word for name, value in settings.items() for word in ("--set", f"{name}={value}")
    ]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a run that was left early, before its folder goes; one that has ended stays ended."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _parts(folder: DatasetFolder, looks: Sequence[_Look]) -> tuple[Part, ...]:
    """Cut the run into tenths by the moments at which scenes were finished."""
    scenes = sorted(read_scene_logs(folder), key=lambda scene: scene.finished_unix_s)
    # what was prepared before the first scene would hide growth in the first tenth
    parts, since = [], scenes[0].finished_unix_s - scenes[0].seconds if scenes else 0.0
    for tenth in np.array_split(np.arange(len(scenes)), PARTS):
        until = scenes[tenth[-1]].finished_unix_s
        # a tenth of a few scenes may end between two looks, which take time themselves
        seen = [look for look in looks if since < look.unix_s <= until + 2 * _EVERY_S]
        parts.append(
            Part(
                seconds_a_scene=float(np.median([scenes[index].seconds for index in tenth])),
                megabytes=max(look.megabytes for look in seen),
                open_files=max(look.open_files for look in seen),
                processes=max(look.processes for look in seen),
            )
        )
        since = until
    return tuple(parts)


def _left(session: int) -> int:
    """Return how many processes do not end by themselves once their parent has."""
    deadline = time.monotonic() + _GRACE_S
    while (found := len(list(_of_session(session)))) and time.monotonic() < deadline:
        time.sleep(_EVERY_S)
    return found


def _look(session: int) -> _Look:
    pages, files, processes = 0, 0, 0
    for folder in _of_session(session):
        try:
            pages += int((folder / "statm").read_text().split()[1])
            files += len(os.listdir(folder / "fd"))
        except OSError:  # it has just ended
            continue
        processes += 1
    return _Look(
        unix_s=time.time(),
        megabytes=pages * _PAGE_BYTES / 1e6,
        open_files=files,
        processes=processes,
    )


def _of_session(session: int) -> Iterator[Path]:
    """Yield the folders under /proc of the processes of a session that are not dead."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            yield folder
