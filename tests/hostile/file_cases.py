"""Scene files and shards of somebody who means harm, but for USD: what each can claim.

Every function of cases yields a name, what writes the file, and what has to come of it.
"""

import io
import json
import operator
import os
import struct
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.exchange.renderformer_h5 import write_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene
from tests.scenes_by_hand import tiny_sample, tiny_scene

Make = Callable[[Path], object]


def _sparse(path: Path) -> None:
    """Make a file of 8 TB that takes no room."""
    path.touch()
    os.truncate(path, 8 << 40)


def _bytes(name: str, data: bytes) -> Make:
    return lambda folder: (folder / name).write_bytes(data)


def _safetensors(change: Callable[[bytes], bytes]) -> Make:
    return lambda folder: (folder / "s.safetensors").write_bytes(change(encode_scene(tiny_scene())))


def _header(change: Callable[[dict[str, Any]], Any]) -> Make:
    def changed(data: bytes) -> bytes:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])
        change(header)
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return _safetensors(changed)


def _claim(field: str, value: Any) -> Make:
    return _header(lambda header: header["faces"].update({field: value}))


def _cut(part: float) -> Make:
    return _safetensors(lambda data: data[: int(len(data) * part)])


def safetensors_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.safetensors`; values and metadata are those of test_scene.py."""
    for shape in ([2**62, 3], [-1, 3], [10**9, 3], "x", None, [3.5, 3], [[1], 3]):
        yield f"shape {shape}", _claim("shape", shape), "refused"
    for offsets in ([0, 2**60], [-5, 9], [9, 0], "x", [0]):
        yield f"offsets {offsets}", _claim("data_offsets", offsets), "refused"
    yield "no metadata", _header(lambda header: header.pop("__metadata__")), "refused"
    for kind, data in {
        "empty": b"", "8 bytes": b"\xff" * 8, "a header of 2^63": struct.pack("<Q", 2**63) + b"{}",
        "noise": bytes(range(256)) * 9, "a deep header": struct.pack("<Q", 10**6) + b"[" * 10**6,
    }.items():  # fmt: skip
        yield f"safetensors is {kind}", _bytes("s.safetensors", data), "refused"
    for part in (0.1, 0.5, 0.99):
        yield f"cut at {part}", _cut(part), "refused"
    yield "bytes too many", _safetensors(lambda d: d + b"x"), "refused"
    yield "safetensors is a fifo", lambda f: os.mkfifo(f / "s.safetensors"), "refused"
    yield "safetensors of 8 TB", lambda f: _sparse(f / "s.safetensors"), "refused"


def h5_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.h5`, and what comes of it; test_renderformer_h5.py has more."""
    yield "HDF5 is noise", _bytes("s.h5", bytes(range(256)) * 99), "refused"
    for seed in range(8):

        def flipped(folder: Path, seed: int = seed) -> None:
            write_renderformer_h5(folder / "s.h5", tiny_scene())
            data = np.frombuffer((folder / "s.h5").read_bytes(), np.uint8).copy()
            rng = np.random.default_rng(seed)
            data[rng.integers(0, len(data), 20)] = rng.integers(0, 256, 20)
            (folder / "s.h5").write_bytes(data[: len(data) - seed * 500].tobytes())

        yield f"HDF5 damaged {seed}", flipped, "any"
    yield "HDF5 is a fifo", lambda folder: os.mkfifo(folder / "s.h5"), "refused"


LEAK_OBJ = "v 777 0 0\nv 778 0 0\nv 777 1 0\nf 1 2 3\n"


def _base(folder: Path) -> dict[str, Any]:
    write_renderformer_json(folder / "s.json", tiny_scene())
    return dict(json.loads((folder / "s.json").read_bytes()))


def _changed(*where: Any, value: Any) -> Make:
    """Return what writes the scene with one field changed; ANY is the first name of a group."""

    def make(folder: Path) -> None:
        scene = _base(folder)
        at: Any = scene
        for key in where[:-1]:
            at = at[next(iter(at)) if key == "ANY" else key]
        at[where[-1]] = value
        (folder / "s.json").write_text(json.dumps(scene))

    return make


def _mesh(spoil: Callable[[Path], object]) -> Make:
    def make(folder: Path) -> None:
        spoil(folder / "odd.obj")
        _changed("objects", "ANY", "mesh_path", value="odd.obj")(folder)

    return make


def json_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.json`, what comes of it; test_renderformer_json.py has more."""
    mesh = ("objects", "ANY", "mesh_path")
    values: tuple[Any, ...] = (
        "../outside/secret.obj", "/etc/passwd", "linked/secret.obj", "link.obj", "", ".", "..",
        "objects", "no.obj", "x\0y", "a" * 5000, "https://x.y/z.obj", "file:///etc/passwd",
        "~/x.obj", "s.json", "objects/../../outside/secret.obj", 3, None, [], {},
    )  # fmt: skip
    for value in values:
        yield f"mesh {str(value)[:30]!r}", _changed(*mesh, value=value), "refused"
    kinds: dict[str, Callable[[Path], object]] = {
        "fifo": os.mkfifo,
        "device": lambda path: path.symlink_to("/dev/zero"),
        "folder": lambda path: path.mkdir(),
        "empty": lambda path: path.touch(),
        "noise": lambda path: path.write_bytes(bytes(range(256)) * 99),
        "NaN": lambda path: path.write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        "beyond": lambda path: path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n"),
        "8 TB": _sparse,
    }
    for kind, spoil in kinds.items():
        yield f"mesh is {kind}", _mesh(spoil), "refused"
    over = _changed("objects", "ANY", "material", "specular", value=[0.9] * 3)
    yield "diffuse and specular", over, "any"
    bright = _changed("objects", "ANY", "material", "emissive", value=[1e9] * 3)
    yield "emission 1e9", bright, "any"
    same = _changed("cameras", 0, "position", value=[0, 0, 0])
    yield "a camera that looks at itself", same, "any"
    yield "no cameras", _changed("cameras", value=[]), "any"
    yield "a field that is not known", _changed("script", value="rm -rf"), "read"
    remesh = _changed("objects", "ANY", "remesh_target_face_num", value=10**9)
    yield "remeshed to 10^9 faces", remesh, "refused"
    for kind, data in {"noise": bytes(range(256)), "cut": b'{"scene_name": "x"'}.items():
        yield f"JSON is {kind}", _bytes("s.json", data), "refused"
    yield "JSON is a fifo", lambda folder: os.mkfifo(folder / "s.json"), "refused"
    yield "JSON is endless", lambda f: (f / "s.json").symlink_to("/dev/zero"), "refused"
    yield "JSON of 8 TB", lambda folder: _sparse(folder / "s.json"), "refused"


