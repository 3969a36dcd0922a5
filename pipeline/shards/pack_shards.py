"""Stage "shards": packs staged scenes into the tar file of a shard, publishes it, reads others'.

A shard is packed in the dataset's folder on this machine. Of a folder that publishes it; to a
bucket it is sent. The server refuses a second writer, which then reads the existing file. Below
`.staging` is a note for each shard with its manifest entry and rejections. A shard is finished in a
bucket when it and its note have come, or the manifest lists it. The notes decide that list, so any
machine may write it.

Before a bucket, the folder has the manifest without the list; its marks of sent shards cover the
parts of the dataset that its workers have requested. Two machines with the same shards make their
scenes twice, and the first writer wins, without a wrong result.

A finished scene waits in the staging folder until all scenes of its shard are there. A claim
(storage.file_locks) marks a scene that a worker is making, or a shard that it is packing; it ends
with the process that holds it, so that nothing has to be cleaned up after a kill.
"""

import contextlib
import dataclasses
import io
import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import BinaryIO

from storage.atomic import write_atomically
from storage.dataset.dataset import published_manifest
from storage.dataset.layout import (
    DatasetFolder,
    numbered_path,
    place_of_part,
    shard_names_in,
    shard_names_in_part,
)
from storage.dataset.manifest import (
    SHARD_NAME,
    Manifest,
    ShardEntry,
    decode_head,
    index_shard,
    index_stream,
    planned_scenes_of,
    read_head,
    read_manifest,
    write_manifest,
)
from storage.dataset.progress import count_given_up, log_name, log_scene
from storage.dataset.settings import MOST_SCENES, SplitSettings
from storage.dataset.shard import ShardReader, write_shard
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, split_of_shard
from storage.dataset.staging import (
    ShardNote,
    encode_note,
    fetch_notes,
    is_staged,
    name_of_note,
    note_of,
    note_shard,
    noted_shard,
    read_staged_scene,
    rejections_of_shard,
    stage_members,
)
from storage.digests import sha256_hex, sha256_of_file
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError
from storage.file_locks import hold_lock, is_locked
from storage.records.objects import Failure, decode_failures, read_failures, write_failures
from storage.records.packed_maps import MAP_NAME
from storage.records.profiles import Profile
from storage.records.sample import Sample, encode_sample, sample_key
from storage.remote.shard_cache import shard_cache
from storage.remote.store import RemoteStore

PLANNED = ".staging/planned/"
"""Folder of a bucket with one file for each requested number of scenes; the largest counts."""
_HEAD_BYTES = 1 << 18
"""Bytes of a manifest that are read to get its head, which takes about 6 kB."""


def pack_shard(
    folder: DatasetFolder, name: str, scene_indices: range, *, grows: bool = False
) -> ShardEntry:
    """Write a shard from its staged scenes and return its manifest entry.

    The rejections are written before the shard, so that every reader of the shard finds them, and
    the staged scenes are deleted after it: a kill in between loses nothing and repeats little.

    An existing shard stays: the first writer wins. A growing one is replaced. Where a file system
    carries no locks, who comes second returns what the first has packed.

    Args:
        scene_indices: indices of its scenes, all of which are staged.
        grows: True if the manifest lists the shard as growing; then call while holding its mutex.

    Raises:
        TrilightError: the disk is full, the folder cannot be written, or a staged file vanished.
    """
    try:
        return _pack(folder, name, scene_indices, grows=grows)
    except (
        FileNotFoundError,
        ShardMissing,
    ) as error:  # another process has packed it, and cleared away
        if folder.shard(name).exists() and name not in read_head(folder.manifest).growing:
            return index_shard(folder.shard(name))
        raise EnvironmentFailure(
            f"{name}: a file vanished while it was packed ({error}); expected one process at it, "
            "as locks ensure where a file system carries them. What was finished is safe: run "
            "the same command again."
        ) from error


