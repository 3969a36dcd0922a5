"""Finished datasets as sources of others: checked by digest, then read scene by scene."""

import contextlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.shards.scene_values import asked_values
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, index_shard, read_manifest
from storage.dataset.planned import is_whole, num_planned
from storage.dataset.shard import ShardContents, contents_of
from storage.digests import sha256_hex, sha256_of_file
from storage.errors import TrilightError
from storage.records.objects import LockedObject, locked_uids, read_objects_lock
from storage.records.profiles import PACKED, PLAIN, unpack_arrays
from storage.records.safe_read import open_plain
from storage.records.sample import decode_scene
from storage.remote.safe_url import safe_url


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedDataset:
    """A dataset that is whole."""

    folder: DatasetFolder  # its folder
    manifest: Manifest  # what it says of itself
    objects: Mapping[str, list[LockedObject]]
    """Its locked objects by uid; a merged dataset may know several under one."""


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """What decides whether a scene is taken, and where it goes."""

    shard: ShardEntry  # the shard that it is in
    key: str  # its key there
    template: str  # layout of the scene
    noise_floor_db: float  # noise floor of its worst view, as psnr_log_db
    uids: tuple[str, ...]  # objects that stand in it, and a user's own textures and map
    arrays_sha256: str  # digest of its unpacked arrays: equal for equal scenes
    values: Mapping[str, Any]  # what was asked of it, by name (pipeline.shards.expression)


def open_finished(place: str) -> FinishedDataset:
    """Open a dataset of this machine.

    Raises:
        TrilightError: a URL, no readable manifest, shards still to make, or a lock that is not the
            manifest's.
    """
    if "://" in place:
        raise TrilightError(f"{safe_url(place)}: expected the folder of a dataset on this machine.")
    folder = DatasetFolder(Path(place))
    manifest = read_manifest(folder.manifest)
    if not is_whole(manifest, len(manifest.shards)):
        done = {entry.name for entry in manifest.shards}.difference(manifest.growing)
        raise TrilightError(
            f"{place}: {len(done)} of {num_planned(manifest)} shards are there; expected a "
            "finished dataset. Run the same `trilight generate` again to finish it."
        )
    lock = folder.objects_lock
    if not lock.exists() or sha256_of_file(lock) != manifest.objects_lock_sha256:
        raise TrilightError(
            f"{place}: {lock.name} is missing or not the one of the manifest (sha256 differs); run "
            "`trilight verify`."
        )
    objects: dict[str, list[LockedObject]] = {}
    for entry in read_objects_lock(lock):
        objects.setdefault(entry.uid, []).append(entry)
    return FinishedDataset(folder=folder, manifest=manifest, objects=objects)


def read_facts(
    dataset: FinishedDataset, *, asked: Collection[str], shard_done: Callable[[], None]
) -> Iterator[SceneFacts]:
    """Yield the facts of every scene, with the values that are asked for by name.

    The digest of a shard is checked before. Memory is that of one scene. Pictures are hashed with
    the shard and not decoded.

    Raises:
        TrilightError: a shard is missing or its bytes are not those of the manifest, or the record
            of a scene is incomplete.
    """
    for shard in dataset.manifest.shards:
        require_whole(dataset, shard)
        with contextlib.closing(SampleReader(dataset)) as reader:
            for key in reader.keys(shard):
                yield _facts(shard, key, reader.members(shard, key, ("json", PLAIN, PACKED)), asked)
        shard_done()


def require_whole(dataset: FinishedDataset, shard: ShardEntry) -> None:
    """Raise TrilightError where a shard is missing or its bytes are not those of the manifest."""
    path = dataset.folder.shard(shard.name)
    if not path.exists() or index_shard(path) != shard:
        raise TrilightError(
            f"{path}: missing, or its bytes are not those of the manifest (sha256 differs); "
            "run `trilight verify`, then make the shard anew."
        )


class SampleReader:
    """Reads members of samples by key; the shard that it read last stays open. To be closed."""

    def __init__(self, dataset: FinishedDataset) -> None:
        self._folder = dataset.folder
        self._shard: ShardEntry | None = None
        self._contents = ShardContents(samples={}, maps={})
        self._stream: BinaryIO | None = None

    def keys(self, shard: ShardEntry) -> list[str]:
        """Return the keys of a shard's samples in the order of the file; the shard was checked."""
        self._open(shard)
        return list(self._contents.samples)

    def members(
        self, shard: ShardEntry, key: str, suffixes: tuple[str, ...] | None = None
    ) -> dict[str, bytes]:
        """Return members of a sample by suffix, all of them by default; the shard was checked.

        With its record come the maps that this names.
        """
        stream = self._open(shard)
        return self._contents.read(stream, key, lambda name: suffixes is None or name in suffixes)

    def _open(self, shard: ShardEntry) -> BinaryIO:
        if shard is not self._shard or self._stream is None:
            self.close()
            self._stream = open_plain(self._folder.shard(shard.name))
            self._shard, self._contents = shard, contents_of(self._stream, shard.name)
        return self._stream

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()


def _facts(
    shard: ShardEntry, key: str, members: Mapping[str, bytes], asked: Collection[str]
) -> SceneFacts:
    values = asked_values(decode_scene(key, members), shard.split, asked) if asked else {}
    try:
        record = json.loads(members["json"])
        return SceneFacts(
            shard=shard,
            key=key,
            template=str(record["provenance"]["template"]),
            noise_floor_db=min(float(view["noise_floor_db"]) for view in record["views"]),
            uids=tuple(
                locked_uids(
                    ((str(row["kind"]), str(row["uid"])) for row in record["objects"]),
                    record["provenance"],
                )
            ),
            arrays_sha256=sha256_hex(unpack_arrays(members)),
            values=values,
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise TrilightError(
            f"{shard.name}: sample {key} is not as expected ({error!r}); run `trilight verify`."
        ) from error
