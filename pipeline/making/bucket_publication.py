"""The manifest of a dataset that is made in a bucket, by makers on any number of machines."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.builds.settings import BuildSettings
from pipeline.making.begin_publication import begin, require_free
from pipeline.making.publication import Publication
from pipeline.shards.mirror import Mirror
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder, parts_of, shard_names_in, shard_names_in_part
from storage.dataset.manifest import Manifest, read_head, read_manifest
from storage.dataset.settings import SplitSettings
from storage.dataset.shard_notes import ShardNote, note_shard, noted_names
from storage.dataset.splits import scenes_of_shard, shard_name
from storage.errors import TrilightError
from storage.records.objects import LockedObject, encode_objects_lock
from storage.remote.bucket import Bucket
from storage.remote.url import RemoteUrl, parse_url

_PATIENCE_S = 10.0
"""With whoever lists the shards, and as long again for each so many notes that are to be read."""
_NOTES_MEANWHILE = 5_000
_LONGEST_PAUSE_S = 8.0


class BucketPublication(Publication):
    """What is public of a dataset in a bucket: as in a folder, and then brought there.

    A shard is finished when it and its note are in the bucket. Its files here say what is known of
    the bucket: those of the parts that this maker has asked for.
    """

    def __init__(
        self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings, mirror: Mirror
    ) -> None:
        super().__init__(folder, manifest, splits)
        self._mirror = mirror
        self._ends: dict[str, range] = {}
        """Shards in which a plan has ended, with the scenes that they are to hold now."""

    def dataset(self) -> Dataset:
        return self._mirror.dataset(read_manifest(self.folder.manifest))

    def send_documents(self) -> None:
        self._mirror.send_manifest()  # it vouches for them
        self._mirror.send_documents()

    def lock_objects(self, objects: list[LockedObject]) -> None:
        self.add_failures(())  # where nothing was rejected, there is a file that says so
        self._mirror.freeze(encode_objects_lock(objects))
        super().lock_objects(objects)
        self._mirror.send_manifest()

    def take_lock(self) -> None:
        if not self.manifest.objects_lock_sha256 and (theirs := self._mirror.take_lock()):
            with self._turn():
                self._write(objects_lock_sha256=theirs)

    @contextlib.contextmanager
    def claim(self, path: Path) -> Iterator[bool]:
        with contextlib.ExitStack() as stack:
            here = stack.enter_context(super().claim(path))
            yield here and stack.enter_context(self._mirror.claim(path))

    def send(self, path: Path) -> None:
        self._mirror.send_file(path)

    def has(self, path: Path) -> bool:
        return path.exists() or self._mirror.has(path)

    def _note(self, note: ShardNote) -> None:
        if self.folder.shard(note.shard.name).exists():  # else another machine has sent it
            note_shard(self.folder, note)
        if sent := self._mirror.send(note.shard.name):
            self._count(sent)

    def missing_shards(self, wanted: range | None = None) -> list[int]:
        for name in shard_names_in(self.folder.root):  # a kill, or another maker here, has left it
            self._mirror.send(name)
        self.learn_plan()
        return super().missing_shards(wanted)

    def _shards_there(self, shards: range) -> set[str]:
        for part in parts_of(shards):
            self._mirror.look_at(part, self._ends)
        sent = self.folder.staged_sent
        return {name for part in parts_of(shards) for name in shard_names_in_part(sent, part)}

    def num_shards_there(self) -> int:
        return sum(1 for _ in shard_names_in(self.folder.staged_sent))

    def finish(self) -> Manifest | None:
        listed, news = None, True
        while news:  # somebody may have planned more, and listed that, before our list arrived
            self.learn_plan()
            if not self._are_all_there():
                return None
            self._let_others_list()
            if self.left_to_others:
                self._mirror.take_finished()
            else:
                with self._turn():
                    self._mirror.take_listed(self.manifest)
            listed = super().finish()
            if listed and not self.left_to_others:
                self._mirror.send_manifest()
                self._mirror.say_listed(self.manifest.num_scenes)
            news = self.learn_plan()
        return listed

    def _let_others_list(self) -> None:
        """Wait while another machine lists the shards: a list costs a request for each of them.

        Machines with tasks of one size end together, and all of them find all shards there. One
        that dies over its list is waited for in vain, and then another one makes it.
        """
        planned, waited_s, pause_s = self.manifest.num_scenes, 0.0, 0.5
        self.left_to_others = False
        if self._mirror.is_first_to_list(planned):
            return
        patience_s = _PATIENCE_S * (1 + self.num_shards / _NOTES_MEANWHILE)
        listed = self._mirror.is_listed(planned)
        while waited_s < patience_s and not listed:
            time.sleep(pause_s)
            waited_s, pause_s = waited_s + pause_s, min(2 * pause_s, _LONGEST_PAUSE_S)
            self.left_to_others = listed = self._mirror.is_listed(planned)

    def _unlisted(self, listed: Manifest) -> list[ShardNote]:
        known = {entry.name for entry in listed.shards} - set(noted_names(self.folder))
        every = (shard_name(index, self._splits) for index in range(self.num_shards))
        return self._mirror.notes([name for name in every if name not in known])

    def _has(self, name: str) -> bool:
        if not self.folder.has_shard(name):
            number = int(name.removesuffix(".tar").rpartition("-")[2])
            self._shards_there(range(number, number + 1))
        return self.folder.has_shard(name)

    def learn_plan(self) -> bool:
        """Take notice of how many scenes others have planned; say whether there are more."""
        plans = self._mirror.plans()
        planned = max(plans, default=0)
        if news := planned > self.manifest.num_scenes:
            with self._turn():
                self.extend(max(planned, self.manifest.num_scenes))
        splits, each = self.splits, self._splits.scenes_per_shard
        last = () if splits.listed_shards else {plan // each for plan in plans if plan % each}
        self._ends = {shard_name(at, splits): scenes_of_shard(at, splits) for at in last}
        return news


def begin_dataset(
    folder: DatasetFolder,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool,
) -> Publication:
    """Begin a dataset in a folder or a bucket, or go on with the one that is there.

    Call while taking part in the folder (`joined`).

    Raises:
        TrilightError: as `begin`; the bucket cannot be listed, read or written, or its server
            would let two makers create the same file.
    """

    def begun() -> Publication:
        return begin(
            folder, settings, environment, num_scenes, accept_environment=accept_environment
        )

    if not folder.bucket:
        return begun()
    mirror = Mirror(folder)
    is_new = not mirror.is_begun()
    if is_new:
        require_free(folder, mirror.names())
        url = parse_url(folder.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        Bucket(url).require_create()
    publication = begun()
    if is_new and not mirror.begin():  # another machine was first
        mirror.adopt()
        publication = begun()
    mirror.plan(publication.manifest.num_scenes)
    in_bucket = BucketPublication(folder, publication.manifest, settings.splits, mirror)
    in_bucket.learn_plan()
    return in_bucket


def joined(folder: DatasetFolder) -> contextlib.AbstractContextManager[None]:
    """Take part in the making of a dataset; of one in a bucket, its folder here says the same then.

    A dataset that was begun and of which nothing was made is begun anew.

    Raises:
        TrilightError: the folder cannot be written, or the bucket not be read.
    """
    return folder.joined(Mirror(folder).adopt if folder.bucket else partial(forget_empty, folder))


def forget_empty(folder: DatasetFolder) -> None:
    """Delete a manifest of which nothing was made: no object is frozen, no scene or shard there.

    A run that ended that early, over its objects, must not bind the next one to its settings. Call
    while alone in the folder; whoever was at it all the same finds out (`Publication.refresh`).
    """
    with contextlib.suppress(TrilightError):  # an unreadable one is told of by whoever needs it
        frozen = read_head(folder.manifest).objects_lock_sha256
        if not (frozen or folder.shard_files()) and not any(folder.staged_samples.rglob("*.tar")):
            folder.manifest.unlink()
