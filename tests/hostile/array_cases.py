"""Scenes as plain arrays, safetensors and HDF5, of somebody who means harm."""

import json
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from safetensors.numpy import load, save

from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from storage.records.scene_file import encode_scene
from tests.scenes_by_hand import tiny_scene

Make = Callable[[Path], object]
NAN, INF = float("nan"), float("inf")


def _safetensors(change: Callable[[bytes], bytes]) -> Make:
    return lambda folder: (folder / "s.safetensors").write_bytes(change(encode_scene(tiny_scene())))


def _arrays(change: Callable[[dict[str, Any]], Any]) -> Make:
    def changed(data: bytes) -> bytes:
        arrays = {name: values.copy() for name, values in load(data).items()}
        length = int.from_bytes(data[:8], "little")
        metadata = json.loads(data[8 : 8 + length])["__metadata__"]
        change(arrays)
        return save(arrays, metadata)

    return _safetensors(changed)


def _header(change: Callable[[dict[str, Any]], Any]) -> Make:
    def changed(data: bytes) -> bytes:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        change(header)
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return _safetensors(changed)


def _put(name: str, value: float) -> Make:
    return _arrays(lambda arrays: arrays[name].reshape(-1).__setitem__(0, value))


def _claim(field: str, value: Any) -> Make:
    return _header(lambda header: header["faces"].update({field: value}))


def _metadata(text: str) -> Make:
    return _header(lambda header: header["__metadata__"].update(trilight_scene=text))


def _bytes(name: str, data: bytes) -> Make:
    return lambda folder: (folder / name).write_bytes(data)


def _cut(part: float) -> Make:
    return _safetensors(lambda data: data[: int(len(data) * part)])


def safetensors_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.safetensors`, and what has to come of it."""
    for name in ("vertex_positions", "vertex_normals", "materials", "c2w", "fov_deg"):
        for value in (NAN, INF):
            yield f"{name} {value}", _put(name, value), "refused"
    for name in ("faces", "material_index", "object_index"):
        yield f"{name} out of range", _put(name, 60_000), "refused"
    yield "an array missing", _arrays(lambda a: a.pop("faces")), "refused"
    yield "an array too many", _arrays(lambda a: a.update(x=np.zeros(3))), "refused"
    of_doubles = _arrays(lambda a: a.update(faces=a["faces"].astype(np.float64)))
    yield "another type", of_doubles, "refused"
    for shape in ([2**62, 3], [-1, 3], [10**9, 3], "x", None, [3.5, 3], [[1], 3]):
        yield f"shape {shape}", _claim("shape", shape), "refused"
    for offsets in ([0, 2**60], [-5, 9], [9, 0], "x", [0]):
        yield f"offsets {offsets}", _claim("data_offsets", offsets), "refused"
    yield "no metadata", _header(lambda header: header.pop("__metadata__")), "refused"
    for text in ("", "[]", "{}", "[" * 10**5, '{"schema_version": 99}', "\0"):
        yield f"metadata {text[:20]!r}", _metadata(text), "refused"
    for kind, data in {
        "empty": b"", "8 bytes": b"\xff" * 8, "a header of 2^63": struct.pack("<Q", 2**63) + b"{}",
        "noise": bytes(range(256)) * 9, "a deep header": struct.pack("<Q", 10**6) + b"[" * 10**6,
    }.items():  # fmt: skip
        yield f"safetensors is {kind}", _bytes("s.safetensors", data), "refused"
    for part in (0.1, 0.5, 0.99):
        yield f"cut at {part}", _cut(part), "refused"
    yield "bytes too many", _safetensors(lambda d: d + b"x"), "refused"
    yield "safetensors is a fifo", lambda f: os.mkfifo(f / "s.safetensors"), "refused"

    def sparse(folder: Path) -> None:
        (folder / "s.safetensors").touch()
        os.truncate(folder / "s.safetensors", 8 << 40)

    yield "safetensors of 8 TB", sparse, "refused"


def _h5(change: Callable[[h5py.File, Path], Any]) -> Make:
    def make(folder: Path) -> None:
        write_renderformer_h5(folder / "s.h5", tiny_scene())
        with h5py.File(folder / "s.h5", "r+") as file:
            change(file, folder)

    return make


def _link_out(file: h5py.File, folder: Path) -> None:
    del file["triangles"]
    file["triangles"] = h5py.ExternalLink("../outside/secret.h5", "/triangles")


def h5_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.h5`, and what has to come of it; test_safe_h5.py has more."""
    yield "external link", _h5(_link_out), "refused"
    for kind, data in {"empty": b"", "noise": bytes(range(256)) * 99}.items():
        yield f"HDF5 is {kind}", _bytes("s.h5", data), "refused"
    for seed in range(8):

        def flipped(folder: Path, seed: int = seed) -> None:
            write_renderformer_h5(folder / "s.h5", tiny_scene())
            data = np.frombuffer((folder / "s.h5").read_bytes(), np.uint8).copy()
            rng = np.random.default_rng(seed)
            data[rng.integers(0, len(data), 20)] = rng.integers(0, 256, 20)
            (folder / "s.h5").write_bytes(data[: len(data) - seed * 500].tobytes())

        yield f"HDF5 damaged {seed}", flipped, "any"
    yield "HDF5 is a fifo", lambda folder: os.mkfifo(folder / "s.h5"), "refused"
