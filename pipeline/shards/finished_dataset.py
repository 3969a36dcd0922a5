"""Reads finished datasets as sources of others: checks digests, then reads scene by scene."""

import contextlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, index_shard, read_manifest
from storage.dataset.planned import is_whole, num_planned
from storage.dataset.shard import ShardContents, contents_of
from storage.digests import sha256_hex, sha256_of_file
from storage.errors import TrilightError
from storage.records.objects import LockedObject, locked_uids, read_objects_lock
from storage.records.profiles import PACKED, PLAIN, unpack_arrays
from storage.records.quantities import QUANTITIES
from storage.records.safe_read import open_plain
from storage.records.sample import SceneRecord, decode_scene
from storage.records.scene_facts import scene_values
from storage.remote.safe_url import safe_url


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedDataset:
    """A dataset whose shards are all finished."""

    folder: DatasetFolder
    manifest: Manifest
    objects: Mapping[str, list[LockedObject]]
    """Locked objects by uid; a merged dataset may have several under one uid."""


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """Facts that decide whether a scene is selected, and into which shard it goes."""

    shard: ShardEntry  # the shard that holds it
    key: str  # its key in that shard
    template: str  # layout of the scene
    noise_floor_db: float  # stated error of its worst view, as psnr_log_db
    uids: tuple[str, ...]  # its objects, and the user's textures and map in it
    arrays_sha256: str  # digest of its unpacked arrays: equal for equal scenes
    values: Mapping[str, Any]  # requested values by name (pipeline.shards.expression)


def open_finished(path: str) -> FinishedDataset:
    """Open a finished dataset on this machine.

    Raises:
        TrilightError: the path is a URL, the manifest is unreadable, shards are missing, or the
            lock is not the manifest's.
    """
    if "://" in path:
        raise TrilightError(f"{safe_url(path)}: expected the folder of a dataset on this machine.")
    folder = DatasetFolder(Path(path))
    manifest = read_manifest(folder.manifest)
    if not is_whole(manifest, len(manifest.shards)):
        done = {entry.name for entry in manifest.shards}.difference(manifest.growing)
        raise TrilightError(
            f"{path}: {len(done)} of {num_planned(manifest)} shards are there; expected a "
            "finished dataset. Run the same `trilight generate` again to finish it."
        )
    lock = folder.objects_lock
    if not lock.exists() or sha256_of_file(lock) != manifest.objects_lock_sha256:
        raise TrilightError(
            f"{path}: {lock.name} is missing or not the one of the manifest (sha256 differs); run "
            "`trilight verify`."
        )
    objects: dict[str, list[LockedObject]] = {}
    for entry in read_objects_lock(lock):
        objects.setdefault(entry.uid, []).append(entry)
    return FinishedDataset(folder=folder, manifest=manifest, objects=objects)


def read_facts(
    dataset: FinishedDataset, *, names: Collection[str], shard_done: Callable[[], None]
) -> Iterator[SceneFacts]:
    """Yield the facts of every scene, with the values of some names.

    The digest of each shard is checked first. Memory holds one scene at a time. Pictures are hashed
    with the shard and not decoded.

    Raises:
        TrilightError: a shard is missing or its bytes are not those of the manifest, or the record
            of a scene is incomplete.
    """
    for shard in dataset.manifest.shards:
        require_whole(dataset, shard)
        with contextlib.closing(SampleReader(dataset)) as reader:
            for key in reader.keys(shard):
                yield _facts(shard, key, reader.members(shard, key, ("json", PLAIN, PACKED)), names)
        shard_done()


def require_whole(dataset: FinishedDataset, shard: ShardEntry) -> None:
    """Raise TrilightError if a shard is missing or its digest is not the manifest's."""
    path = dataset.folder.shard(shard.name)
    if not path.exists() or index_shard(path) != shard:
        raise TrilightError(
            f"{path}: missing, or its bytes are not those of the manifest (sha256 differs); "
            "run `trilight verify`, then make the shard again."
        )


class SampleReader:
    """Reads members of samples by key; keeps the last shard open until `close`."""

    def __init__(self, dataset: FinishedDataset) -> None:
        self._folder = dataset.folder
        self._shard: ShardEntry | None = None
        self._contents = ShardContents(samples={}, maps={})
        self._stream: BinaryIO | None = None

    def keys(self, shard: ShardEntry) -> list[str]:
        """Return the keys of a checked shard's samples, in the order of the file."""
        self._open(shard)
        return list(self._contents.samples)

    def members(
        self, shard: ShardEntry, key: str, suffixes: tuple[str, ...] | None = None
    ) -> dict[str, bytes]:
        """Return members of a sample of a checked shard by suffix; by default all of them.

        With the record come the maps that it names.
        """
        stream = self._open(shard)
        return self._contents.read(stream, key, lambda name: suffixes is None or name in suffixes)

    def _open(self, shard: ShardEntry) -> BinaryIO:
        if shard is not self._shard or self._stream is None:
            self.close()
            self._stream = open_plain(self._folder.shard(shard.name))
            self._shard = shard
            self._contents = contents_of(self._stream, shard.name)
        return self._stream

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()


def _facts(
    shard: ShardEntry, key: str, members: Mapping[str, bytes], names: Collection[str]
) -> SceneFacts:
    values = condition_values(decode_scene(key, members), shard.split, names) if names else {}
    try:
        record = json.loads(members["json"])
        return SceneFacts(
            shard=shard,
            key=key,
            template=str(record["provenance"].get("template", "unknown")),
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


def condition_values(record: SceneRecord, split: str, names: Collection[str]) -> Mapping[str, Any]:
    """Return the values of a scene for some names (pipeline.shards.expression)."""
    scene = record.scene
    of_scene = dict[str, Any]()
    if not QUANTITIES.keys().isdisjoint(names):
        for name, values in scene_values(record).items():
            plain = [float(value) for value in values]
            of_scene[name] = plain[0] if QUANTITIES[name].per == "scene" else plain
    of_scene |= {
        "key": record.key,
        "split": split,
        "template": str(scene.provenance.get("template", "")),
        "excursion": str((scene.provenance.get("excursion") or {}).get("axis", "")),
        "uid": [entry.uid for entry in scene.objects if entry.kind == "object" or entry.uid],
        "licence": [entry.licence for entry in scene.objects],
        "at_cap": [view.at_cap for view in record.views],
    }
    return {name: of_scene[name] for name in names}
