"""Supply of a GPU: rates of rendering views on this machine, and of reading samples."""

import itertools
import time
from contextlib import closing
from pathlib import Path

from infra.bench.workloads.manifests import write_copies
from infra.planning import measure_scenes
from pipeline.builds.named import named_build
from pipeline.generation.dataset_order import DatasetOrder
from storage.dataset.layout import DatasetFolder
from storage.dataset.splits import shard_name
from storage.dataset.staging import read_staged_scene
from storage.dataset.training_data import open_training_data
from train.data.bad_samples import BadSampleCounter
from train.data.order import RankSlice
from train.data.stream import StreamSettings, stream_batches
from train.runs import named_run

BUILD = "smoke"
SCENES = 3
"""Number of rendered scenes, fewer than a shard of the preset; the first compiles kernels."""
NOISE_FLOOR_DB = 38.0
BATCH = 8
READ_AS = "pretrain"
"""Training preset whose augmentation is applied to samples."""


def rendered_figures(px: int, place: Path) -> tuple[dict[str, float], Path]:
    """Render scenes one after the other on all cores.

    Returns:
        Wall-clock milliseconds and CPU seconds of a view; and a dataset of the scenes, each under
        many keys.
    """
    settings = named_build(BUILD)
    order = DatasetOrder(
        build=BUILD,
        resolution=px,
        noise_floor_db=NOISE_FLOOR_DB,
        scenes=settings.splits.scenes_per_shard,
    )
    marks: list[float] = []
    making = place / "making"
    making.mkdir()
    measured = measure_scenes(order, SCENES, making, lambda: marks.append(time.monotonic()))
    staged = DatasetFolder(making).staged_shard(shard_name(0, settings.splits))
    members = [dict(read_staged_scene(staged, row).members) for row in range(SCENES)]
    write_copies(place / "copies", members)
    view_s = (marks[-1] - marks[0]) / (len(marks) - 1) / measured.num_views
    core_s = sum(measured.core_s[1:]) / (SCENES - 1) / measured.num_views
    return {"ms": 1e3 * view_s, "views_per_s": 1 / view_s, "core_s": core_s}, place / "copies"


def read_figures(data: str, threads: int, px: int, least_s: float) -> dict[str, float]:
    """Return milliseconds of decoding and augmenting a sample as in READ_AS.

    Raises:
        TrilightError: the data cannot be read at this width.
    """
    run = named_run(READ_AS)
    settings = StreamSettings(
        seed=0,
        window=run.shuffle_shards,
        batch_size=BATCH,
        resolution=px,
        views_per_scene=run.views_per_scene,
        augmentation=run.augmentation,
    )
    stream = stream_batches(
        open_training_data([data]).split("train"), settings, 0, rank_slice=RankSlice(),
        workers=threads, unusable=BadSampleCounter(0),
    )  # fmt: skip
    with closing(stream) as batches:
        for _ in itertools.islice(batches, 1 + 16 // BATCH):  # what is decoded ahead counts twice
            pass
        began = time.perf_counter()
        core_began = time.process_time()
        count = 0
        while time.perf_counter() - began < least_s:
            next(batches)
            count += BATCH
        seconds = time.perf_counter() - began
        core_s = time.process_time() - core_began
    views = count * run.views_per_scene
    return {
        "ms": 1e3 * seconds / count,
        "views_per_s": views / seconds,
        "core_s": core_s / count,
    }