def _pack(folder: DatasetFolder, name: str, scene_indices: range, *, grows: bool) -> ShardEntry:
    staged_folder = folder.staged_shard(name)
    failures: list[Failure] = []
    samples: list[tuple[str, dict[str, bytes]]] = []
    maps: dict[str, bytes] = {}
    for index in scene_indices:
        members, rejected = read_staged_scene(staged_folder, index)
        failures.extend(rejected)
        if members:
            for member in filter(MAP_NAME.fullmatch, members):  # equal maps share memory
                members[member] = maps.setdefault(member, members[member])
            samples.append((sample_key(index), members))
    path = folder.shard(name)
    rejections = rejections_of_shard(folder, name)
    write_failures(rejections, failures)
    written = folder.staging / path.name if grows else path
    if grows:
        written.unlink(missing_ok=True)
    write_shard(written, samples)
    shard = index_shard(written)
    if grows:
        note_shard(folder, ShardNote(shard=shard, failures=tuple(failures)))  # until it has the
        os.replace(written, path)  # name, the old one can be read
        write_failures(rejections, failures)
        write_manifest(folder.manifest, read_manifest(folder.manifest).with_grown(shard))
    shutil.rmtree(staged_folder, ignore_errors=True)  # leftovers are never read
    return shard


def unpack_here(folder: DatasetFolder, name: str, scenes: range, manifest: Manifest) -> None:
    """Stage the scenes of a shard of the folder as `unpack_shard`, unless it is damaged."""
    with contextlib.suppress(TrilightError), folder.shard(name).open("rb") as stream:
        note = noted_shard(folder, name)
        known = {each.name: each for each in manifest.shards}
        if not note_of(folder, name).exists():  # the manifest's entry, or the file's
            note = dataclasses.replace(note, shard=known.get(name, note.shard))
        if index_shard(folder.shard(name)) == note.shard:
            unpack_shard(folder, note, scenes, stream)


def unpack_shard(folder: DatasetFolder, note: ShardNote, scenes: range, stream: BinaryIO) -> None:
    """Stage the scenes of a shard again, byte for byte, so that it can be packed with more.

    Args:
        scenes: indices of its scenes; one that the file lacks was given up.
    """
    name = note.shard.name
    samples = dict(iter(ShardReader(stream, name)))
    for index in scenes:
        key = sample_key(index)
        failures = [failure for failure in note.failures if failure.item == key]
        if key not in samples:
            count_given_up(folder, index)
        stage_members(folder.staged_shard(name), index, samples.get(key, {}), failures)


