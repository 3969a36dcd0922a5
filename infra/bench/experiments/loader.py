"""Experiment `loader`: samples a second and bytes a sample, compared with RenderFormer's layout.

It reads rendered scenes of `smoke`, each under many keys so that there are enough bytes, or
`--data`.
"""

import dataclasses
import itertools
import time
from contextlib import closing
from functools import partial

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, rounds
from infra.bench.workloads.reading import LAYOUTS, unpacking_figures
from infra.bench_options import BenchOptions
from storage.dataset.settings import StorageSettings
from storage.dataset.training_data import TrainingData
from storage.records.sample import decode_sample
from train.presets import training_preset
from train.settings import AugmentationSettings

UNPACK = "unpacking, one thread"
TRAIN = "batches as training reads them"
THREADS = (0, 1, 2, 4)
"""Numbers of decoding threads; with 0 the main thread decodes."""
BATCH = 4
RESOLUTION = 64
"""Scenes of a batch, and width of its pictures in pixels, which are reduced from the stored one."""
_VIEWS = 4
"""Maximum number of views of a scene."""
_SAMPLES = 32
"""Minimum number of samples of a pass over the training data."""
_DECODED_AHEAD = 16
"""Number of samples that are read before any is timed: what is decoded ahead would count twice."""


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    unpacked = [
        Point(
            name=f"unpack, {layout}",
            measure=partial(_unpack, layout),
            default=layout == StorageSettings.profile,
            group=UNPACK,
        )
        for layout in LAYOUTS
    ]
    read = [
        Point(name=f"batches, {threads} threads", measure=partial(_read, threads), group=TRAIN)
        for threads in THREADS
    ]
    return [*unpacked, *read]


def _unpack(layout: str, context: BenchContext, trial: str) -> Figures:
    samples = [decode_sample(str(row), files) for row, files in enumerate(context.rendered)]
    return unpacking_figures(samples, layout, context.folder())


def _read(threads: int, context: BenchContext, trial: str) -> Figures:
    shards = context.data.split("train")
    held = sum(shards.num_samples(number) for number in range(len(shards.names)))
    count = max(BATCH, min(_SAMPLES * context.scale.repeats, held))
    return read_figures(context.data, count, threads)


def read_figures(data: TrainingData, count: int, threads: int) -> Figures:
    """Return wall-clock and CPU milliseconds of reading a sample as training does.

    Args:
        data: data to read, again from its start when it ends.
        count: minimum number of timed samples.
        threads: number of decoding threads; with 0 the main thread decodes.

    Raises:
        TrilightError: the data cannot be read at this width.
    """
    from train.data.bad_samples import BadSampleCounter
    from train.data.loader import load_batches
    from train.data.order import RankSlice

    settings = dataclasses.replace(
        training_preset("smoke"),
        augmentation=AugmentationSettings(),
        shuffle_shards=2,
        scenes_per_step=BATCH,
        resolution=RESOLUTION,
        views_per_scene=min(_VIEWS, data.num_views or _VIEWS),
    )
    stream = load_batches(
        data.split("train"), settings, 0, rank_slice=RankSlice(),
        workers=threads, unusable=BadSampleCounter(0),
    )  # fmt: skip
    with closing(stream) as batches:
        for _ in itertools.islice(batches, 1 + _DECODED_AHEAD // BATCH):
            pass
        began = time.perf_counter()
        core_began = time.process_time()
        steps = -(-count // BATCH)
        for _ in itertools.islice(batches, steps):
            pass
        seconds = time.perf_counter() - began
        core_s = time.process_time() - core_began
    read = steps * BATCH
    return {"sample_ms": 1000 * seconds / read, "core_ms": 1000 * core_s / read}


EXPERIMENT = Experiment(
    name="loader",
    title="Samples a second and bytes a sample",
    about="Whole samples of `smoke`, four views each, unpacked from our profiles and from the "
    "published HDF5 layout, and shards that become batches of 64 pixels by threads.",
    cost=Column("ms a sample", "sample_ms"),
    columns=(
        Column("samples a second", "sample_ms", then=lambda ms: 1000 / ms),
        Column("kB a sample", "bytes", then=lambda size: size / 1000),
        Column("in memory, kB", "memory_bytes", then=lambda size: size / 1000),
        Column("core-ms a sample", "core_ms"),
    ),
    because="Unpacking is timed by the processor in memory, batches by the clock; HDF5 files are "
    "those of our exporter, read without any check.",
    points=_points,
    trials=rounds,
    needs=("torch",),
)
