"""Samples packed in several layouts, and datasets of many copies."""

import io
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import Sample, decode_sample, encode_sample, sample_key
from storage.records.scene import ARRAY_FIELDS

Members = Mapping[str, bytes]
"""Files of a sample by name."""


def write_copies(
    root: Path, members: Sequence[Members], *, copies: int = 16, per_shard: int = 16
) -> int:
    """Write a dataset that holds each sample under many keys; return the number of samples.

    Args:
        root: folder of the dataset; it may be missing.
        copies: number of keys of each sample.
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


TEXTURES = {"HDF5 float16": "float16", "HDF5 float32": "float32"}
LAYOUTS = (*PROFILES, *TEXTURES)


def unpacking_figures(samples: Sequence[Sample], layout: str, work: Path) -> Mapping[str, float]:
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


def _unpacked_sample(members: Mapping[str, bytes]) -> int:
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