class PublishedShards:
    """Publishes the shards of a folder, and tells which are published."""

    def __init__(self, folder: DatasetFolder) -> None:
        self.folder = folder
        self.store = folder.store()
        """Where the dataset is published."""
        self._unpacked = set[str]()

    def hold_lock(self) -> contextlib.AbstractContextManager[None]:
        """Hold the lock that a dataset's workers share; one that is alone updates the folder.

        Before a bucket it gets the bucket's state. Elsewhere, the manifest of a dataset without any
        object, scene or shard is deleted: it begins again.

        Raises:
            TrilightError: the folder cannot be written, or the bucket not be read.
        """
        return self.folder.hold_shared_lock(
            self._forget_unused if self.store.is_here else self.adopt
        )

    def _forget_unused(self) -> None:
        """Delete the manifest of a dataset without any frozen object, scene or shard.

        A run that ended that early, over its objects, must not bind the next one to its settings.
        Call while alone in the folder; a worker that missed this notices it
        (`DatasetWriter.refresh`).
        """
        folder = self.folder
        with contextlib.suppress(TrilightError):  # a later reader reports an unreadable manifest
            if read_head(folder.manifest).objects_lock_sha256:
                return
            folder.objects_lock.unlink(missing_ok=True)  # a kill came before the manifest named it
            is_empty = not any(shard_names_in(folder.root))
            if is_empty and not any(folder.staged_samples.rglob("*.tar")):
                folder.manifest.unlink()

    @cached_property
    def _names_listed(self) -> set[str]:
        """The shards that the bucket's manifest lists: of a grown or copied dataset."""
        return {shard.name for shard in published_manifest(self.store).shards}

    def names_in_part(self, part: int, ends: Mapping[str, range]) -> Iterator[str]:
        """Yield the names of the published shards of a part of the dataset, growing ones too.

        Args:
            ends: shards of a bucket with fewer scenes than planned; their scenes are staged here.
        """
        if self.store.is_here:
            return shard_names_in_part(self.folder.root, part)
        self._look_at(part, ends)
        return shard_names_in_part(self.folder.staged_sent, part)

    def _look_at(self, part: int, ends: Mapping[str, range]) -> None:
        """Mark the shards of a part of the dataset that are finished in the bucket."""
        place = place_of_part(part)
        notes = self.store.list(f"{self.folder.name_of(self.folder.staged_entries)}/{place}")
        for name in filter(SHARD_NAME.fullmatch, self.store.list(place)):
            noted = name_of_note(name) in notes
            if self.folder.is_sent(name) or not (noted or name in self._names_listed):
                continue
            if scenes := ends.get(name):
                note = self._read_note(name)
                if note is None:  # as in a copied dataset
                    theirs = published_manifest(self.store)
                    shard = {entry.name: entry for entry in theirs.shards}[name]
                    planned = planned_scenes_of(theirs, shard)
                    note = ShardNote(shard=shard, failures=(), scenes=planned)
                if (note.scenes or MOST_SCENES) < len(scenes):
                    self._unpack(note, scenes[: note.scenes])
                    continue
                note_shard(self.folder, note)  # another machine may have grown it
                if name in read_head(self.folder.manifest).growing:
                    self.folder.shard(name).unlink(missing_ok=True)
            self._mark_sent(name)

    def _unpack(self, note: ShardNote, scenes: range) -> None:
        """Stage the scenes of a shard of the bucket here, if its digest is the one of the note."""
        with contextlib.suppress(TrilightError):  # else its scenes are made again
            if note.shard.name not in self._unpacked:
                shard = note.shard
                with self.store.open_shard(
                    shard.name, num_bytes=shard.num_bytes, sha256=shard.sha256, checked=True
                ) as tar:
                    unpack_shard(self.folder, note, scenes, tar)
        self._unpacked.add(note.shard.name)

    def notes(self, names: Sequence[str]) -> list[ShardNote]:
        """Return the notes on finished shards: from the folder, or else from the bucket."""
        folder = self.folder
        local_names = {
            name for name in names if note_of(folder, name).exists() or folder.shard(name).exists()
        }
        remote_names = (name_of_note(name) for name in names if name not in local_names)
        noted = [noted_shard(folder, name) for name in names if name in local_names]
        return noted + fetch_notes(self.store.get, remote_names, folder.display_name)

    def publish_all(self) -> None:
        """Publish what a killed worker, or another one of this machine, has left to publish."""
        if not self.store.is_here:
            for name in shard_names_in(self.folder.root):
                self._send(name)

    def publish(self, note: ShardNote) -> ShardNote | None:
        """Publish a packed shard with its log and note; the cache keeps the bytes of a sent one.

        Returns:
            The published note; None if another worker publishes or published it, or it grows.
        """
        name = note.shard.name
        if self.folder.shard(name).exists():  # else another machine, or process, has sent it
            note_shard(self.folder, note)
        return note if self.store.is_here else self._send(name)

    def _send(self, name: str) -> ShardNote | None:
        folder = self.folder
        path = folder.shard(name)
        with hold_lock(folder.staging / "sending" / f"{name}.claim") as ours:
            head = read_head(folder.manifest)
            if not ours or not path.exists() or name in head.growing:
                return None
            made = noted_shard(folder, name)
            made = dataclasses.replace(made, scenes=planned_scenes_of(head, made.shard))
            note = made if folder.is_sent(name) else self._upload(made)
            if note is None:
                return None
            self._mark_sent(name)
            if note.shard == made.shard and isinstance(self.store, RemoteStore):
                shard_cache().keep(path, self.store.url.child(name), made.shard.sha256)
            path.unlink(missing_ok=True)
        return note

    def _upload(self, made: ShardNote) -> ShardNote | None:
        """Upload a shard with its log and note; return the note that is in the bucket then.

        A worker that was not first adopts the first writer's note; if that writer was killed before
        it wrote one, this worker's rejections are stored. A shard with more scenes replaces a
        smaller one; None if another machine is replacing it.
        """
        name = made.shard.name
        folder = self.folder
        log = folder.root / log_name(name)
        note = name_of_note(name)
        first = self.store.create_if_absent(name, folder.shard(name))
        theirs = None if first else self._read_note(name)
        if not first and theirs is None:
            assert isinstance(self.store, RemoteStore)
            url = self.store.url.child(name)
            with shard_cache().open(url, num_bytes=None, sha256=None) as stream:
                theirs = dataclasses.replace(made, shard=index_stream(stream, Path(name).name))
            if theirs.shard.num_samples < made.shard.num_samples:
                theirs = dataclasses.replace(theirs, scenes=0)
            elif not self.store.create_if_absent(note, encode_note(theirs)):
                theirs = self._read_note(name)
        if theirs and (theirs.scenes is None or theirs.scenes >= (made.scenes or MOST_SCENES)):
            note_shard(folder, theirs)
            return theirs
        with self.store.hold_lock(note) if theirs else contextlib.nullcontext(True) as ours:
            if theirs and not (ours and self._read_note(name) in (theirs, None)):
                return None
            if theirs:
                self.store.put(name, folder.shard(name))
                self._list_again(made.shard)
            if log.exists():
                self.store.put(self.folder.name_of(log), log)
            self.store.put(note, encode_note(made))
        return made

    def _list_again(self, shard: ShardEntry) -> None:
        """Update the entry of a shard in the bucket's manifest, if it is listed there."""
        theirs = published_manifest(self.store)
        if theirs.with_grown(shard) != theirs:
            path = self.folder.staging / "relisted.json"
            write_manifest(path, theirs.with_grown(shard))
            self.store.put("manifest.json", path)

    def read_published_head(self) -> Manifest | None:
        """Return the published manifest without shards, with the digest of the published lock."""
        place = f"{self.folder.display_name}/manifest.json"
        start = self.store.get("manifest.json", _HEAD_BYTES)
        if start is None:
            return None
        try:
            head = decode_head(io.BytesIO(start), place)
        except TrilightError:  # the head is longer, or malformed: read it all
            head = decode_head(io.BytesIO(self.store.get("manifest.json") or b""), place)
        if head.objects_lock_sha256:
            return head
        lock = self.store.get(self.folder.objects_lock.name)
        return dataclasses.replace(head, objects_lock_sha256=sha256_hex(lock) if lock else "")

    def fetch(self, path: Path) -> None:
        """Take over a published file that is not in the folder."""
        if not path.exists() and (data := self.store.get(self.folder.name_of(path))) is not None:
            write_atomically(path, data)

    def fetch_lock(self, sha256: str) -> None:
        """Take over the published lock, of a digest, and its index, unless it is here."""
        lock = self.folder.objects_lock
        if not sha256 or (lock.exists() and sha256_of_file(lock) == sha256):
            return
        for path in (lock, self.folder.staged_index):
            if (data := self.store.get(self.folder.name_of(path))) is not None:
                write_atomically(path, data)

    def merge_failures(self) -> None:
        """Add the published rejections to the folder's; call while holding the manifest's mutex."""
        theirs = decode_failures(self.store.get(self.folder.failures.name) or b"")
        write_failures(self.folder.failures, [*read_failures(self.folder.failures), *theirs])

    def adopt(self) -> None:
        """Give the folder before a bucket the bucket's state; call while no other process uses it.

        Staged scenes stay only if the bucket holds the same dataset.
        """
        theirs = self.read_published_head()
        own_head = None
        with contextlib.suppress(TrilightError):
            own_head = read_head(self.folder.manifest)
        if not (theirs and own_head and own_head.identity == theirs.identity):
            own_head = None
            self.folder.clear()
        shutil.rmtree(self.folder.staged_sent, ignore_errors=True)  # it is looked at again
        if theirs is None:
            return
        self.store.put(f"{PLANNED}{theirs.num_scenes:012d}", b"\n")
        if own_head:  # as the shards here were packed
            theirs = dataclasses.replace(
                theirs, num_scenes=own_head.num_scenes, growing=own_head.growing
            )
        self.fetch_lock(theirs.objects_lock_sha256)
        write_manifest(self.folder.manifest, theirs)

    def _read_note(self, name: str) -> ShardNote | None:
        data = self.store.get(note := name_of_note(name))
        if data is None:
            return None
        return fetch_notes(lambda _: data, [note], self.folder.display_name)[0]

    def _mark_sent(self, name: str) -> None:
        path = self.folder.staged_sent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        self._unpacked.discard(name)


