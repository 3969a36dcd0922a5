"""Hundreds of tiny scenes through the whole line: does anything grow, slow down or stay behind?

One `trilight generate` as a user starts it, watched from outside: memory, open files and processes
of everything that it started, and what is left when it has ended.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import SceneLog, read_scene_logs

PARTS = 10
"""Of the run, in the order in which scenes were finished."""
_EVERY_S, _GRACE_S = 0.5, 10.0
_LASTING_LOOKS = 10
"""Processes that are seen less often have made too few scenes to say anything."""
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, kw_only=True)
class Part:
    """A tenth of the scenes."""

    open_files: int
    """Most, of all processes together."""
    processes: int
    """Most."""


@dataclass(frozen=True, kw_only=True)
class Soak:
    """A run, tenth by tenth."""

    parts: tuple[Part, ...]
    """In order."""
    growth_mb: tuple[float, ...]
    """Of each process, from a fifth of its life to its end or that of the last scene. Life begins
    with what is loaded and made once."""
    processes_left: int
    """Of the run, ten seconds after its end."""
    files_left: int
    """In the folder for temporary files."""


@dataclass(frozen=True, kw_only=True)
class _Look:
    """One look at the run's processes."""

    unix_s: float
    resident_mb: dict[int, float]
    """Of each process, by its number."""
    open_files: int
    processes: int


def soaked(objects: str, num_scenes: int) -> Soak:
    """Return what was seen of a run of so many tiny scenes; of 20 or more, two to each tenth.

    Raises:
        RuntimeError: `generate` failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        temporary, out = Path(folder, "tmp"), Path(folder, "set")
        temporary.mkdir()
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
        scenes = sorted(read_scene_logs(DatasetFolder(out)), key=lambda one: one.finished_unix_s)
        return Soak(
            parts=_parts(scenes, looks),
            growth_mb=_growth_mb(scenes, looks),
            processes_left=_left(process.pid),
            files_left=sum(path.is_file() for path in temporary.rglob("*")),
        )


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


def _growth_mb(scenes: Sequence[SceneLog], looks: Sequence[_Look]) -> tuple[float, ...]:
    lives = defaultdict[int, list[float]](list)
    for look in looks:
        if look.unix_s <= scenes[-1].finished_unix_s:
            for process, megabytes in look.resident_mb.items():
                lives[process].append(megabytes)
    lasting = [life for life in lives.values() if len(life) >= _LASTING_LOOKS]
    return tuple(life[-1] - life[len(life) // 5] for life in lasting)


def _parts(scenes: Sequence[SceneLog], looks: Sequence[_Look]) -> tuple[Part, ...]:
    """Cut the run into tenths by the moments at which scenes were finished."""
    # what was prepared before the first scene would hide growth in the first tenth
    parts, since = [], scenes[0].finished_unix_s - scenes[0].seconds if scenes else 0.0
    for tenth in np.array_split(np.arange(len(scenes)), PARTS):
        until = scenes[tenth[-1]].finished_unix_s
        # a tenth of a few scenes may end between two looks, which take time themselves
        seen = [look for look in looks if since < look.unix_s <= until + 2 * _EVERY_S]
        parts.append(
            Part(
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
    resident_mb, files, processes = dict[int, float](), 0, 0
    for folder in _of_session(session):
        try:
            pages = int((folder / "statm").read_text().split()[1])
            resident_mb[int(folder.name)] = pages * _PAGE_BYTES / 1e6
            files += len(os.listdir(folder / "fd"))
        except OSError:  # it has just ended
            continue
        processes += 1
    return _Look(
        unix_s=time.time(),
        resident_mb=resident_mb,
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
