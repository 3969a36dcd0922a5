"""Scene arrays and whole samples: ours against flat triangles and the published HDF5 files."""

import dataclasses
import io
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from pipeline.exchange.renderformer_h5 import TextureType, write_renderformer_h5
from storage.records.material import DIFFUSE, SPECULAR
from storage.records.profiles import PROFILES, pack_arrays, unpack_arrays
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.seeds import rng_for

TEXTURES: tuple[TextureType, ...] = ("float16", "float32")
COLOURS = ("as drawn", "one colour per object", "a colour per triangle")
ARRAYS = ("flat", "flat, deflate", "indexed", "indexed, deflate", *(f"HDF5 {t}" for t in TEXTURES))
SAMPLES = (*PROFILES, *(f"HDF5 {t}" for t in TEXTURES))

Decode = Callable[[bytes], Mapping[str, NDArray]]
Packed = TypeVar("Packed")


def coloured(scene: Scene, colours: str) -> Scene:
    """Return the scene with other diffuse colours: one per object, or one per triangle.

    Drawn colours leave room for the specular albedo, so that the laws hold. Emitters stay.
    """
    if colours == COLOURS[0]:
        return scene
    rng = rng_for(0, "bench-shards", scene.num_triangles)
    groups = np.arange(scene.num_triangles)
    if colours == COLOURS[1]:
        groups = scene.object_index.astype(np.int64)
    _, first, index = np.unique(groups, return_index=True, return_inverse=True)
    materials = scene.materials[scene.material_index[first]]
    drawn = rng.random((len(first), 3)) * (1 - materials[:, SPECULAR])
    dark = scene.triangle_emits[first, None]
    materials[:, DIFFUSE] = np.where(dark, materials[:, DIFFUSE], drawn)
    return dataclasses.replace(scene, materials=materials, material_index=index.astype(np.uint16))


def array_figures(
    samples: Sequence[Sample], form: str, colours: str, work: Path
) -> Mapping[str, float]:
    """Unpack the arrays of scenes in one form; files are written to `work` before."""
    packed = [_packed(coloured(sample.scene, colours), form, work) for sample in samples]
    return _unpacking(packed, _decoder(form))


def sample_figures(samples: Sequence[Sample], kind: str, work: Path) -> Mapping[str, float]:
    """Decode whole samples, arrays and pictures, of a profile or of the published HDF5."""
    if kind in PROFILES:
        return _decoding([encode_sample(sample, kind) for sample in samples])
    texture = TEXTURES[SAMPLES.index(kind) - len(SAMPLES)]
    packed = [_h5(sample.scene, work, texture, sample.radiance_rgb) for sample in samples]
    return _unpacking(packed, _read_h5)


def _packed(scene: Scene, form: str, work: Path) -> bytes:
    if form.startswith("HDF5"):
        return _h5(scene, work, TEXTURES[ARRAYS.index(form) - len(ARRAYS)], None)
    arrays = {name: getattr(scene, name) for name in ARRAY_FIELDS}
    if form.startswith("flat"):
        corners = scene.faces.astype(np.int64)
        arrays = {
            "triangles": scene.vertex_positions[corners],
            "normals": scene.vertex_normals[corners],
            "material": scene.materials[scene.material_index],
            "c2w": scene.c2w,
            "fov_deg": scene.fov_deg,
        }
    data = save({name: np.ascontiguousarray(values) for name, values in arrays.items()})
    (member,) = pack_arrays(data, "compact" if "deflate" in form else "lossless").values()
    return member


def _decoder(form: str) -> Decode:
    if form.startswith("HDF5"):
        return _read_h5
    if "deflate" in form:
        return lambda data: load(unpack_arrays({"scene.safetensors.gz": data}))
    return load


def _h5(
    scene: Scene, work: Path, texture_type: TextureType, radiance_rgb: NDArray[np.float32] | None
) -> bytes:
    path = work / "scene.h5"
    write_renderformer_h5(path, scene, radiance_rgb, texture_type=texture_type)
    return path.read_bytes()


def _read_h5(data: bytes) -> Mapping[str, NDArray]:
    """Read every array as it is, as a loader that trusts its files does."""
    with h5py.File(io.BytesIO(data)) as file:
        return {name: file[name][()] for name in file}


def _unpacking(packed: Sequence[bytes], decode: Decode) -> Mapping[str, float]:
    return _timed(packed, lambda data: sum(x.nbytes for x in decode(data).values()), len)


def _decoding(samples: Sequence[Mapping[str, bytes]]) -> Mapping[str, float]:
    def memory(members: Mapping[str, bytes]) -> int:
        sample = decode_sample("0", members)
        arrays = sum(getattr(sample.scene, name).nbytes for name in ARRAY_FIELDS)
        return int(arrays + sample.radiance_rgb.nbytes)

    return _timed(samples, memory, lambda members: sum(map(len, members.values())))


def _timed(
    packed: Sequence[Packed], unpacked_bytes: Callable[[Packed], int], size: Callable[[Packed], int]
) -> Mapping[str, float]:
    """Unpack everything; return means of the bytes before and after, and of the time."""
    started = time.process_time()
    memory = sum(map(unpacked_bytes, packed))
    spent = time.process_time() - started
    return {
        "bytes": float(np.mean([size(one) for one in packed])),
        "memory_bytes": memory / len(packed),
        "decode_ms": 1000 * spent / len(packed),
    }
