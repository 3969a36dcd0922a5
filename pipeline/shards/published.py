"""`PublishedShards`: the finished shards of a dataset in its store, a folder or a bucket.

A shard is packed in the dataset's folder on this machine. Of a folder that publishes it; to a
bucket it is sent. The server refuses a second writer, which then reads the existing file. Below
`.staging` is a note for each shard with its manifest entry and rejections. A shard is finished in a
bucket when it and its note have come, or the manifest lists it. The notes decide that list, so any
machine may write it.

Before a bucket, the folder has the manifest without the list; its marks of sent shards cover the
parts of the dataset that its workers have requested. Two machines with the same shards make their
scenes twice, and the first writer wins, without a wrong result.
"""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.shards.pack import unpack_shard
from storage.dataset.dataset import DatasetFiles, RemoteDatasetFiles, read_beside
from storage.dataset.layout import DatasetFolder, place_of_part, shard_names_in, shard_names_in_part
from storage.dataset.manifest import (
    SHARD_NAME,
    Manifest,
    ShardEntry,
    decode_manifest,
    index_stream,
    read_head,
    write_manifest,
)
from storage.dataset.planned import planned_scenes_of
from storage.dataset.scene_logs import log_name
from storage.dataset.settings import MOST_SCENES
from storage.dataset.shard_notes import (
    ShardNote,
    encode_note,
    fetch_notes,
    note_of,
    note_shard,
    noted_shard,
)
from storage.errors import TrilightError
from storage.file_locks import hold_lock
from storage.remote.shard_cache import shard_cache
from storage.remote.store import Store


