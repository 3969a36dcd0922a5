"""What feeds a card: views an hour that are rendered here, and samples a second that are read."""

import itertools
import os
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from infra.bench.card.effort import CardEffort
from infra.bench.subjects.manifests import write_copies
from infra.planning import measure_scenes
from pipeline.builds.named import named_build
from pipeline.making.dataset_order import DatasetOrder
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder
from storage.dataset.splits import shard_name
from storage.dataset.staging import read_staged_scene
from storage.dataset.training_data import open_training_data
from train.data.order import RankShare
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable
from train.runs import named_run

BUILD = "smoke"
BATCH = 8
READ_AS = "pretrain"
"""Run whose augmentation is drawn of what is read."""
MOST_THREADS = 16


def rendered_scenes(effort: CardEffort, place: Path) -> tuple[dict[str, Any], Path]:
    """Render scenes of the build smoke, one after the other on all cores.

    Returns:
        Views an hour of this machine and core-seconds of a view, without the first scene where
        there are others, since it compiles kernels; and a dataset of the scenes, each under many
        keys.
    """
    settings = named_build(BUILD)
    assert effort.scenes < settings.splits.scenes_per_shard, "else none of them stays staged"
    order = DatasetOrder(
        build=BUILD,
        resolution=effort.picture_px,
        noise_floor_db=effort.noise_floor_db,
        scenes=settings.splits.scenes_per_shard,
    )
    marks: list[float] = []
    making = place / "making"
    making.mkdir()
    found = measure_scenes(order, effort.scenes, making, lambda: marks.append(time.monotonic()))
    folder = DatasetFolder(making)
    staged = folder.staged_shard(shard_name(0, settings.splits))
    members = [dict(read_staged_scene(staged, row).members) for row in range(effort.scenes)]
    write_copies(place / "copies", members)
    core_s = found.core_s[1:] or found.core_s
    view_core_s = sum(core_s) / len(core_s) / found.num_views
    wall_s = (marks[-1] - marks[0]) / (len(marks) - 1) if len(marks) > 1 else None
    record = {
        "build": BUILD,
        "pixels": effort.picture_px,
        "noise_floor_db": effort.noise_floor_db,
        "variant": choose_variant().name,
        "scenes": effort.scenes,
        "view_core_s": view_core_s,
        "views_an_hour": 3600 * found.num_views / wall_s if wall_s else None,
    }
    return record, place / "copies"


def reading(data: str, effort: CardEffort) -> list[dict[str, Any]]:
    """Return samples a second of training data by threads, decoded and augmented as `pretrain`.

    Raises:
        TrilightError: the data cannot be read at the effort's width.
    """
    threads = [count for count in (1, 2, 4, 8, MOST_THREADS) if count <= (os.cpu_count() or 1)]
    return [_read(data, count, effort) for count in threads]


def _read(data: str, threads: int, effort: CardEffort) -> dict[str, Any]:
    opened, run = open_training_data([data]), named_run(READ_AS)
    settings = StreamSettings(
        seed=0,
        window=run.shuffle_shards,
        batch_size=BATCH,
        resolution=effort.picture_px,
        views_per_scene=run.views_per_scene,
        augmentation=run.augmentation,
    )
    stream = stream_batches(
        opened.split("train"), settings, 0, share=RankShare(), workers=threads,
        unusable=Unusable(0),
    )  # fmt: skip
    with closing(stream) as batches:
        for _ in itertools.islice(batches, 1 + 16 // BATCH):  # what is decoded ahead counts twice
            pass
        began, core_began, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - began < effort.loader_s:
            next(batches)
            count += BATCH
        seconds, core_s = time.perf_counter() - began, time.process_time() - core_began
    return {
        "threads": threads,
        "pixels": effort.picture_px,
        "samples_per_s": count / seconds,
        "sample_core_ms": 1e3 * core_s / count,
    }
