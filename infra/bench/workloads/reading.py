"""Rendering of a few scenes, and reading of many copies of them as training does."""

import itertools
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.splits import shard_name
from storage.dataset.staging import read_staged_scene
from storage.dataset.training_data import TrainingData
from storage.records.sample import sample_key

if TYPE_CHECKING:
    from train.data.stream import StreamSettings

BUILD = "smoke"
SCENES = 3
"""Number of rendered scenes, fewer than a shard of the preset; the first compiles kernels."""
_DECODED_AHEAD = 16
"""Number of samples that are read before any is timed: what is decoded ahead would count twice."""

Members = Mapping[str, bytes]
"""Files of a sample by name."""


def render_scenes(px: int, place: Path) -> tuple[dict[str, float], list[Members]]:
    """Render scenes of BUILD one after the other on all cores.

    Returns:
        Wall-clock milliseconds and CPU seconds of a view; and the files of each scene.
    """
    from infra.planning import measure_scenes
    from pipeline.builds.named import named_build
    from pipeline.generation.dataset_order import DatasetOrder

    splits = named_build(BUILD).splits
    order = DatasetOrder(build=BUILD, resolution=px, scenes=splits.scenes_per_shard)
    marks: list[float] = []
    measured = measure_scenes(order, SCENES, place, lambda: marks.append(time.monotonic()))
    staged = DatasetFolder(place).staged_shard(shard_name(0, splits))
    members: list[Members] = [read_staged_scene(staged, row).members for row in range(SCENES)]
    view_s = (marks[-1] - marks[0]) / (len(marks) - 1) / measured.num_views
    core_s = sum(measured.core_s[1:]) / (SCENES - 1) / measured.num_views
    return {"ms": 1e3 * view_s, "views_per_s": 1 / view_s, "core_s": core_s}, members


def write_copies(
    root: Path, members: Sequence[Members], *, copies: int = 16, per_shard: int = 16
) -> int:
    """Write a dataset that holds each sample under many keys; return the number of samples.

    Args:
        root: folder of the dataset; it may be missing.
        members: files of each sample by name.
        copies: number of keys of each sample.
        per_shard: number of samples of a shard.
    """
    folder = DatasetFolder(root)
    every = [(sample_key(k), members[k % len(members)]) for k in range(copies * len(members))]
    names = []
    for number, start in enumerate(range(0, len(every), per_shard)):
        names.append(f"train-{number:06d}.tar")
        write_shard(folder.shard(names[-1]), every[start : start + per_shard])
    manifest = Manifest(
        build="bench", settings={}, environment={}, num_scenes=len(every), num_views=4,
        objects_lock_sha256="", shards=tuple(index_shard(folder.shard(name)) for name in names),
    )  # fmt: skip
    write_manifest(folder.manifest, manifest)
    return len(every)


def time_reading(
    data: TrainingData,
    settings: "StreamSettings",
    threads: int,
    *,
    least_count: int = 1,
    least_s: float = 0.0,
) -> tuple[float, float]:
    """Return wall-clock and CPU seconds of reading a sample as training does, without a network.

    Args:
        data: data to read, again from its start when it ends.
        settings: settings of the stream.
        threads: number of decoding threads; with 0 the main thread decodes.
        least_count: minimum number of samples.
        least_s: minimum number of seconds.

    Raises:
        TrilightError: the data cannot be read at this width.
    """
    from train.data.bad_samples import BadSampleCounter
    from train.data.order import RankSlice
    from train.data.stream import stream_batches

    stream = stream_batches(
        data.split("train"), settings, 0, rank_slice=RankSlice(),
        workers=threads, unusable=BadSampleCounter(0),
    )  # fmt: skip
    with closing(stream) as batches:
        for _ in itertools.islice(batches, 1 + _DECODED_AHEAD // settings.batch_size):
            pass
        began = time.perf_counter()
        core_began = time.process_time()
        count = 0
        while count < least_count or time.perf_counter() - began < least_s:
            next(batches)
            count += settings.batch_size
        seconds = time.perf_counter() - began
        return seconds / count, (time.process_time() - core_began) / count
