"""The manifest: what a dataset is, in one file that only ever appears whole.

It names the settings in full, what the pictures depend on (Mitsuba variant, processor, library
versions), and each shard with its digest; where a member stands in a shard, its own headers say.
The dataset digest is taken over the shards, the object lock and the settings; "the same bytes"
always means this digest.

While a dataset is made, its manifest is the head alone, a few kilobytes, and each finished shard
has a note (storage.dataset.staging): no maker reads or writes what the others have made. Who
finds all shards there lists them, once.

The settings of a dataset that is made of finished ones are those that all of its sources agree on,
and one group `derived`: what was done, and each source's build, settings, digest and what was added
to its keys.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal

from storage.atomic import atomic_writer
from storage.conventions import MANIFEST_VERSION, READABLE_MANIFESTS, SPLITS
from storage.dataset.layout import numbered_path
from storage.dataset.shard import scan_samples
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, shards_for
from storage.digests import canonical_json, sha256_hex, sha256_of_stream
from storage.errors import TrilightError, prefix_errors
from storage.records.safe_read import open_plain
from storage.remote.store import MAX_FILE_BYTES
from storage.settings.ranges import Within
from storage.typed_json import DROPPED, FINITE, Sha256, ShortText, Spelled, read_versioned

if TYPE_CHECKING:  # a stream of shards does without pydantic
    from storage.dataset.settings import SplitSettings

SHARD_NAME = re.compile(rf"(?:part-\d{{4,6}}/)?({'|'.join(SPLITS)})-(\d{{6}})\.tar")
"""Names are relative to the manifest and cannot leave its folder."""

ShardName = Annotated[str, Spelled(SHARD_NAME.pattern, "the name of a shard")]
DocumentName = Annotated[
    str, Spelled(r"(LICENSE|README)\.md|attribution\.csv|croissant\.json", "a document's name")
]
"""Document that a manifest vouches for: rights hang on it."""

_HEAD_BYTES = 1 << 22
_ROW_BYTES = 1 << 17
"""Maximum sizes of a manifest without its shards, and of a shard in it."""

Scenes = Annotated[int, Within(0, 1_000_000_000, unit="scenes")]
Bytes = Annotated[int, Within(0, 2**63 - 1, unit="bytes")]


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """One shard as the manifest describes it."""

    name: ShardName
    """File name next to the manifest, or in one of the parts of its folder
    (storage.dataset.layout)."""
    split: Annotated[str, Spelled("|".join(SPLITS), "train, validation or test")]
    """train, validation or test."""
    num_samples: Scenes
    num_bytes: Bytes
    sha256: Sha256
    members: Annotated[None, DROPPED] = dataclasses.field(default=None, compare=False, repr=False)
    """An index of its members in rows of before version 5, which is not kept."""


@dataclass(frozen=True, kw_only=True)
class _Fields:
    """Fields of a manifest, and of its file."""

    build: ShortText
    settings: Annotated[Mapping[str, Any], FINITE]
    """All settings of the preset; a dataset keeps them for life."""
    environment: Annotated[Mapping[str, Any], FINITE]
    """Inputs of the bytes other than settings: variant, processor, library versions."""
    num_scenes: Scenes
    """Requested number of scenes so far; a larger one extends the dataset."""
    num_views: Annotated[int, Within(1, 1_000_000, unit="pictures")]
    """Pictures per scene, one per camera."""
    objects_lock_sha256: Sha256 | Literal[""]
    """Digest of `objects.lock.jsonl`; empty until the objects are prepared."""
    schema_version: int = MANIFEST_VERSION
    """Version that was read; what is written has MANIFEST_VERSION."""
    extensions: Mapping[str, Sha256] = dataclasses.field(default_factory=dict)
    """The sha256 of each extension that took part in making it, by its file name; nothing that is
    named here is ever imported (storage.extensions)."""
    growing: tuple[ShardName, ...] = ()
    """Shards that are there, and are packed again when they have all scenes: each was the last."""
    documents: Mapping[DocumentName, Sha256] = dataclasses.field(default_factory=dict)
    """The sha256 of each document by name; empty until they are written, and in older manifests."""
    shards: tuple[ShardEntry, ...]
    """The finished shards by number; none while they are made."""


@dataclass(frozen=True, kw_only=True)
class Totals:
    """Sums over the shards of a manifest."""

    samples: int
    bytes: int


@dataclass(frozen=True, kw_only=True)
class StoredManifest(_Fields):
    """File of a manifest."""

    dataset_digest: Sha256
    totals: Totals | None = None
    manifest_sha256: Sha256 | None = None
    """Seal of the file (storage.digests.seal_of); older manifests have none."""


@dataclass(frozen=True, kw_only=True)
class Manifest(_Fields):
    """Content of `manifest.json`."""

    stored: StoredManifest | None = dataclasses.field(default=None, compare=False, repr=False)
    """Digests and totals as the file states them, for `trilight verify`."""

    @property
    def num_samples(self) -> int:
        return sum(shard.num_samples for shard in self.shards)

    @property
    def num_bytes(self) -> int:
        return sum(shard.num_bytes for shard in self.shards)

    def setting(self, name: str, kind: Any = object) -> Any:
        """Return a setting of a kind by its dotted name; None if it is missing, or another kind."""
        value: Any = self.settings
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value if isinstance(value, kind) else None

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the passes of each picture; none where the settings do not name them."""
        return tuple(map(str, self.setting("storage.passes", list | tuple) or ()))

    @property
    def identity(self) -> object:
        """Inputs on which scenes depend that are not in a shard yet."""
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
    """Return the manifest entry of a shard file by reading it; raises as `index_stream`."""
    with open_plain(path) as stream:
        return index_stream(stream, path.name)


