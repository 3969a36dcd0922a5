"""A dataset in a bucket that several machines make: each has a local folder of its own.

The bucket holds what a folder would hold. The manifest is begun once, the objects are frozen once,
and each shard is put there once: the server refuses a second writer, who takes what is there.
Below `.staging` stands for each shard a note with its manifest entry and the rejections of its
scenes. A shard is finished when it and its note are there, or the manifest lists it. The list in
the manifest follows from the notes, so whoever finds all shards there may write it.

A folder here has the manifest without that list; what it notes as sent is what its makers have
looked at: the parts of the dataset that they were asked for.

Machines claim batches of objects through the bucket (storage.remote.claims). Claims on scenes do
not reach from one machine to another: two machines with the same shards make scenes twice, and the
first writer of a shard wins. That is wasted work, never wrong.
"""

import contextlib
import dataclasses
import io
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.shards.pack import unpack_shard
from storage.atomic import write_atomically
from storage.claims import claimed
from storage.dataset.dataset import Dataset, RemoteDatasetFiles, read_beside
from storage.dataset.layout import DatasetFolder, place_of_part
from storage.dataset.manifest import (
    SHARD_NAME,
    Manifest,
    ShardEntry,
    decode_head,
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
    fetched_notes,
    note_of,
    note_shard,
    noted_shard,
)
from storage.digests import sha256_hex, sha256_of_file
from storage.errors import TrilightError
from storage.records.objects import decode_failures, read_failures, write_failures
from storage.remote.bucket import Bucket
from storage.remote.cache import shard_cache
from storage.remote.claims import BucketClaims
from storage.remote.url import RemoteUrl, parse_url

_PLANNED = ".staging/planned/"
"""Folder with one file for each requested number of scenes; the largest counts."""
_LISTING, _LISTED = ".staging/listing/", ".staging/listed/"
"""Folders with a file for each number of scenes whose shards somebody lists, or has listed."""
_HEAD_BYTES = 1 << 18
"""What is read of a manifest to know its head, which takes about 6 kB."""


