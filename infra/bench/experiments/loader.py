"""Experiment `loader`: samples a second and bytes a sample, compared with RenderFormer's layout.

It reads rendered scenes of `smoke`, each under many keys so that there are enough bytes, or
`--data`.
"""

import dataclasses
import io
import itertools
import time
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from infra.bench.context import BenchContext, Members
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, rounds
from infra.bench_options import BenchOptions
from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from storage.dataset.settings import StorageSettings
from storage.dataset.training_data import TrainingData
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS
from train.presets import training_preset
from train.settings import AugmentationSettings

TEXTURES = {"HDF5 float16": "float16", "HDF5 float32": "float32"}
LAYOUTS = (*PROFILES, *TEXTURES)
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


def unpacking_figures(samples: Sequence[Sample], layout: str, work: Path) -> Figures:
    """Return mean bytes before and after, and CPU milliseconds, of unpacking samples in memory."""
    if layout in TEXTURES:
        packed = [_h5_members(sample, work, TEXTURES[layout]) for sample in samples]
        unpack = _unpacked_h5
    else:
        profile: Profile = "lossless" if layout == "lossless" else "compact"
        packed = [encode_sample(sample, profile) for sample in samples]
        unpack = _unpacked_sample
    began = time.process_time()
    memory = sum(map(unpack, packed))
    spent_s = time.process_time() - began
    return {
        "bytes": float(np.mean([sum(map(len, members.values())) for members in packed])),
        "memory_bytes": memory / len(packed),
        "sample_ms": 1000 * spent_s / len(packed),
    }


def _unpacked_sample(members: Members) -> int:
    sample = decode_sample("0", members)
    arrays = sum(getattr(sample.scene, name).nbytes for name in ARRAY_FIELDS)
    return int(arrays + sample.radiance_rgb.nbytes)


def _h5_members(sample: Sample, work: Path, texture_type: str) -> Members:
    write_renderformer_h5(work / "scene.h5", sample.scene, sample.radiance_rgb)
    stream = io.BytesIO()
    with h5py.File(work / "scene.h5") as source, h5py.File(stream, "w") as file:
        for name, array in source.items():
            data = array[()].astype(texture_type if name == "texture" else array.dtype)
            file.create_dataset(name, data=data, compression="gzip", compression_opts=9)
    return {"scene.h5": stream.getvalue()}


def _unpacked_h5(members: Members) -> int:
    """Read every array without checks, as a loader that trusts its files does."""
    with h5py.File(io.BytesIO(members["scene.h5"])) as file:
        return sum(file[name][()].nbytes for name in file)


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