def index_stream(stream: BinaryIO, name: str) -> ShardEntry:
    """Return the manifest entry of an open shard.

    Raises:
        TrilightError: the name is not a shard's, or the file is not a whole shard.
    """
    match = SHARD_NAME.fullmatch(name)
    if match is None:
        raise TrilightError(f"{name}: not a shard; expected a name like train-000003.tar.")
    num_samples = sum(1 for _ in scan_samples(stream, name))
    num_bytes = stream.seek(0, 2)
    stream.seek(0)
    return ShardEntry(
        name=numbered_path(int(match[2]), PurePosixPath(name).name),
        split=match[1],
        num_samples=num_samples,
        num_bytes=num_bytes,
        sha256=sha256_of_stream(stream),
    )


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write the manifest atomically, a shard a line; equal manifests give equal bytes."""
    seal = hashlib.sha256()
    for piece in _encode_rows(manifest, ""):
        seal.update(piece)
    with atomic_writer(path) as stream:
        for piece in _encode_rows(manifest, seal.hexdigest()):
            stream.write(piece)


def _encode_rows(manifest: Manifest, seal: str) -> Iterator[bytes]:
    """Yield the pieces of a manifest's file row by row: there may be a million."""
    record = {field.name: getattr(manifest, field.name) for field in dataclasses.fields(_Fields)}
    record |= {"schema_version": MANIFEST_VERSION, "manifest_sha256": seal, "shards": []}
    record["totals"] = {"samples": manifest.num_samples, "bytes": manifest.num_bytes}
    record["dataset_digest"] = manifest.dataset_digest
    for name in ("extensions", "documents", "growing"):  # as manifests were before there were any
        if not record[name]:
            del record[name]
    text = json.dumps(record, indent=1, sort_keys=True)  # no text of JSON holds a line break
    head, mark, tail = text.partition('\n "shards": [')
    yield f"{head}{mark}".encode()
    for number, shard in enumerate(manifest.shards):
        row = json.dumps(shard_row(shard), sort_keys=True)
        yield f"{',' if number else ''}\n  {row}".encode()
    yield f"{tail}\n".encode()


def shard_row(shard: ShardEntry) -> dict[str, Any]:
    """Return the JSON values of an entry."""
    return {name: value for name, value in vars(shard).items() if name != "members"}


def read_manifest(path: Path) -> Manifest:
    """Return the manifest of a file, as far as it is listed.

    Raises:
        TrilightError: missing, not JSON, another schema version, or a shard name that is none.
    """
    return _read(path, lambda stream, place: decode_manifest(stream.read(MAX_FILE_BYTES), place))


def read_head(path: Path) -> Manifest:
    """Return the manifest of a file without its shards, which are not read; otherwise as it."""
    return _read(path, decode_head)


def _read(path: Path, decode: Callable[[BinaryIO, str], Manifest]) -> Manifest:
    try:
        with open_plain(path) as stream:
            return decode(stream, str(path))
    except FileNotFoundError as error:
        raise missing_manifest(str(path.parent), is_there=path.parent.exists()) from error
    except OSError as error:
        raise TrilightError(f"{path}: not a readable manifest ({error}).") from error


def missing_manifest(place: str, *, is_there: bool) -> TrilightError:
    """Return the complaint about a folder or URL without a manifest, or one that is not there."""
    lacks = "no manifest.json here" if is_there else "no such folder"
    return TrilightError(
        f"{place}: {lacks}; expected a dataset, as `trilight generate ... --out` makes it."
    )


def decode_head(stream: BinaryIO, place: str) -> Manifest:
    """Return the manifest of an open file without its shards; otherwise as `decode_manifest`."""
    lines = itertools.takewhile(lambda line: not line.startswith(b' "shards": ['), stream)
    head = b"".join(lines)
    is_cut = head.endswith(b",\n")  # as `write_manifest` has it: shards and totals come last
    return decode_manifest(head + b'"shards": []}' if is_cut else head, place)


def decode_manifest(data: bytes, place: str) -> Manifest:
    """Return the manifest of a file, called `place`; raises as `read_manifest`."""
    if len(data) > _HEAD_BYTES + _ROW_BYTES * data.count(b'.tar"'):
        raise TrilightError(f"{place}: {len(data)} bytes are too many for the shards in it.")
    stored = read_versioned(data, StoredManifest, place, READABLE_MANIFESTS)
    fields = {field.name: getattr(stored, field.name) for field in dataclasses.fields(_Fields)}
    return Manifest(stored=stored, **fields)


