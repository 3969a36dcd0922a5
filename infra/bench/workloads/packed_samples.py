"""Bytes and unpacking time of samples in Trilight's profiles and in RenderFormer's HDF5 layout."""

import io
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from pipeline.exchange.renderformer_h5 import TextureType, write_renderformer_h5
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS

TEXTURES: Mapping[str, TextureType] = {"HDF5 float16": "float16", "HDF5 float32": "float32"}
LAYOUTS = (*PROFILES, *TEXTURES)

Packed = TypeVar("Packed")


def unpacking_figures(samples: Sequence[Sample], layout: str, work: Path) -> Mapping[str, float]:
    """Unpack samples of one of LAYOUTS in memory, in one thread.

    Returns:
        Mean bytes of a sample before and after, and mean CPU milliseconds.
    """
    if layout in TEXTURES:
        files = [_h5_bytes(sample, work, TEXTURES[layout]) for sample in samples]
        return _time_unpacking(files, _unpacked_h5, len)
    profile: Profile = "lossless" if layout == "lossless" else "compact"
    members = [encode_sample(sample, profile) for sample in samples]
    return _time_unpacking(members, _unpacked_sample, lambda packed: sum(map(len, packed.values())))


def _unpacked_sample(members: Mapping[str, bytes]) -> int:
    sample = decode_sample("0", members)
    arrays = sum(getattr(sample.scene, name).nbytes for name in ARRAY_FIELDS)
    return int(arrays + sample.radiance_rgb.nbytes)


def _h5_bytes(sample: Sample, work: Path, texture_type: TextureType) -> bytes:
    path = work / "scene.h5"
    write_renderformer_h5(path, sample.scene, sample.radiance_rgb, texture_type=texture_type)
    return path.read_bytes()


def _unpacked_h5(data: bytes) -> int:
    """Read every array without checks, as a loader that trusts its files does."""
    with h5py.File(io.BytesIO(data)) as file:
        return sum(file[name][()].nbytes for name in file)


def _time_unpacking(
    packed: Sequence[Packed], unpack: Callable[[Packed], int], size: Callable[[Packed], int]
) -> Mapping[str, float]:
    began = time.process_time()
    memory = sum(map(unpack, packed))
    spent_s = time.process_time() - began
    return {
        "bytes": float(np.mean([size(one) for one in packed])),
        "memory_bytes": memory / len(packed),
        "sample_ms": 1000 * spent_s / len(packed),
    }