class Mirror:
    """Exchange between a machine's folder and the bucket."""

    def __init__(self, folder: DatasetFolder) -> None:
        url = parse_url(folder.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        self._folder = folder
        self._bucket = Bucket(url)
        self._files = RemoteDatasetFiles(url)
        self._claims = BucketClaims(self._bucket, folder.staging / "worker")
        self._names_listed: set[str] | None = None
        self._unpacked = set[str]()

    def names(self) -> set[str]:
        """Return the names of all files of the dataset."""
        return self._bucket.names()

    def is_begun(self) -> bool:
        """Return whether there is a manifest."""
        return self._head() is not None

    def dataset(self, manifest: Manifest) -> Dataset:
        """Return the dataset of a manifest, to be read from the bucket."""
        return Dataset(self._files, manifest)

    def adopt(self) -> None:
        """Bring the folder's published files in line with the bucket.

        Scenes that wait for their shard stay where they are of the same dataset; where the folder
        is of another one, or the bucket is empty, they go. Call while no other process holds it.

        Raises:
            TrilightError: the bucket cannot be read.
        """
        folder, theirs, own = self._folder, self._head(), self._own_head()
        if not (theirs and own and own.identity == theirs.identity):
            own = None
            folder.clear()
        shutil.rmtree(folder.staged_sent, ignore_errors=True)  # `look_at` looks again
        if theirs is None:
            return
        self.plan(theirs.num_scenes)
        if own:  # as the shards here were packed
            theirs = dataclasses.replace(theirs, num_scenes=own.num_scenes, growing=own.growing)
        self._take_lock(theirs.objects_lock_sha256)
        if not theirs.objects_lock_sha256:
            self._take_failures()
        write_manifest(folder.manifest, theirs)

    def take_finished(self) -> None:
        """Bring the finished manifest of the bucket here, and the lock that it names."""
        theirs = self._manifest()
        with self._folder.turn("manifest"):
            self._take_failures()
            self._take_lock(theirs.objects_lock_sha256)
            write_manifest(self._folder.manifest, theirs)

    def _take_lock(self, sha256: str) -> None:
        """Bring the frozen objects here, and their index, unless they are here."""
        lock, index = self._folder.objects_lock, self._folder.staged_index
        if not sha256 or (lock.exists() and sha256_of_file(lock) == sha256):
            return
        for path in (lock, index):
            if (data := self._files.read(self._name(path))) is not None:
                write_atomically(path, data)

    def begin(self) -> bool:
        """Create the bucket's manifest from the folder's; return whether ours came first."""
        return self._bucket.create("manifest.json", self._folder.manifest)

    def plan(self, num_scenes: int) -> None:
        """Tell all workers how many scenes the dataset is to have."""
        self._bucket.write(f"{_PLANNED}{num_scenes:012d}", b"\n")

    def freeze(self, lock: bytes) -> None:
        """Put the frozen objects into the bucket, after what was rejected for them.

        What others have rejected in the meantime stays.

        Raises:
            TrilightError: another worker has frozen other objects in the meantime.
        """
        name = self._folder.objects_lock.name
        theirs = self._files.read(name)
        if theirs in (None, lock):
            with self._folder.turn("manifest"):
                self._take_failures()
                self._bucket.write("failures.jsonl", self._folder.failures)
        if theirs is None and not self._bucket.create(name, lock):
            theirs = self._files.read(name)
        if theirs not in (None, lock):
            raise TrilightError(
                f"{self._folder.shown}: another worker has frozen other objects in the meantime; "
                "expected the same --objects everywhere. Give that, or choose another --out."
            )

    def take_lock(self) -> str:
        """Bring the frozen objects here where somebody has frozen them; return their digest."""
        head = self._head()
        sha256 = head.objects_lock_sha256 if head else ""
        self._take_lock(sha256)
        return sha256

    def has(self, path: Path) -> bool:
        """Return whether a file of the folder is in the bucket."""
        return self._bucket.read_start(self._name(path), 1) is not None

    @contextlib.contextmanager
    def claim(self, path: Path) -> Iterator[bool]:
        """Bring a file here that is in the bucket; hold the claim on one that is not.

        Its holder sends the file before the claim ends. Only one process of a machine may ask for
        the same file at a time.
        """
        self._take(path)
        if path.exists():
            yield True
            return
        with self._claims.claimed(self._name(path)) as ours:
            if ours:
                self._take(path)  # its last holder may have sent it
            yield ours

    def _take(self, path: Path) -> None:
        if not path.exists() and (data := self._files.read(self._name(path))) is not None:
            write_atomically(path, data)

    def plans(self) -> set[int]:
        """Return how many scenes somebody has planned, each number that was asked for."""
        names = (name.removeprefix(_PLANNED) for name in self._bucket.names_in(_PLANNED))
        return {int(text) for text in names if text.isdecimal()}

    def look_at(self, part: int, ends: Mapping[str, range]) -> None:
        """Note which shards of a part of the dataset are finished in the bucket.

        Scenes of one that holds fewer than are planned, which `ends` names, are staged here.
        """
        place = place_of_part(part)
        notes = self._bucket.names_in(f"{self._name(self._folder.staged_entries)}/{place}")
        for name in filter(SHARD_NAME.fullmatch, self._bucket.names_in(place)):
            noted = self._name(note_of(self._folder, name)) in notes
            if self._folder.is_sent(name) or not (noted or name in self._listed()):
                continue
            if scenes := ends.get(name):
                note = self._noted(name) or self._note_of_list(name)
                if (note.scenes or MOST_SCENES) < len(scenes):
                    self._unpack(note, scenes[: note.scenes])
                    continue
                note_shard(self._folder, note)  # another machine may have let it grow
                if name in read_head(self._folder.manifest).growing:
                    self._folder.shard(name).unlink(missing_ok=True)
            self._mark(name)

    def _unpack(self, note: ShardNote, scenes: range) -> None:
        """Stage the scenes of a shard of the bucket here, if its bytes are the noted ones."""
        with contextlib.suppress(TrilightError):  # else its scenes are made again
            if note.shard.name not in self._unpacked:
                with self._files.open(note.shard, checked=True) as tar:
                    unpack_shard(self._folder, note, scenes, tar)
        self._unpacked.add(note.shard.name)

    def _listed(self) -> set[str]:
        """Return the shards that the manifest lists: those of a set that grows, or was copied."""
        if self._names_listed is None:
            self._names_listed = {shard.name for shard in self._manifest().shards}
        return self._names_listed

    def take_listed(self, head: Manifest) -> None:
        """Bring what the bucket lists already into the folder's manifest, whose head that is."""
        self._take_failures()
        listed = dataclasses.replace(head, shards=self._manifest().shards)
        write_manifest(self._folder.manifest, listed)

    def is_first_to_list(self, num_scenes: int) -> bool:
        """Return whether nobody else has begun to list the shards of so many scenes."""
        return self._bucket.create(f"{_LISTING}{num_scenes:012d}", b"\n")

    def say_listed(self, num_scenes: int) -> None:
        """Say that the manifest lists the shards of so many scenes."""
        self._bucket.write(f"{_LISTED}{num_scenes:012d}", b"\n")

    def is_listed(self, num_scenes: int) -> bool:
        """Return whether the manifest lists the shards of so many scenes, as somebody said."""
        return self._bucket.read_start(f"{_LISTED}{num_scenes:012d}", 1) is not None

    def notes(self, names: Sequence[str]) -> list[ShardNote]:
        """Return the notes on finished shards: from here, or else from the bucket."""
        folder = self._folder
        here = {name for name in names if note_of(folder, name).exists()}
        there = (self._name(note_of(folder, name)) for name in names if name not in here)
        own = [noted_shard(folder, name) for name in names if name in here]
        return own + fetched_notes(self._files.read, there, folder.shown)

    def send(self, name: str) -> ShardNote | None:
        """Bring a shard of the folder into the bucket; the cache keeps its bytes.

        Returns:
            The note on the shard that is in the bucket then, ours or that of the first writer;
            None where another maker sends it or has sent it, or it grows.
        """
        folder, path = self._folder, self._folder.shard(name)
        with claimed(folder.staging / "sending" / f"{name}.claim") as ours:
            own = read_head(folder.manifest)
            if not ours or not path.exists() or name in own.growing:
                return None
            made = noted_shard(folder, name)
            made = dataclasses.replace(made, scenes=planned_scenes_of(own, made.shard))
            note = made if folder.is_sent(name) else self._put(made)
            if note is None:
                return None
            self._mark(name)
            if note.shard == made.shard:
                shard_cache().keep(path, self._files.url.child(name), made.shard.sha256)
            path.unlink(missing_ok=True)
        return note

    def _put(self, made: ShardNote) -> ShardNote | None:
        """Put a shard and what stands beside it into the bucket; return the note that is there.

        A worker that was not first takes over the first writer's note. Where that is missing, the
        first writer was killed, and ours says what was rejected instead. A shard of more scenes
        takes the place of one that could grow; None where another machine is at that.
        """
        name, here = made.shard.name, self._folder
        log, note = here.root / log_name(name), self._name(note_of(here, name))
        first = self._bucket.create(name, here.shard(name))
        theirs = None if first else self._noted(name)
        if not first and theirs is None:
            theirs = dataclasses.replace(made, shard=self._indexed(name))
            if theirs.shard.num_samples < made.shard.num_samples:
                theirs = dataclasses.replace(theirs, scenes=0)
            elif not self._bucket.create(note, encode_note(theirs)):
                theirs = self._noted(name)
        if theirs and (theirs.scenes is None or theirs.scenes >= (made.scenes or MOST_SCENES)):
            note_shard(here, theirs)
            return theirs
        with self._claims.claimed(note) if theirs else contextlib.nullcontext(True) as ours:
            if theirs and not (ours and self._noted(name) in (theirs, None)):
                return None
            if theirs:
                self._bucket.write(name, here.shard(name))
                self._list_again(made.shard)
            if log.exists():
                self._bucket.write(self._name(log), log)
            self._bucket.write(note, encode_note(made))
        return made

    def _list_again(self, shard: ShardEntry) -> None:
        """Have the bucket's manifest list a shard as it is now, where that was listed."""
        theirs = self._manifest()
        if theirs.with_grown(shard) != theirs:
            path = self._folder.staging / "relisted.json"
            write_manifest(path, theirs.with_grown(shard))
            self._bucket.write("manifest.json", path)

    def _noted(self, name: str) -> ShardNote | None:
        """Return the note on a shard that is in the bucket, if there is one."""
        data = self._files.read(note := self._name(note_of(self._folder, name)))
        if data is None:
            return None
        return fetched_notes(lambda _: data, [note], self._folder.shown)[0]

    def _note_of_list(self, name: str) -> ShardNote:
        """Return what the manifest says of a shard without a note, as in a set that was copied."""
        theirs = self._manifest()
        shard = {entry.name: entry for entry in theirs.shards}[name]
        return ShardNote(shard=shard, failures=(), scenes=planned_scenes_of(theirs, shard))

    def _indexed(self, name: str) -> ShardEntry:
        """Return the entry of a shard of the bucket by reading it."""
        url = self._files.url.child(name)
        with shard_cache().open(url, num_bytes=None, sha256=None) as stream:
            return index_stream(stream, Path(name).name)

    def send_file(self, path: Path) -> None:
        """Put a file of the folder into the bucket, in place of one that is there."""
        self._bucket.write(self._name(path), path)

    def send_manifest(self) -> None:
        """Put the folder's manifest and rejections into the bucket, in place of those there."""
        with self._folder.turn("manifest"):
            self._bucket.write("failures.jsonl", self._folder.failures)
            self._bucket.write("manifest.json", self._folder.manifest)

    def send_documents(self) -> None:
        """Put the documents for people and hubs into the bucket, the card last."""
        folder = self._folder
        documents = [
            *(folder.attribution, folder.licences, folder.contact_sheet, folder.report),
            *sorted(path for path in folder.report_pages.rglob("*") if path.is_file()),
            *(folder.croissant, folder.card),
        ]
        for path in documents:
            self._bucket.write(self._name(path), path)

    def _head(self) -> Manifest | None:
        """Return the bucket's manifest without its list, with the digest of the objects there."""
        place = f"{self._folder.shown}/manifest.json"
        start = self._bucket.read_start("manifest.json", _HEAD_BYTES)
        if start is None:
            return None
        try:
            head = decode_head(io.BytesIO(start), place)
        except TrilightError:  # a longer head; or it is none, which reading it all says
            head = self._manifest()
        if head.objects_lock_sha256:
            return head
        lock = self._files.read(self._folder.objects_lock.name)
        return dataclasses.replace(head, objects_lock_sha256=sha256_hex(lock) if lock else "")

    def _manifest(self) -> Manifest:
        return read_beside(self._files, decode_manifest)

    def _take_failures(self) -> None:
        """Merge the bucket's rejections into the folder's."""
        theirs = decode_failures(self._files.read("failures.jsonl") or b"")
        known = read_failures(self._folder.failures)
        write_failures(self._folder.failures, [*known, *theirs])

    def _own_head(self) -> Manifest | None:
        try:
            return read_head(self._folder.manifest)
        except TrilightError:
            return None

    def _mark(self, name: str) -> None:
        """Note that a shard is in the bucket; what is lost of that is looked at again."""
        path = self._folder.staged_sent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        self._unpacked.discard(name)

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder.root).as_posix()
