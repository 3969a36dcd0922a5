"""The manifest: what a dataset is, in one file that only ever appears whole.

It names the settings in full, what the pictures depend on (Mitsuba variant, processor, library
versions), and each shard with its digest and an index of its members. The dataset digest is taken
over the shards, the object lock and the settings; "the same bytes" always means this digest.
"""

import dataclasses
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from storage.atomic import write_atomically
from storage.conventions import SCHEMA_VERSION, SPLITS, require_readable
from storage.digests import canonical_json, sha256_hex, sha256_of_stream
from storage.errors import TrilightError
from storage.layout import numbered
from storage.shard_reader import MAX_MEMBER_BYTES, MEMBER_NAME, scan_samples

SHARD_NAME = re.compile(rf"(?:part-\d{{4,6}}/)?({'|'.join(SPLITS)})-(\d{{6}})\.tar")
"""Names are relative to the manifest and cannot leave its folder."""


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """One shard as the manifest describes it."""

    name: str
    """File name beside the manifest, or in one of the parts of its folder (storage.layout)."""
    split: str
    """train, validation or test."""
    num_samples: int
    """Scenes in it."""
    num_bytes: int
    """Size of the file."""
    sha256: str
    """Digest of the file."""
    members: tuple[tuple[str, int, int], ...]
    """Name, offset of the first byte, and number of bytes of each member."""

    @property
    def index(self) -> Mapping[str, Mapping[str, tuple[int, int]]]:
        """Offset and number of bytes of each member, by key and suffix."""
        index: dict[str, dict[str, tuple[int, int]]] = {}
        for name, offset, num_bytes in self.members:
            key, _, suffix = name.partition(".")
            index.setdefault(key, {})[suffix] = (offset, num_bytes)
        return index


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What `manifest.json` says."""

    build: str
    """Name of the build."""
    settings: Mapping[str, Any]
    """All settings of the build; a dataset keeps them for life."""
    environment: Mapping[str, Any]
    """What the bytes depend on beside the settings: variant, processor, library versions."""
    num_scenes: int
    """How many scenes were asked for so far; more extend the dataset."""
    num_views: int
    """Pictures per scene."""
    objects_lock_sha256: str
    """Digest of `objects.lock.jsonl`; empty until the objects are prepared."""
    shards: tuple[ShardEntry, ...]
    """The finished shards, by name."""
    schema_version: int = SCHEMA_VERSION
    """Version of the formats."""

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
    samples = list(scan_samples(stream, name))
    num_bytes = stream.seek(0, 2)
    stream.seek(0)
    return ShardEntry(
        name=numbered(int(match[2]), PurePosixPath(name).name),
        split=match[1],
        num_samples=len(samples),
        num_bytes=num_bytes,
        sha256=sha256_of_stream(stream),
        members=tuple(
            (f"{key}.{suffix}", member.offset, member.num_bytes)
            for key, members in samples
            for suffix, member in members.items()
        ),
    )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest atomically; equal manifests give equal bytes."""
    record = dataclasses.asdict(manifest)
    record["totals"] = {"samples": manifest.num_samples, "bytes": manifest.num_bytes}
    record["dataset_digest"] = manifest.dataset_digest
    write_atomically(path, json.dumps(record, indent=1, sort_keys=True).encode() + b"\n")


def read_manifest(path: Path) -> Manifest:
    """Return the manifest of a file.

    Raises:
        TrilightError: missing, not JSON, another schema version, or a shard name that is none.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise TrilightError(
            f"{path.parent}: no manifest.json here; expected the folder of a dataset, as "
            "`trilight generate ... --out` makes it."
        ) from error
    except OSError as error:
        raise TrilightError(f"{path}: not a readable manifest ({error}).") from error
    return decode_manifest(data, str(path))


def decode_manifest(data: bytes, place: str) -> Manifest:
    """Return the manifest of the bytes of a file; raises as `read_manifest`, naming `place`."""
    try:
        record = json.loads(data)
        version = record.pop("schema_version")
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise TrilightError(f"{place}: not a readable manifest ({error}).") from error
    require_readable(version, place)
    try:
        return _decode(record, version)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TrilightError(f"{place}: not a readable manifest ({error}).") from error


def _decode(record: dict[str, Any], version: int) -> Manifest:
    del record["totals"], record["dataset_digest"]
    shards = []
    for row in record.pop("shards"):
        if not SHARD_NAME.fullmatch(row["name"]):
            raise ValueError(f"shard name {row['name']!r}")
        row["members"] = tuple((str(n), int(at), int(size)) for n, at, size in row["members"])
        for name, at, size in row["members"]:
            if not (MEMBER_NAME.fullmatch(name) and at >= 0 and 0 <= size <= MAX_MEMBER_BYTES):
                raise ValueError(f"member {name!r} of {size} bytes at {at}")
        shards.append(ShardEntry(**row))
    return Manifest(shards=tuple(shards), schema_version=version, **record)