KEY = "000000003"


def _members() -> dict[str, bytes]:
    return {f"{KEY}.{suffix}": data for suffix, data in encode_sample(tiny_sample(KEY)).items()}


def _plain(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


def _tar(change: Callable[[bytes], bytes]) -> Make:
    return lambda folder: (folder / "s.tar").write_bytes(change(_plain(_members())))


def _sample(**changes: bytes | None) -> Make:
    """Return what writes the sample with members changed, or without those that are None."""

    def make(folder: Path) -> None:
        members = _members()
        for suffix, data in changes.items():
            name = f"{KEY}.{suffix.replace('_', '.')}"
            if data is None:
                members.pop(name)
            else:
                members[name] = data
        (folder / "s.tar").write_bytes(_plain(members))

    return make


def _with_entry(**fields: Any) -> Make:
    """Return what writes a shard with one member of another kind in front."""

    def make(folder: Path) -> None:
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w", format=fields.pop("format", 0)) as archive:
            entry = tarfile.TarInfo(fields.pop("name", f"{KEY}.x"))
            for name, value in fields.items():
                setattr(entry, name, value)
            archive.addfile(entry)
        head = stream.getvalue()[:512]
        (folder / "s.tar").write_bytes(head + _plain(_members()))

    return make


def _field(start: int, end: int, text: bytes) -> Make:
    """Return what writes the shard with bytes of its first header changed, its sum made right."""

    def change(data: bytes) -> bytes:
        block = bytearray(data[:512])
        block[start:end] = text.ljust(end - start, b"\0")
        block[148:156] = b" " * 8
        block[148:156] = f"{sum(block):06o}\0 ".encode()
        return bytes(block) + data[512:]

    return _tar(change)


def tar_cases() -> Iterator[tuple[str, Make, str]]:
    """Yield name, what writes `s.tar`, and what has to come of its first sample."""
    for kind in "SYMTYPE LNKTYPE DIRTYPE FIFOTYPE CHRTYPE BLKTYPE CONTTYPE GNUTYPE_SPARSE".split():
        entry = {"type": getattr(tarfile, kind), "linkname": "/etc/passwd"}
        yield f"a member of type {kind}", _with_entry(**entry), "refused"
    for name in ("/etc/x", "../x", "a/../../x", "x", ".x", "a b.c", "ä.x", "a" * 99):
        yield f"a member named {name[:20]!r}", _with_entry(name=name), "refused"
    yield "a long name by pax", _with_entry(name="a" * 300, format=tarfile.PAX_FORMAT), "refused"
    yield "a long name by GNU", _with_entry(name="a" * 300, format=tarfile.GNU_FORMAT), "refused"
    for kind, size in {
        "2^33": b"77777777777", "negative": b"-0000000001", "binary": b"\x80" + b"\xff" * 11,
        "binary negative": b"\xff" * 12, "text": b"many", "nothing": b"",
    }.items():  # fmt: skip
        yield f"size of {kind}", _field(124, 136, size), "refused"
    yield "a wrong sum", _tar(lambda d: d[:148] + b"0000000\0" + d[156:]), "refused"
    for part in (0, 100, 512, 5000):
        yield f"cut at {part}", _tar(operator.itemgetter(slice(part))), "refused"
    yield "no end", _tar(lambda d: d.rstrip(b"\0")), "refused"
    yield "all twice", _tar(lambda d: d.rstrip(b"\0").ljust(-(-len(d) // 512) * 512) + d), "refused"
    yield "noise", _tar(lambda d: bytes(range(256)) * 99), "refused"
    yield "empty", _tar(lambda d: bytes(1024)), "refused"
    for kind, data in {
        "deep": b'{"schema_version": 3, "x": ' + b"[" * 10**6, "a list": b"[]", "empty": b"",
        "noise": bytes(range(256)), "of another version": b'{"schema_version": 99}',
        "short": b'{"schema_version": 3}',
        "odd": b'{"schema_version": 3, "views": [1], "objects": {}, "provenance": 0}',
    }.items():  # fmt: skip
        yield f"record is {kind}", _sample(json=data), "refused"
    yield "no record", _sample(json=None), "refused"
    yield "no arrays", _sample(scene_safetensors=None), "refused"
    yield "arrays are noise", _sample(scene_safetensors=bytes(range(256)) * 9), "refused"
    packed = _sample(scene_safetensors=None, scene_safetensors_gz=b"\x1f\x8b\x08" + bytes(99))
    yield "packed arrays are noise", packed, "refused"
    yield "shard is a fifo", lambda folder: os.mkfifo(folder / "s.tar"), "refused"
