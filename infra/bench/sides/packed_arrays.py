"""Scene arrays and whole samples: ours against flat triangles and the published HDF5 files."""

import dataclasses
import io
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

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
    memory = 0
    started = time.process_time()
    for data in packed:
        memory += sum(values.nbytes for values in decode(data).values())
    spent = time.process_time() - started
    return _figures([len(data) for data in packed], memory, spent)


def _decoding(samples: Sequence[Mapping[str, bytes]]) -> Mapping[str, float]:
    memory = 0
    started = time.process_time()
    for members in samples:
        sample = decode_sample("0", members)
        memory += sum(getattr(sample.scene, name).nbytes for name in ARRAY_FIELDS)
        memory += sample.radiance_rgb.nbytes
    spent = time.process_time() - started
    sizes = [sum(len(data) for data in members.values()) for members in samples]
    return _figures(sizes, memory, spent)


def _figures(sizes: Sequence[int], memory: int, spent: float) -> Mapping[str, float]:
    return {
        "bytes": float(np.mean(sizes)),
        "memory_bytes": memory / len(sizes),
        "decode_ms": 1000 * spent / len(sizes),
    }