class PublishedShards:
    """Publishes the shards of a folder, and tells which are published."""

    def __init__(self, folder: DatasetFolder, store: Store, files: DatasetFiles) -> None:
        self._folder = folder
        self._store = store
        self._files = files
        self._names_listed: set[str] | None = None
        self._unpacked = set[str]()

    def names_in_part(self, part: int, ends: Mapping[str, range]) -> Iterator[str]:
        """Yield the names of the published shards of a part of the dataset, growing ones too.

        Args:
            part: number of the part.
            ends: shards of a bucket with fewer scenes than planned; their scenes are staged here.
        """
        if self._store.is_here:
            return shard_names_in_part(self._folder.root, part)
        self._look_at(part, ends)
        return shard_names_in_part(self._folder.staged_sent, part)

    def _look_at(self, part: int, ends: Mapping[str, range]) -> None:
        """Mark the shards of a part of the dataset that are finished in the bucket."""
        place = place_of_part(part)
        notes = self._store.list(f"{self._folder.name_of(self._folder.staged_entries)}/{place}")
        for name in filter(SHARD_NAME.fullmatch, self._store.list(place)):
            noted = self._folder.name_of(note_of(self._folder, name)) in notes
            if self._folder.is_sent(name) or not (noted or name in self._manifest_names()):
                continue
            if scenes := ends.get(name):
                note = self._read_note(name) or self._note_of_list(name)
                if (note.scenes or MOST_SCENES) < len(scenes):
                    self._unpack(note, scenes[: note.scenes])
                    continue
                note_shard(self._folder, note)  # another machine may have grown it
                if name in read_head(self._folder.manifest).growing:
                    self._folder.shard(name).unlink(missing_ok=True)
            self._mark_sent(name)

    def _unpack(self, note: ShardNote, scenes: range) -> None:
        """Stage the scenes of a shard of the bucket here, if its digest is the one of the note."""
        with contextlib.suppress(TrilightError):  # else its scenes are made again
            if note.shard.name not in self._unpacked:
                with self._files.open(note.shard, checked=True) as tar:
                    unpack_shard(self._folder, note, scenes, tar)
        self._unpacked.add(note.shard.name)

    def _manifest_names(self) -> set[str]:
        """Return the shards that the bucket's manifest lists: of a grown or copied dataset."""
        if self._names_listed is None:
            self._names_listed = {shard.name for shard in self.manifest().shards}
        return self._names_listed

    def manifest(self) -> Manifest:
        """Return the published manifest, with the shards that it lists."""
        return read_beside(self._files, decode_manifest)

    def notes(self, names: Sequence[str]) -> list[ShardNote]:
        """Return the notes on finished shards: from the folder, or else from the bucket."""
        folder = self._folder
        local_names = {
            name for name in names if note_of(folder, name).exists() or folder.shard(name).exists()
        }
        remote_names = (
            self._folder.name_of(note_of(folder, name)) for name in names if name not in local_names
        )
        noted = [noted_shard(folder, name) for name in names if name in local_names]
        return noted + fetch_notes(self._store.get, remote_names, folder.display_name)

    def publish_all(self) -> None:
        """Publish what a killed worker, or another one of this machine, has left to publish."""
        if not self._store.is_here:
            for name in shard_names_in(self._folder.root):
                self._send(name)

    def publish(self, note: ShardNote) -> ShardNote | None:
        """Publish a packed shard with its log and note; the cache keeps the bytes of a sent one.

        Returns:
            The published note; None if another worker publishes or published it, or it grows.
        """
        name = note.shard.name
        if self._folder.shard(name).exists():  # else another machine, or process, has sent it
            note_shard(self._folder, note)
        return note if self._store.is_here else self._send(name)

    def _send(self, name: str) -> ShardNote | None:
        folder = self._folder
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
            if note.shard == made.shard and isinstance(self._files, RemoteDatasetFiles):
                shard_cache().keep(path, self._files.url.child(name), made.shard.sha256)
            path.unlink(missing_ok=True)
        return note

    def _upload(self, made: ShardNote) -> ShardNote | None:
        """Upload a shard with its log and note; return the note that is in the bucket then.

        A worker that was not first adopts the first writer's note; if that writer was killed before
        it wrote one, this worker's rejections are stored. A shard with more scenes replaces a
        smaller one; None if another machine is replacing it.
        """
        name = made.shard.name
        folder = self._folder
        log = folder.root / log_name(name)
        note = self._folder.name_of(note_of(folder, name))
        first = self._store.create_if_absent(name, folder.shard(name))
        theirs = None if first else self._read_note(name)
        if not first and theirs is None:
            theirs = dataclasses.replace(made, shard=self._index_remote(name))
            if theirs.shard.num_samples < made.shard.num_samples:
                theirs = dataclasses.replace(theirs, scenes=0)
            elif not self._store.create_if_absent(note, encode_note(theirs)):
                theirs = self._read_note(name)
        if theirs and (theirs.scenes is None or theirs.scenes >= (made.scenes or MOST_SCENES)):
            note_shard(folder, theirs)
            return theirs
        with self._store.hold_lock(note) if theirs else contextlib.nullcontext(True) as ours:
            if theirs and not (ours and self._read_note(name) in (theirs, None)):
                return None
            if theirs:
                self._store.put(name, folder.shard(name))
                self._list_again(made.shard)
            if log.exists():
                self._store.put(self._folder.name_of(log), log)
            self._store.put(note, encode_note(made))
        return made

    def _list_again(self, shard: ShardEntry) -> None:
        """Update the entry of a shard in the bucket's manifest, if it is listed there."""
        theirs = self.manifest()
        if theirs.with_grown(shard) != theirs:
            path = self._folder.staging / "relisted.json"
            write_manifest(path, theirs.with_grown(shard))
            self._store.put("manifest.json", path)

    def _read_note(self, name: str) -> ShardNote | None:
        data = self._store.get(note := self._folder.name_of(note_of(self._folder, name)))
        if data is None:
            return None
        return fetch_notes(lambda _: data, [note], self._folder.display_name)[0]

    def _note_of_list(self, name: str) -> ShardNote:
        """Return a note made of the manifest's entry of a shard, as in a copied dataset."""
        theirs = self.manifest()
        shard = {entry.name: entry for entry in theirs.shards}[name]
        return ShardNote(shard=shard, failures=(), scenes=planned_scenes_of(theirs, shard))

    def _index_remote(self, name: str) -> ShardEntry:
        assert isinstance(self._files, RemoteDatasetFiles)
        url = self._files.url.child(name)
        with shard_cache().open(url, num_bytes=None, sha256=None) as stream:
            return index_stream(stream, Path(name).name)

    def _mark_sent(self, name: str) -> None:
        path = self._folder.staged_sent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        self._unpacked.discard(name)
