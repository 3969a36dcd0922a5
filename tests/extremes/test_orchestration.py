"""How work is divided, at its ends: one range, too many workers, empty and broken ranges.

And hundreds of scenes from end to end: nothing of composing, packing or publishing piles up. That
is one `generate` as a user starts it, watched from outside: memory, open files and processes of
everything that it started, and what is left when it has ended.
"""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.generation.generation_run import Piece, ShardJob, TaskResult
from pipeline.generation.pipeline import make_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import decode_scene_log
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.for_each import case
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering
from train.data.order import visits_from


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Split and number of each scene that is made, without objects and pictures."""
    return without_rendering(monkeypatch)


class _Counting(Undocumented):
    """Says how many tasks were run."""

    def __init__(self) -> None:
        super().__init__()
        self.num_tasks = 0

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
        for outcome in super().run(tasks, job):
            self.num_tasks += 1
            yield outcome


@pytest.mark.parametrize("workers", [2, 64])
def test_more_workers_than_shards_or_scenes_do_no_harm(
    tmp_path: Path, scenes: list[tuple[str, int]], workers: int
) -> None:
    runner = _Counting()
    order = tiny_order(out=str(tmp_path / "set"), scenes=8, workers=workers)
    outcome = make_dataset(order, runner)
    assert sorted(scene for _, scene in scenes) == list(range(8))  # none twice
    assert 1 <= runner.num_tasks <= 8 and runner.finished == 1
    assert verify_dataset(tmp_path / "set").problems == []
    scenes.clear()
    plain = make_dataset(tiny_order(out=str(tmp_path / "plain"), scenes=8), Undocumented())
    assert outcome.digest == plain.digest


def test_empty_and_broken_ranges_are_refused_by_name() -> None:
    for shards in ("0:0", "3:3", "5:2", "-1:2", "0", ":", "0:1:2", "a:b", " 0:1"):
        with case(shards), pytest.raises(TrilightError) as caught:
            tiny_order(shards=shards)
        assert str(caught.value).startswith(f"shards is {shards!r}; expected a range such as 0:8")
        assert "\n" not in str(caught.value)


def test_a_range_beyond_the_end_is_refused_and_one_that_reaches_beyond_makes_what_is_there(
    tmp_path: Path, scenes: list[tuple[str, int]]
) -> None:
    said = "expected one that begins below 2, the shards of 8 scenes"
    for shards in ("2:3", "99999999999999999999:100000000000000000000"):
        order = tiny_order(out=str(tmp_path / "set"), scenes=8, shards=shards)
        with pytest.raises(TrilightError, match=f"^--range is '{shards}'; {said}"):
            make_dataset(order, Undocumented())
    assert scenes == []
    order = tiny_order(out=str(tmp_path / "set"), scenes=8, shards="1:10000")
    outcome = make_dataset(order, Undocumented())
    assert (outcome.num_shards, outcome.num_shards_planned) == (1, 2)
    assert [scene for _, scene in scenes] == [4, 5, 6, 7]


def test_batches_stand_in_distant_epochs() -> None:
    first = 3 * 10**12
    far = itertools.islice(visits_from(3, lambda shard: 7, first, seed=2**63, window=2), 64)
    assert [place.position for place in far] == list(range(first, first + 64))


SCENES = 400
"""Forty to a tenth; eight shards of 50, each packed and published; two children of 200 calls."""
EVERY_S, GRACE_S = 0.5, 10.0
LASTING_LOOKS = 10
"""Processes that are seen less often have made too few scenes to say anything."""
SETTINGS = {
    "scenes.num_views": 1,
    "splits.scenes_per_shard": 50,
    "renders.min_spp": 8,
    "renders.max_spp": 8,
    "renders.min_mean_radiance": 0.0,
}


def of_session(session: int) -> Iterator[Path]:
    """Yield the folders under /proc of the processes of a session that are not dead."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            yield folder


def looked_at(session: int) -> tuple[dict[int, float], int]:
    """Return the resident megabytes of each process by its number, and the files open in all."""
    resident_mb, files = dict[int, float](), 0
    for folder in of_session(session):
        try:
            pages = int((folder / "statm").read_text().split()[1])
            files += len(os.listdir(folder / "fd"))
        except OSError:  # it has just ended
            continue
        resident_mb[int(folder.name)] = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return resident_mb, files


def left(session: int) -> int:
    """Return how many processes do not end by themselves once their parent has."""
    deadline = time.monotonic() + GRACE_S
    while (found := len(list(of_session(session)))) and time.monotonic() < deadline:
        time.sleep(EVERY_S)
    return found


@pytest.mark.slow("memory")
def test_nothing_grows_and_nothing_stays_behind(tmp_path: Path) -> None:
    """Times are not looked at: other work would decide them."""
    out, temporary = tmp_path / "set", Path(tempfile.mkdtemp())  # sockets want short names
    words = ["generate", "smoke", "--out", str(out), "--objects", "builtin:24"]
    words += ["--scenes", str(SCENES), "--resolution", "16", "--noise-floor", "10"]
    for name, value in SETTINGS.items():
        words += ["--set", f"{name}={value}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "trilight", *words],
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # the processes of a session are found by its number
    )
    looks = []
    try:
        while process.poll() is None:
            looks.append((time.time(), *looked_at(process.pid)))
            time.sleep(EVERY_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()
    assert process.returncode == 0
    # what was prepared before the first scene would hide growth in the first tenth
    texts = [path.read_text() for path in DatasetFolder(out).logs.rglob("*.jsonl")]
    finished = sorted(log.finished_unix_s for text in texts for log in decode_scene_log(text))
    lives = defaultdict[int, list[float]](list)
    for unix_s, resident_mb, _ in looks:
        for number, megabytes in resident_mb.items() if unix_s <= finished[-1] else ():
            lives[number].append(megabytes)
    # In a run of 600 the children of 200 scenes each grew by 6.7, 5.7 and 8.3 MB and their owner by
    # 2.6, as the largest scene that each has seen. Had a child kept 100 kB of every scene, as much
    # as a scene with its picture takes, it would be 16 MB more, and 48 in the owner. Life begins
    # with what is loaded and made once, a fifth of it.
    grown = [
        life[-1] - life[len(life) // 5] for life in lives.values() if len(life) >= LASTING_LOOKS
    ]
    assert len(grown) >= 3, "owner and children"
    assert max(grown) <= 14, grown
    files, processes = [], []
    for tenth in np.array_split(finished, 10)[1:]:
        # a tenth of a few scenes may end between two looks, which take time themselves
        seen = [look for look in looks if tenth[0] < look[0] <= tenth[-1] + 2 * EVERY_S]
        files.append(max(opened for _, _, opened in seen))
        processes.append(max(len(resident_mb) for _, resident_mb, _ in seen))
    # 33 to 37 in the same runs, as a shard, a log or a lock is open or not when it is looked at.
    # With one file left open by each shard it was 9.
    assert max(files) - min(files) <= 6, files
    # a child that is being replaced may be seen beside its successor
    assert max(processes) - min(processes) <= 1, processes
    assert left(process.pid) == 0
    assert not any(path.is_file() for path in temporary.rglob("*"))
    shutil.rmtree(temporary)
