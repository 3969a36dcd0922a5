"""`Mirror`: synchronizes a machine's local folder with a dataset in a bucket.

The bucket has the same files as a folder. Manifest, lock and shards are each created once: the
server refuses a second writer, which then reads the existing file. Below `.staging` is a note for
each shard with its manifest entry and rejections. A shard is finished when it and its note are in
the bucket, or the manifest lists it. The notes decide that list, so any machine may write it.

The local folder has the manifest without the list; its marks of uploaded shards cover the parts of
the dataset that its workers have requested.

Machines claim batches of objects through the bucket (storage.remote.claims), but not scenes: two
machines with the same shards make scenes twice, and the first writer wins, without a wrong result.
"""

import contextlib
import dataclasses
import io
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.shards.pack import unpack_shard
from storage.atomic import write_atomically
from storage.claims import hold_claim
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
    fetch_notes,
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
_LISTING = ".staging/listing/"
_LISTED = ".staging/listed/"
"""Folder with one file for each number of scenes whose shards have been listed."""
_HEAD_BYTES = 1 << 18
"""Bytes of a manifest that are read to get its head, which takes about 6 kB."""


class Mirror:
    """Exchanges files between a machine's folder and the bucket."""

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
        """Return True if the bucket has a manifest."""
        return self._head() is not None

    def dataset(self, manifest: Manifest) -> Dataset:
        """Return a reader of the bucket's dataset by a manifest."""
        return Dataset(self._files, manifest)

    def adopt(self) -> None:
        """Synchronize the folder with the bucket; call while no other process uses it.

        Staged scenes stay only if the bucket holds the same dataset.

        Raises:
            TrilightError: the bucket cannot be read.
        """
        folder = self._folder
        theirs = self._head()
        own_head = self._own_head()
        if not (theirs and own_head and own_head.identity == theirs.identity):
            own_head = None
            folder.clear()
        shutil.rmtree(folder.staged_sent, ignore_errors=True)  # `look_at` looks again
        if theirs is None:
            return
        self.plan(theirs.num_scenes)
        if own_head:  # as the shards here were packed
            theirs = dataclasses.replace(
                theirs, num_scenes=own_head.num_scenes, growing=own_head.growing
            )
        self._fetch_lock(theirs.objects_lock_sha256)
        if not theirs.objects_lock_sha256:
            self._merge_failures()
        write_manifest(folder.manifest, theirs)

    def fetch_finished(self) -> None:
        """Download the finished manifest of the bucket, and the lock that it names."""
        theirs = self._manifest()
        with self._folder.mutex("manifest"):
            self._merge_failures()
            self._fetch_lock(theirs.objects_lock_sha256)
            write_manifest(self._folder.manifest, theirs)

    def _fetch_lock(self, sha256: str) -> None:
        lock = self._folder.objects_lock
        index = self._folder.staged_index
        if not sha256 or (lock.exists() and sha256_of_file(lock) == sha256):
            return
        for path in (lock, index):
            if (data := self._files.read(self._name(path))) is not None:
                write_atomically(path, data)

    def begin(self) -> bool:
        """Create the bucket's manifest from the folder's; return False if another came first."""
        return self._bucket.create("manifest.json", self._folder.manifest)

    def plan(self, num_scenes: int) -> None:
        """Publish a requested number of scenes to all workers."""
        self._bucket.write(f"{_PLANNED}{num_scenes:012d}", b"\n")

    def freeze(self, lock: bytes) -> None:
        """Upload the frozen objects, after the rejections that led to them.

        Rejections of other workers stay.

        Raises:
            TrilightError: another worker has frozen other objects in the meantime.
        """
        name = self._folder.objects_lock.name
        theirs = self._files.read(name)
        if theirs in (None, lock):
            with self._folder.mutex("manifest"):
                self._merge_failures()
                self._bucket.write("failures.jsonl", self._folder.failures)
        if theirs is None and not self._bucket.create(name, lock):
            theirs = self._files.read(name)
        if theirs not in (None, lock):
            raise TrilightError(
                f"{self._folder.display_name}: another worker has frozen other objects in the "
                "meantime; "
                "expected the same --objects everywhere. Give that, or choose another --out."
            )

    def fetch_lock(self) -> str:
        """Download the frozen objects if another worker has frozen them; return their digest."""
        head = self._head()
        sha256 = head.objects_lock_sha256 if head else ""
        self._fetch_lock(sha256)
        return sha256

    def has(self, path: Path) -> bool:
        """Return True if a file of the folder is in the bucket."""
        return self._bucket.read_start(self._name(path), 1) is not None

    @contextlib.contextmanager
    def claim(self, path: Path) -> Iterator[bool]:
        """Download a file of the bucket; hold the claim on it if it does not exist.

        The holder uploads the file. Only one process of a machine may claim a file at a time.
        """
        self._fetch(path)
        if path.exists():
            yield True
            return
        with self._claims.hold_claim(self._name(path)) as ours:
            if ours:
                self._fetch(path)  # its last holder may have uploaded it
            yield ours

    def _fetch(self, path: Path) -> None:
        if not path.exists() and (data := self._files.read(self._name(path))) is not None:
            write_atomically(path, data)

    def plans(self) -> set[int]:
        """Return all numbers of scenes that any run has planned."""
        names = (name.removeprefix(_PLANNED) for name in self._bucket.names_in(_PLANNED))
        return {int(text) for text in names if text.isdecimal()}

    def scan_part(self, part: int, ends: Mapping[str, range]) -> None:
        """Mark the shards of a part of the dataset that are finished in the bucket.

        `ends` names shards with fewer scenes than planned; their scenes are staged here.
        """
        place = place_of_part(part)
        notes = self._bucket.names_in(f"{self._name(self._folder.staged_entries)}/{place}")
        for name in filter(SHARD_NAME.fullmatch, self._bucket.names_in(place)):
            noted = self._name(note_of(self._folder, name)) in notes
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
            self._names_listed = {shard.name for shard in self._manifest().shards}
        return self._names_listed

    def fetch_listed(self, head: Manifest) -> None:
        """Write the folder's manifest from a head and the shards that the bucket's one lists."""
        self._merge_failures()
        listed = dataclasses.replace(head, shards=self._manifest().shards)
        write_manifest(self._folder.manifest, listed)

    def is_first_to_list(self, num_scenes: int) -> bool:
        """Return True if no other machine has begun to list the shards of so many scenes."""
        return self._bucket.create(f"{_LISTING}{num_scenes:012d}", b"\n")

    def mark_listed(self, num_scenes: int) -> None:
        """Record that the manifest lists the shards of so many scenes."""
        self._bucket.write(f"{_LISTED}{num_scenes:012d}", b"\n")

    def is_listed(self, num_scenes: int) -> bool:
        """Return True if a machine has recorded that the shards of so many scenes are listed."""
        return self._bucket.read_start(f"{_LISTED}{num_scenes:012d}", 1) is not None

    def notes(self, names: Sequence[str]) -> list[ShardNote]:
        """Return the notes on finished shards: from the folder, or else from the bucket."""
        folder = self._folder
        local_names = {name for name in names if note_of(folder, name).exists()}
        remote_names = (
            self._name(note_of(folder, name)) for name in names if name not in local_names
        )
        local_notes = [noted_shard(folder, name) for name in names if name in local_names]
        return local_notes + fetch_notes(self._files.read, remote_names, folder.display_name)

    def upload_shard(self, name: str) -> ShardNote | None:
        """Upload a shard of the folder; the cache keeps its bytes.

        Returns:
            The note in the bucket; None if another worker uploads or uploaded it, or it grows.
        """
        folder = self._folder
        path = self._folder.shard(name)
        with hold_claim(folder.staging / "sending" / f"{name}.claim") as ours:
            head = read_head(folder.manifest)
            if not ours or not path.exists() or name in head.growing:
                return None
            made = noted_shard(folder, name)
            made = dataclasses.replace(made, scenes=planned_scenes_of(head, made.shard))
            note = made if folder.is_sent(name) else self._upload(made)
            if note is None:
                return None
            self._mark_sent(name)
            if note.shard == made.shard:
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
        note = self._name(note_of(folder, name))
        first = self._bucket.create(name, folder.shard(name))
        theirs = None if first else self._read_note(name)
        if not first and theirs is None:
            theirs = dataclasses.replace(made, shard=self._index_remote(name))
            if theirs.shard.num_samples < made.shard.num_samples:
                theirs = dataclasses.replace(theirs, scenes=0)
            elif not self._bucket.create(note, encode_note(theirs)):
                theirs = self._read_note(name)
        if theirs and (theirs.scenes is None or theirs.scenes >= (made.scenes or MOST_SCENES)):
            note_shard(folder, theirs)
            return theirs
        with self._claims.hold_claim(note) if theirs else contextlib.nullcontext(True) as ours:
            if theirs and not (ours and self._read_note(name) in (theirs, None)):
                return None
            if theirs:
                self._bucket.write(name, folder.shard(name))
                self._list_again(made.shard)
            if log.exists():
                self._bucket.write(self._name(log), log)
            self._bucket.write(note, encode_note(made))
        return made

    def _list_again(self, shard: ShardEntry) -> None:
        """Update the entry of a shard in the bucket's manifest, if it is listed there."""
        theirs = self._manifest()
        if theirs.with_grown(shard) != theirs:
            path = self._folder.staging / "relisted.json"
            write_manifest(path, theirs.with_grown(shard))
            self._bucket.write("manifest.json", path)

    def _read_note(self, name: str) -> ShardNote | None:
        data = self._files.read(note := self._name(note_of(self._folder, name)))
        if data is None:
            return None
        return fetch_notes(lambda _: data, [note], self._folder.display_name)[0]

    def _note_of_list(self, name: str) -> ShardNote:
        """Return a note made of the manifest's entry of a shard, as in a copied dataset."""
        theirs = self._manifest()
        shard = {entry.name: entry for entry in theirs.shards}[name]
        return ShardNote(shard=shard, failures=(), scenes=planned_scenes_of(theirs, shard))

    def _index_remote(self, name: str) -> ShardEntry:
        url = self._files.url.child(name)
        with shard_cache().open(url, num_bytes=None, sha256=None) as stream:
            return index_stream(stream, Path(name).name)

    def upload_file(self, path: Path) -> None:
        """Upload a file of the folder, replacing an existing one."""
        self._bucket.write(self._name(path), path)

    def upload_manifest(self) -> None:
        """Upload the folder's manifest and rejections, replacing the existing ones."""
        with self._folder.mutex("manifest"):
            self._bucket.write("failures.jsonl", self._folder.failures)
            self._bucket.write("manifest.json", self._folder.manifest)

    def upload_documents(self) -> None:
        """Upload the documents, the card last."""
        folder = self._folder
        documents = [
            *(folder.attribution, folder.licences, folder.contact_sheet, folder.report),
            *sorted(path for path in folder.report_pages.rglob("*") if path.is_file()),
            *(folder.croissant, folder.card),
        ]
        for path in documents:
            self._bucket.write(self._name(path), path)

    def _head(self) -> Manifest | None:
        """Return the bucket's manifest without its shards, with the digest of the bucket's lock."""
        place = f"{self._folder.display_name}/manifest.json"
        start = self._bucket.read_start("manifest.json", _HEAD_BYTES)
        if start is None:
            return None
        try:
            head = decode_head(io.BytesIO(start), place)
        except TrilightError:  # the head is longer, or malformed: read it all
            head = self._manifest()
        if head.objects_lock_sha256:
            return head
        lock = self._files.read(self._folder.objects_lock.name)
        return dataclasses.replace(head, objects_lock_sha256=sha256_hex(lock) if lock else "")

    def _manifest(self) -> Manifest:
        return read_beside(self._files, decode_manifest)

    def _merge_failures(self) -> None:
        theirs = decode_failures(self._files.read("failures.jsonl") or b"")
        known = read_failures(self._folder.failures)
        write_failures(self._folder.failures, [*known, *theirs])

    def _own_head(self) -> Manifest | None:
        try:
            return read_head(self._folder.manifest)
        except TrilightError:
            return None

    def _mark_sent(self, name: str) -> None:
        path = self._folder.staged_sent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        self._unpacked.discard(name)

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder.root).as_posix()
