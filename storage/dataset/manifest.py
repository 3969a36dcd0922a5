"""The manifest: what a dataset is, in one file that only ever appears whole.

It names the settings in full, what the pictures depend on (Mitsuba variant, processor, library
versions), and each shard with its digest; where a member stands in a shard, its own headers say.
The dataset digest is taken over the shards, the object lock and the settings; "the same bytes"
always means this digest.

While a dataset is made, its manifest is the head alone, a few kilobytes, and each finished shard
has a note (storage.dataset.shard_notes): no maker reads or writes what the others have made. Who
finds all shards there lists them, once.
"""

import contextlib
import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from storage.atomic import atomic_writer
from storage.conventions import MANIFEST_VERSION, READABLE_MANIFESTS, SPLITS, require_readable
from storage.dataset.json_pieces import entries
from storage.dataset.layout import numbered
from storage.dataset.shard import scan_samples
from storage.digests import canonical_json, sha256_hex, sha256_of_stream
from storage.errors import TrilightError

SHARD_NAME = re.compile(rf"(?:part-\d{{4,6}}/)?({'|'.join(SPLITS)})-(\d{{6}})\.tar")
"""Names are relative to the manifest and cannot leave its folder."""


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """One shard as the manifest describes it."""

    name: str
    """File name beside the manifest, or in one of the parts of its folder
    (storage.dataset.layout)."""
    split: str
    """train, validation or test."""
    num_samples: int
    """Scenes in it."""
    num_bytes: int
    """Size of the file."""
    sha256: str
    """Digest of the file."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What `manifest.json` says."""

    build: str
    """Name of the build."""
    settings: Mapping[str, Any]
    """All settings of the build; a dataset keeps them for life."""
    environment: Mapping[str, Any]
    """What the bytes depend on besides the settings: variant, processor, library versions."""
    num_scenes: int
    """How many scenes were asked for so far; more extend the dataset."""
    num_views: int
    """Pictures per scene."""
    objects_lock_sha256: str
    """Digest of `objects.lock.jsonl`; empty until the objects are prepared."""
    shards: tuple[ShardEntry, ...]
    """The finished shards by number; none while they are made."""
    growing: tuple[str, ...] = ()
    """Shards that are there, and are packed again when they have all scenes: each was the last."""
    schema_version: int = MANIFEST_VERSION
    """Version that was read; what is written has MANIFEST_VERSION."""
    extensions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The sha256 of each extension that took part in making it, by its file name; nothing that is
    named here is ever imported (storage.extensions)."""

    @property
    def num_samples(self) -> int:
        return sum(shard.num_samples for shard in self.shards)

    @property
    def num_bytes(self) -> int:
        return sum(shard.num_bytes for shard in self.shards)

    @property
    def identity(self) -> object:
        """What scenes that are not in a shard yet depend on."""
        return (self.settings, self.environment, self.objects_lock_sha256, self.extensions)

    def with_grown(self, shard: ShardEntry) -> "Manifest":
        """Return the manifest once a shard has grown: where it is listed, by its new entry."""
        shards = tuple(shard if entry.name == shard.name else entry for entry in self.shards)
        growing = tuple(name for name in self.growing if name != shard.name)
        return dataclasses.replace(self, shards=shards, growing=growing)

    @property
    def dataset_digest(self) -> str:
        """sha256 over the sorted shard digests, the object lock and the settings."""
        shards = sorted([shard.name, shard.sha256] for shard in self.shards)
        return sha256_hex(canonical_json([shards, self.objects_lock_sha256, dict(self.settings)]))


def number_of_shard(shard: ShardEntry) -> int:
    """Return the number of a shard, by which shards are listed."""
    return int(shard.name.removesuffix(".tar").rpartition("-")[2])


def index_shard(path: Path) -> ShardEntry:
    """Return the manifest entry of a shard file by reading it.

    Raises:
        TrilightError: the name is not a shard's, or the file is not a whole shard.
    """
    with path.open("rb") as stream:
        return index_stream(stream, path.name)


def index_stream(stream: BinaryIO, name: str) -> ShardEntry:
    """Return the manifest entry of an open shard; raises as `index_shard` does."""
    match = SHARD_NAME.fullmatch(name)
    if match is None:
        raise TrilightError(f"{name}: not a shard; expected a name like train-000003.tar.")
    num_samples = sum(1 for _ in scan_samples(stream, name))
    num_bytes = stream.seek(0, 2)
    stream.seek(0)
    return ShardEntry(
        name=numbered(int(match[2]), PurePosixPath(name).name),
        split=match[1],
        num_samples=num_samples,
        num_bytes=num_bytes,
        sha256=sha256_of_stream(stream),
    )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest atomically, a shard a line; equal manifests give equal bytes."""
    record = _fields(manifest) | {"schema_version": MANIFEST_VERSION}
    record["totals"] = {"samples": manifest.num_samples, "bytes": manifest.num_bytes}
    record["dataset_digest"] = manifest.dataset_digest
    for later in ("extensions", "growing"):  # as manifests were written before there were any
        if not record[later]:
            del record[later]
    record["shards"] = []
    head, mark, tail = json.dumps(record, indent=1, sort_keys=True).partition(
        '\n "shards": ['
    )  # no text of JSON holds a line break
    with atomic_writer(path) as stream:  # row by row: there may be a million
        stream.write(f"{head}{mark}".encode())
        for number, shard in enumerate(manifest.shards):
            row = json.dumps(shard_row(shard), sort_keys=True)
            stream.write(f"{',' if number else ''}\n  {row}".encode())
        stream.write(f"{tail}\n".encode())


