"""Shards of somebody who means harm: what a tar can claim, and what a sample can."""

import io
import operator
import os
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from storage.records.sample import encode_sample
from tests.scenes_by_hand import tiny_sample

Make = Callable[[Path], object]
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


def cases() -> Iterator[tuple[str, Make, str]]:
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