log = logging.getLogger("trilight.scenes")


class UnfinishedShard:
    """One shard of a dataset, finished or not."""

    def __init__(self, folder: DatasetFolder, splits: SplitSettings, shard_index: int) -> None:
        self.name = shard_name(shard_index, splits)
        self.split = split_of_shard(shard_index, splits)
        self._folder = folder
        self._index = shard_index
        self._splits = splits
        self._staged = folder.staged_shard(self.name)
        self._packing = self._staged / "pack.claim"

    @contextlib.contextmanager
    def claim(self, scene_index: int) -> Iterator[bool]:
        """Claim a scene; yield True if it is missing and no other worker has claimed it.

        Raises:
            TrilightError: the folder cannot be written.
        """
        if self._is_done(scene_index):
            yield False
            return
        with hold_lock(self._claim(scene_index)) as ours:
            yield ours and not self._is_done(scene_index)  # finished meanwhile

    def stage(
        self,
        scene_index: int,
        sample: Sample | None,
        failures: list[Failure],
        profile: Profile,
        *,
        began: float,
        cores: int,
    ) -> None:
        """Stage a finished or given-up scene, and log its cost.

        Args:
            sample: the finished scene; None if it was given up.
            began: start of the work on it, by `time.monotonic`.
            cores: number of cores that the work kept busy.
        """
        members = encode_sample(sample, profile) if sample else {}
        stage_members(self._staged, scene_index, members, failures)
        seconds = time.monotonic() - began
        outcome = "made" if sample else "given up"
        log.info("%s: scene %09d %s in %.1f s", self.name, scene_index, outcome, seconds)
        folder = self._folder
        count = len(failures)
        if sample is None:
            count_given_up(folder, scene_index)
        log_scene(folder, self.name, scene_index, seconds=seconds, cores=cores, num_rejected=count)

    def pack(self) -> ShardEntry | None:
        """Pack the shard if all its scenes are staged, unless another worker does.

        Returns:
            The shard if this call packed it, else None.
        """
        scenes, grows = self._plan()
        if self._is_packed() or not all(is_staged(self._staged, index) for index in scenes):
            return None
        with contextlib.ExitStack() as stack:
            if not stack.enter_context(hold_lock(self._packing)):
                return None
            if grows or scenes != scenes_of_shard(self._index, self._splits):
                stack.enter_context(self._folder.mutex("manifest"))  # no plan changes meanwhile
            if self._is_packed() or self._plan() != (scenes, grows):
                return None
            shard = pack_shard(self._folder, self.name, scenes, grows=grows)
        log.info("%s: packed, %d scenes, %d bytes", self.name, shard.num_samples, shard.num_bytes)
        return shard

    def is_free(self) -> bool:
        """Return True if a missing scene, or the packing, is claimed by no worker.

        The check claims each missing scene for a moment. A worker that wants the scene just then
        skips it, so a caller that gets True must make it.
        """
        claims = self.missing_claims()
        if self._is_packed():  # checked last: packing empties the staging folder
            return False
        return not all(map(is_locked, claims))

    def missing_claims(self) -> list[Path]:
        """Return the claim files of the missing scenes; without any, the one of the packing."""
        missing = [index for index in self._plan()[0] if not is_staged(self._staged, index)]
        return [*map(self._claim, missing)] or [self._packing]

    def _claim(self, scene_index: int) -> Path:
        return self._staged / numbered_path(scene_index, f"{sample_key(scene_index)}.claim")

    def _is_done(self, scene_index: int) -> bool:
        return is_staged(self._staged, scene_index) or self._is_packed()

    def _is_packed(self) -> bool:
        is_sent = self._folder.is_sent(self.name)
        return is_sent or (self._folder.shard(self.name).exists() and not self._plan()[1])

    def _plan(self) -> tuple[range, bool]:
        """Return the planned scenes, and whether a shard with fewer scenes is to grow."""
        head = read_head(self._folder.manifest)
        scenes = scenes_of_shard(self._index, cut_splits(head.num_scenes, self._splits))
        return scenes, self.name in head.growing