def shard_row(shard: ShardEntry) -> dict[str, Any]:
    """Return the JSON values of an entry."""
    return _fields(shard)


def _fields(record: Manifest | ShardEntry) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


def read_manifest(path: Path) -> Manifest:
    """Return the manifest of a file, as far as it is listed.

    Raises:
        TrilightError: missing, not JSON, another schema version, or a shard name that is none.
    """
    return _read(path, decode_manifest)


def read_head(path: Path) -> Manifest:
    """Return the manifest of a file without its shards, which are not read; otherwise as it."""
    return _read(path, decode_head)


def _read(path: Path, decode: Callable[[BinaryIO, str], Manifest]) -> Manifest:
    try:
        with path.open("rb") as stream:
            return decode(stream, str(path))
    except FileNotFoundError as error:
        raise TrilightError(
            f"{path.parent}: no manifest.json here; expected the folder of a dataset, as "
            "`trilight generate ... --out` makes it."
        ) from error
    except OSError as error:
        raise TrilightError(f"{path}: not a readable manifest ({error}).") from error


def decode_manifest(stream: BinaryIO, place: str) -> Manifest:
    """Return the manifest of an open file; one shard at a time is held as JSON.

    Args:
        stream: the file.
        place: where it is, for messages.

    Raises:
        TrilightError: as `read_manifest`.
    """
    with _decoding(place):
        return _manifest(entries(stream), place)


def decode_head(stream: BinaryIO, place: str) -> Manifest:
    """Return the manifest of an open file without its shards; otherwise as `decode_manifest`."""

    def up_to_shards() -> Iterator[tuple[str, Any]]:
        for name, value in entries(stream):
            if name in ("shards", "totals"):  # they come last: names are sorted
                return
            yield name, value

    with _decoding(place):
        return _manifest(up_to_shards(), place)


@contextlib.contextmanager
def _decoding(place: str) -> Iterator[None]:
    try:
        yield
    except TrilightError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise TrilightError(f"{place}: not a readable manifest ({error}).") from error


def _manifest(found: Iterable[tuple[str, Any]], place: str) -> Manifest:
    record: dict[str, Any] = {}
    shards: list[ShardEntry] = []
    growing: list[str] = []
    for name, value in found:
        if name == "growing":  # a list comes entry by entry
            growing.append(str(value))
            continue
        if name == "shards":
            shards.append(shard_of_row(value))
            continue
        if name == "schema_version":  # it comes before the shards, which it explains
            require_readable(value, place, READABLE_MANIFESTS)
        record[name] = value
    require_readable(record.get("schema_version"), place, READABLE_MANIFESTS)
    del record["dataset_digest"]
    record.pop("totals", None)
    if not all(isinstance(sha256, str) for sha256 in record.get("extensions", {}).values()):
        raise ValueError("extensions without digests")
    return Manifest(shards=tuple(shards), growing=tuple(growing), **record)


def shard_of_row(row: dict[str, Any]) -> ShardEntry:
    """Return the entry of what `shard_row` gave.

    Raises:
        KeyError, TypeError, ValueError: it was something else.
    """
    if not SHARD_NAME.fullmatch(row["name"]):
        raise ValueError(f"shard name {row['name']!r}")
    return ShardEntry(
        **{name: value for name, value in row.items() if name != "members"}
    )  # before version 5, rows had an index of their members
