"""The manifest: what a dataset is, in one file that only ever appears whole.

It names the settings in full, what the pictures depend on (Mitsuba variant, processor, library
versions), and each shard with its digest and an index of its members. The dataset digest is taken
over the shards, the object lock and the settings; "the same bytes" always means this digest.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, overload

import numpy as np
from numpy.typing import NDArray

from storage.atomic import atomic_writer
from storage.conventions import MAPS_VERSION, SCHEMA_VERSION, SPLITS, require_readable
from storage.dataset.json_pieces import entries
from storage.dataset.layout import numbered
from storage.dataset.shard import MAX_MEMBER_BYTES, MEMBER_NAME, Member, scan_samples
from storage.digests import canonical_json, sha256_hex, sha256_of_stream
from storage.errors import TrilightError
from storage.records.map_references import MAP_NAME

Row = tuple[str, int, int]
"""Name, offset of the first byte, number of bytes."""


_A_MAP = re.compile(rb"(?m)^" + MAP_NAME.pattern.encode() + rb"$")


class MemberTable(Sequence[Row]):
    """Rows that are unpacked when they are asked for: ask for all of them at once."""

    __slots__ = ("_names", "_places", "has_maps")

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        """Pack rows; names hold no line break, numbers are whole ones from 0 to below 2^63."""
        held = list(rows)
        self._names = "\n".join(name for name, _, _ in held).encode()
        self.has_maps = _A_MAP.search(self._names) is not None
        self._places: NDArray[np.int64] = np.array(
            [(offset, num_bytes) for _, offset, num_bytes in held], np.int64
        ).reshape(-1, 2)

    def __iter__(self) -> Iterator[Row]:
        names = self._names.decode().split("\n") if len(self) else []
        return zip(names, *self._places.T.tolist(), strict=True)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, at: int) -> Row: ...

    @overload
    def __getitem__(self, at: slice) -> Sequence[Row]: ...

    def __getitem__(self, at: int | slice) -> Row | Sequence[Row]:
        return list(self)[at]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MemberTable):
            return NotImplemented
        return self._names == other._names and np.array_equal(self._places, other._places)

    def __hash__(self) -> int:
        return hash((self._names, self._places.tobytes()))

    def __repr__(self) -> str:
        return f"MemberTable({list(self)!r})"


SHARD_NAME = re.compile(rf"(?:part-\d{{4,6}}/)?({'|'.join(SPLITS)})-(\d{{6}})\.tar")
"""Names are relative to the manifest and cannot leave its folder."""

_MOST_BYTES = 1 << 62
"""Maximum size of a shard, which fits into a MemberTable."""


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
    members: MemberTable
    """Name, offset of the first byte, and number of bytes of each member."""

    @property
    def keys(self) -> Sequence[str]:
        """The keys of its samples, in the order of the file."""
        names = (name.partition(".") for name, _, _ in self.members)
        return list(dict.fromkeys(key for key, point, _ in names if point))  # maps have no point

    @property
    def index(self) -> Mapping[str, Mapping[str, tuple[int, int]]]:
        """Offset and number of bytes of each member, by key and suffix."""
        index: dict[str, dict[str, tuple[int, int]]] = {}
        for name, offset, num_bytes in self.members:
            key, point, suffix = name.partition(".")
            if point:  # a map has none
                index.setdefault(key, {})[suffix] = (offset, num_bytes)
        return index

    @property
    def maps(self) -> Mapping[str, tuple[int, int]]:
        """Offset and number of bytes of each texture and environment map, by its name."""
        if not self.members.has_maps:
            return {}
        rows = self.members
        return {name: (offset, num) for name, offset, num in rows if MAP_NAME.fullmatch(name)}


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
    """The finished shards, by name."""
    schema_version: int = SCHEMA_VERSION
    """Version of the formats; with a map in a shard, that of maps, whatever was given."""
    extensions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The sha256 of each extension that took part in making it, by its file name; nothing that is
    named here is ever imported (storage.extensions)."""

    def __post_init__(self) -> None:
        """Note that a dataset with textures or environment maps needs readers that know them."""
        if any(shard.members.has_maps for shard in self.shards):
            object.__setattr__(self, "schema_version", MAPS_VERSION)

    @property
    def num_samples(self) -> int:
        return sum(shard.num_samples for shard in self.shards)

    @property
    def num_bytes(self) -> int:
        return sum(shard.num_bytes for shard in self.shards)

    @property
    def dataset_digest(self) -> str:
        """sha256 over the sorted shard digests, the object lock and the settings."""
        shards = sorted([shard.name, shard.sha256] for shard in self.shards)
        return sha256_hex(canonical_json([shards, self.objects_lock_sha256, dict(self.settings)]))


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
    maps: dict[str, Member] = {}
    samples = list(scan_samples(stream, name, maps))
    every = [*maps.values(), *(member for _, members in samples for member in members.values())]
    num_bytes = stream.seek(0, 2)
    stream.seek(0)
    return ShardEntry(
        name=numbered(int(match[2]), PurePosixPath(name).name),
        split=match[1],
        num_samples=len(samples),
        num_bytes=num_bytes,
        sha256=sha256_of_stream(stream),
        members=MemberTable(
            (member.name, member.offset, member.num_bytes)
            for member in sorted(every, key=lambda member: member.offset)
        ),
    )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest atomically, a shard a line; equal manifests give equal bytes."""
    record = _fields(manifest)
    record["totals"] = {"samples": manifest.num_samples, "bytes": manifest.num_bytes}
    record["dataset_digest"] = manifest.dataset_digest
    if not manifest.extensions:  # as manifests are that were written before there were any
        del record["extensions"]
    record["shards"] = []
    head, mark, tail = json.dumps(record, indent=1, sort_keys=True).partition(
        '\n "shards": ['
    )  # no text of JSON holds a line break
    with atomic_writer(path) as stream:  # row by row: the whole has a million members
        stream.write(f"{head}{mark}".encode())
        for number, shard in enumerate(manifest.shards):
            row = json.dumps(shard_row(shard), sort_keys=True)
            stream.write(f"{',' if number else ''}\n  {row}".encode())
        stream.write(f"{tail}\n".encode())


def shard_row(shard: ShardEntry) -> dict[str, Any]:
    """Return the JSON values of an entry."""
    return {**_fields(shard), "members": list(shard.members)}


def _fields(record: Manifest | ShardEntry) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


def read_manifest(path: Path) -> Manifest:
    """Return the manifest of a file.

    Raises:
        TrilightError: missing, not JSON, another schema version, or a shard name that is none.
    """
    try:
        with path.open("rb") as stream:
            return decode_manifest(stream, str(path))
    except FileNotFoundError as error:
        raise TrilightError(
            f"{path.parent}: no manifest.json here; expected the folder of a dataset, as "
            "`trilight generate ... --out` makes it."
        ) from error
    except OSError as error:
        raise TrilightError(f"{path}: not a readable manifest ({error}).") from error


def decode_manifest(
    stream: BinaryIO, place: str, shard_read: Callable[[ShardEntry], ShardEntry] = lambda s: s
) -> Manifest:
    """Return the manifest of an open file.

    One shard at a time is held as JSON: the index of a million samples then takes the 200 bytes for
    each that it needs, and not ten times as many on the way.

    Args:
        stream: the file.
        place: where it is, for messages.
        shard_read: returns what is kept of each shard; may leave its members out.

    Raises:
        TrilightError: as `read_manifest`, or as `shard_read`.
    """
    record: dict[str, Any] = {}
    shards: list[ShardEntry] = []
    try:
        for name, value in entries(stream):
            if name == "shards":
                shards.append(shard_read(shard_of_row(value)))
                continue
            if name == "schema_version":  # it comes before the shards, which it explains
                require_readable(value, place)
            record[name] = value
        require_readable(record.get("schema_version"), place)
        del record["totals"], record["dataset_digest"]
        if not all(isinstance(sha256, str) for sha256 in record.get("extensions", {}).values()):
            raise ValueError("extensions without digests")
        return Manifest(shards=tuple(shards), **record)
    except TrilightError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise TrilightError(f"{place}: not a readable manifest ({error}).") from error


def shard_of_row(row: dict[str, Any]) -> ShardEntry:
    """Return the entry of what `shard_row` gave.

    Raises:
        KeyError, TypeError, ValueError: it was something else.
    """
    if not SHARD_NAME.fullmatch(row["name"]):
        raise ValueError(f"shard name {row['name']!r}")
    members = [(str(name), int(at), int(size)) for name, at, size in row["members"]]
    for name, at, size in members:
        placed = 0 <= at < _MOST_BYTES and 0 <= size <= MAX_MEMBER_BYTES
        if not ((MEMBER_NAME.fullmatch(name) or MAP_NAME.fullmatch(name)) and placed):
            raise ValueError(f"member {name!r} of {size} bytes at {at}")
    return ShardEntry(**{**row, "members": MemberTable(members)})
