"""What a maker's steps cost on a dataset of a size: to begin, to note a shard, to end, to finish.

Core-seconds, those of them in a turn that one maker has at a time, and requests to a bucket.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from infra.bench.sides.bucket_server import BucketServer
from infra.bench.sides.makers_simulation import Growing, MakerStep
from infra.bench.subjects.simulated_set import (
    SCENES_OF_OUTLINE,
    ShardTemplate,
    outlined,
    simulated_build,
)
from pipeline.making.bucket_publication import begin_dataset, joined
from pipeline.making.environment import environment
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder, dataset_folder
from storage.installation import IMPORT_ROOT
from storage.remote.bucket import Bucket
from storage.remote.url import RemoteUrl, parse_url

STEPS = ("begin", "end", "note", "finish")
"""The maker has the last shards of an array. Its end is one where others are still at work; the one
who makes the last shard of all finishes the dataset."""
TASK_SHARDS = 40
"""Shards of a task of the array."""
StepFigures = Mapping[str, Sequence[float]]
"""Of each step: core-seconds, those in a turn, requests."""

_turn_s = 0.0


class TimedFolder(DatasetFolder):
    """A folder of which is counted how long this process has had turns."""

    def turn(self, what: str) -> "contextlib.AbstractContextManager[bool]":
        """As `DatasetFolder.turn`."""
        return _timed(super().turn(what))


@contextlib.contextmanager
def _timed(turn: "contextlib.AbstractContextManager[bool]") -> Iterator[bool]:
    global _turn_s
    with turn as ours:
        began = time.process_time()
        try:
            yield ours
        finally:
            _turn_s += time.process_time() - began


def step_figures(place: str, log: Path | None = None, cache: Path | None = None) -> StepFigures:
    """Measure the steps of one maker of an outline in a fresh process.

    Args:
        place: the dataset: a folder or the URL of a bucket, whose last shard is missing; it is
            there afterwards.
        log: of the bucket's server.
        cache: of the maker's machine, where that is a bucket.
    """
    code = "import sys; from importlib import import_module as i; i(sys.argv[1]).main(sys.argv[2:])"
    words = [sys.executable, "-c", code, __name__, place, str(log or "")]
    environ = {**os.environ, **({"TRILIGHT_CACHE": str(cache)} if cache else {})}
    ran = subprocess.run(
        words, cwd=IMPORT_ROOT, env=environ, stdout=subprocess.PIPE, text=True, check=True
    )
    found: dict[str, list[float]] = json.loads(ran.stdout.splitlines()[-1])
    return found


def main(words: list[str]) -> None:
    """Measure the steps here and print them as the last line."""
    place, log = words[0], Path(words[1]) if words[1] else None
    build, found_here = simulated_build(SCENES_OF_OUTLINE), environment(choose_variant())
    template = ShardTemplate("train", SCENES_OF_OUTLINE, first=0)
    plain = dataset_folder(place)
    folder = TimedFolder(plain.root, plain.bucket)
    marks = [_mark(log)]
    with joined(folder):
        publication = begin_dataset(folder, build, found_here, 1, accept_environment=False)
        publication.refresh()
        last = publication.num_shards
        publication.missing_shards(range(max(0, last - TASK_SHARDS), last))
        marks.append(_mark(log))
        publication.finish()  # the last shard is missing: the longest look of all
        marks.append(_mark(log))
        entry = outlined(publication.num_shards - 1, build, template)
        path = folder.shard(entry.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.truncate(path, entry.num_bytes)
        publication.add_shard(entry)
        marks.append(_mark(log))
        publication.finish()
        marks.append(_mark(log))
    figures = {
        step: [late - early for early, late in zip(before, after, strict=True)]
        for step, before, after in zip(STEPS, marks, marks[1:], strict=False)
    }
    sys.stdout.write(f"\n{json.dumps(figures)}\n")


def _mark(log: Path | None) -> list[float]:
    requests = 0 if log is None else log.read_bytes().count(b"HTTP/1.1")
    return [time.process_time(), _turn_s, float(requests)]


def upload_outline(root: Path, server: BucketServer, name: str) -> str:
    """Put an outline into a bucket, its shards empty; return its URL."""
    url = f"{server.url}-{name}"
    place = parse_url(url, what="out")
    assert isinstance(place, RemoteUrl)
    bucket, folder = Bucket(place), DatasetFolder(root)
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        named = path.relative_to(root).as_posix()
        if path.suffix == ".tar":
            bucket.write(named, b"")
        elif not named.startswith(".staging/") or folder.staged_entries in path.parents:
            bucket.write(named, path)
    return url


def fitted_steps(found: Sequence[tuple[int, int, StepFigures]]) -> dict[str, MakerStep]:
    """Return the steps of a maker as they grow, fitted to those of some datasets.

    Args:
        found: shards planned and made, and what the steps took; three at least.
    """
    return {
        step: MakerStep(
            work_s=_growing([(p, n, each[step][0]) for p, n, each in found]),
            in_turn_s=_growing([(p, n, each[step][1]) for p, n, each in found]),
            requests=_growing([(p, n, each[step][2]) for p, n, each in found]),
        )
        for step in STEPS
    }


def _growing(found: Sequence[tuple[int, int, float]]) -> Growing:
    """Fit a fixed part and parts for shards planned and made, none negative, relative errors."""
    from scipy.optimize import nnls

    values = np.array([value for _, _, value in found])
    weights = 1 / np.maximum(values, max(values.max() * 1e-3, 1e-9))
    columns = np.array([(1.0, planned, made) for planned, made, _ in found])
    scale = columns.max(axis=0)
    (fixed, planned, made), _ = nnls(columns / scale * weights[:, None], values * weights)
    return Growing(fixed=fixed / scale[0], planned=planned / scale[1], made=made / scale[2])
