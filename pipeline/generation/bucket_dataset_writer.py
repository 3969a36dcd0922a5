"""`BucketDatasetWriter`: publishes a dataset to a bucket, from any number of machines."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.builds.settings import BuildSettings
from pipeline.generation.begin_dataset import begin, require_free
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.shards.bucket_mirror import Mirror
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
"""Seconds to wait for the machine that lists the shards, and again for each _NOTES_MEANWHILE."""
_NOTES_MEANWHILE = 5_000
_LONGEST_PAUSE_S = 8.0


class BucketDatasetWriter(DatasetWriter):
    """Writes the published files of a dataset to a local folder, then uploads them to its bucket.

    A shard is finished when it and its note are in the bucket. Files of the local folder cache the
    state of the bucket, for the parts that this worker has requested.
    """

    def __init__(
        self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings, mirror: Mirror
    ) -> None:
        super().__init__(folder, manifest, splits)
        self._mirror = mirror
        self._ends: dict[str, range] = {}
        """Last shards of earlier plans, by name, with the scenes that they should hold now."""

    def dataset(self) -> Dataset:
        return self._mirror.dataset(read_manifest(self.folder.manifest))

    def upload_documents(self) -> None:
        self._mirror.upload_manifest()  # it holds their digests
        self._mirror.upload_documents()

    def lock_objects(self, objects: list[LockedObject]) -> None:
        self.add_failures(())  # writes an empty file if nothing was rejected
        self._mirror.freeze(encode_objects_lock(objects))
        super().lock_objects(objects)
        self._mirror.upload_manifest()

    def fetch_lock(self) -> None:
        if not self.manifest.objects_lock_sha256 and (theirs := self._mirror.fetch_lock()):
            with self._lock_manifest():
                self._write(objects_lock_sha256=theirs)

    @contextlib.contextmanager
    def claim(self, path: Path) -> Iterator[bool]:
        with contextlib.ExitStack() as stack:
            is_ours_here = stack.enter_context(super().claim(path))
            yield is_ours_here and stack.enter_context(self._mirror.claim(path))

    def upload(self, path: Path) -> None:
        self._mirror.upload_file(path)

    def has(self, path: Path) -> bool:
        return path.exists() or self._mirror.has(path)

    def _note(self, note: ShardNote) -> None:
        if self.folder.shard(note.shard.name).exists():  # else another machine has sent it
            note_shard(self.folder, note)
        if sent := self._mirror.upload_shard(note.shard.name):
            self._count(sent)

    def unfinished_shards(self, requested: range | None = None) -> list[int]:
        for name in shard_names_in(self.folder.root):  # left by a killed or another local worker
            self._mirror.upload_shard(name)
        self.refresh_plan()
        return super().unfinished_shards(requested)

    def _finished_shards(self, shards: range) -> set[str]:
        for part in parts_of(shards):
            self._mirror.scan_part(part, self._ends)
        sent = self.folder.staged_sent
        return {name for part in parts_of(shards) for name in shard_names_in_part(sent, part)}

    def num_finished_shards(self) -> int:
        return sum(1 for _ in shard_names_in(self.folder.staged_sent))

    def finish(self) -> Manifest | None:
        listed = None
        has_new_plan = True
        while has_new_plan:  # another run may plan and list more before our upload
            self.refresh_plan()
            if not self._is_complete():
                return None
            self._wait_for_lister()
            if self.left_to_others:
                self._mirror.fetch_finished()
            else:
                with self._lock_manifest():
                    self._mirror.fetch_listed(self.manifest)
            listed = super().finish()
            if listed and not self.left_to_others:
                self._mirror.upload_manifest()
                self._mirror.mark_listed(self.manifest.num_scenes)
            has_new_plan = self.refresh_plan()
        return listed

    def _wait_for_lister(self) -> None:
        """Wait while another machine lists the shards: listing costs a request for each shard.

        Machines with tasks of one size end together, and all of them find all shards finished. If
        the listing machine dies, the wait times out, and another machine lists them.
        """
        planned = self.manifest.num_scenes
        waited_s = 0.0
        pause_s = 0.5
        self.left_to_others = False
        if self._mirror.is_first_to_list(planned):
            return
        patience_s = _PATIENCE_S * (1 + self.num_shards / _NOTES_MEANWHILE)
        listed = self._mirror.is_listed(planned)
        while waited_s < patience_s and not listed:
            time.sleep(pause_s)
            waited_s = waited_s + pause_s
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
            self.left_to_others = listed = self._mirror.is_listed(planned)

    def _unlisted_notes(self, listed: Manifest) -> list[ShardNote]:
        known = {entry.name for entry in listed.shards} - set(noted_names(self.folder))
        every = (shard_name(index, self._splits) for index in range(self.num_shards))
        return self._mirror.notes([name for name in every if name not in known])

    def _sees_shard(self, name: str) -> bool:
        if not self.folder.has_shard(name):
            number = int(name.removesuffix(".tar").rpartition("-")[2])
            self._finished_shards(range(number, number + 1))
        return self.folder.has_shard(name)

    def refresh_plan(self) -> bool:
        """Read the plans of other machines; return True if more scenes are planned than before."""
        plans = self._mirror.plans()
        planned = max(plans, default=0)
        if has_new_plan := planned > self.manifest.num_scenes:
            with self._lock_manifest():
                self.extend(max(planned, self.manifest.num_scenes))
        splits = self.splits
        each = self._splits.scenes_per_shard
        last = () if splits.listed_shards else {plan // each for plan in plans if plan % each}
        self._ends = {shard_name(at, splits): scenes_of_shard(at, splits) for at in last}
        return has_new_plan


def begin_dataset(
    folder: DatasetFolder,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool,
) -> DatasetWriter:
    """Begin a dataset in a folder or a bucket, or resume the one that is there.

    Call while holding the folder's membership (`hold_membership`).

    Raises:
        TrilightError: as `begin`; the bucket cannot be listed, read or written, or its server
            would let two workers create the same file.
    """

    def begin_here() -> DatasetWriter:
        return begin(
            folder, settings, environment, num_scenes, accept_environment=accept_environment
        )

    if not folder.bucket:
        return begin_here()
    mirror = Mirror(folder)
    is_new = not mirror.is_begun()
    if is_new:
        require_free(folder, mirror.names())
        url = parse_url(folder.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        Bucket(url).require_create()
    writer = begin_here()
    if is_new and not mirror.begin():  # another machine was first
        mirror.adopt()
        writer = begin_here()
    mirror.plan(writer.manifest.num_scenes)
    in_bucket = BucketDatasetWriter(folder, writer.manifest, settings.splits, mirror)
    in_bucket.refresh_plan()
    return in_bucket


def hold_membership(folder: DatasetFolder) -> contextlib.AbstractContextManager[None]:
    """Hold the membership of a dataset's workers; a bucket is first mirrored to its local folder.

    The manifest of a dataset without any object, scene or shard is deleted: it begins again.

    Raises:
        TrilightError: the folder cannot be written, or the bucket not be read.
    """
    return folder.hold_membership(
        Mirror(folder).adopt if folder.bucket else partial(delete_empty_manifest, folder)
    )


def delete_empty_manifest(folder: DatasetFolder) -> None:
    """Delete the manifest of a dataset without any frozen object, scene or shard.

    A run that ended that early, over its objects, must not bind the next one to its settings. Call
    while alone in the folder; a worker that missed this notices it (`DatasetWriter.refresh`).
    """
    with contextlib.suppress(TrilightError):  # a later reader reports an unreadable manifest
        frozen = read_head(folder.manifest).objects_lock_sha256
        if not (frozen or folder.shard_files()) and not any(folder.staged_samples.rglob("*.tar")):
            folder.manifest.unlink()