_GROUP = "derived"
_SOURCE_FIELDS = {"build", "digest", "key_offset", "num_scenes", "settings"}


@dataclass(frozen=True, kw_only=True)
class Derivation:
    """Operation and sources of a dataset that was made of others."""

    operation: str
    """One of merge, select and reshard."""
    arguments: Mapping[str, Any]
    sources: Sequence[Mapping[str, Any]]
    """Per source: build, num_scenes, digest, key_offset, settings."""


def derivation_of(settings: Mapping[str, Any]) -> Derivation | None:
    """Return what the settings of a dataset say of its sources; None where it was generated.

    Raises:
        TrilightError: they say it in another way.
    """
    if _GROUP not in settings:
        return None
    try:
        derivation = Derivation(**settings[_GROUP])
        for source in derivation.sources:
            if set(source) != _SOURCE_FIELDS or not isinstance(source["settings"], Mapping):
                raise ValueError(f"a source with {sorted(source)}")
    except (TypeError, ValueError) as error:
        raise TrilightError(f"manifest: settings.derived is not readable ({error}).") from error
    return derivation


def source_record(manifest: Manifest, *, key_offset: int) -> dict[str, Any]:
    """Return what a derivation says of one source; `key_offset` is added to the keys of it."""
    return {
        "build": manifest.build,
        "digest": manifest.dataset_digest,
        "key_offset": key_offset,
        "num_scenes": manifest.num_samples,
        "settings": dict(manifest.settings),
    }


def derived_settings(derivation: Derivation, *, scenes_per_shard: int | None) -> dict[str, Any]:
    """Return the settings of a derived dataset.

    Args:
        derivation: how it was made.
        scenes_per_shard: of its own shards, where they are not those of the sources.
    """
    of_sources = [source["settings"] for source in derivation.sources]
    shared = common(of_sources)
    shared.pop(_GROUP, None)  # the one of a source stands in the record of that source
    if scenes_per_shard is not None:
        shared["splits"] = {**shared.get("splits", {}), "scenes_per_shard": scenes_per_shard}
    return {**shared, _GROUP: asdict(derivation)}


def common(mappings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entries that all mappings agree on, group by group."""
    first, *rest = mappings
    agreed: dict[str, Any] = {}
    for name, value in first.items():
        values = [value, *(other.get(name) for other in rest)]
        if all(isinstance(entry, Mapping) for entry in values):
            agreed[name] = common(values)
        elif all(name in other for other in rest) and all(entry == value for entry in values):
            agreed[name] = value
    return agreed


def planned_shards(manifest: Manifest) -> dict[str, int]:
    """Return the names of the shards of the finished dataset, with their numbers of scenes.

    Raises:
        TrilightError: the settings in the manifest do not say how the dataset is divided.
    """
    if derivation_of(manifest.settings):  # it only ever appears whole
        return {entry.name: entry.num_samples for entry in manifest.shards}
    splits = cut_splits(manifest.num_scenes, _splits(manifest))
    return {
        shard_name(index, splits): len(scenes_of_shard(index, splits))
        for index in range(shards_for(manifest.num_scenes, splits))
    }


def expected_scenes(manifest: Manifest) -> dict[str, int]:
    """Return `planned_shards`, less the scenes that were given up in the shards that are listed."""
    listed = {entry.name: entry.num_samples for entry in manifest.shards}
    grown = {name: count for name, count in listed.items() if name not in manifest.growing}
    return {name: grown.get(name, count) for name, count in planned_shards(manifest).items()}


def listed_scenes(manifest: Manifest) -> set[int]:
    """Return the scenes of the shards that are listed and do not grow, made or given up."""
    splits = cut_splits(manifest.num_scenes, _splits(manifest))
    full_shards = (entry for entry in manifest.shards if entry.name not in manifest.growing)
    return {
        scene for entry in full_shards for scene in scenes_of_shard(number_of_shard(entry), splits)
    }


def planned_scenes_of(manifest: Manifest, shard: ShardEntry) -> int | None:
    """Return how many scenes a shard is to hold; None for as many as fit into it."""
    splits = _splits(manifest)
    number = number_of_shard(shard)
    cut = scenes_of_shard(number, cut_splits(manifest.num_scenes, splits))
    return len(cut) if cut != scenes_of_shard(number, splits) else None


def is_whole(manifest: Manifest, num_listed: int) -> bool:
    """Return whether a manifest with so many finished shards has all, none of which still grows."""
    return not manifest.growing and num_listed >= num_planned(manifest)


def num_planned(manifest: Manifest) -> int:
    """Return how many shards there will be; of settings that do not say, those that are listed."""
    with contextlib.suppress(TrilightError):
        if not derivation_of(manifest.settings):
            return shards_for(manifest.num_scenes, _splits(manifest))
    return len(manifest.shards)


def _splits(manifest: Manifest) -> "SplitSettings":
    from storage.dataset.settings import SplitSettings  # as above
    from storage.settings.described import from_record

    with prefix_errors("manifest: settings.splits"):
        return from_record(SplitSettings, manifest.settings.get("splits"))
