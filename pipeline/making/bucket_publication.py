"""The manifest of a dataset that is made in a bucket, by makers on any number of machines."""

import contextlib
from collections.abc import Mapping
from functools import partial
from typing import Any

from pipeline.builds.settings import BuildSettings
from pipeline.making.publication import Publication, begin, require_free
from pipeline.shards.mirror import Mirror
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, read_manifest
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import shard_name
from storage.errors import TrilightError
from storage.records.objects import LockedObject, encode_objects_lock
from storage.remote.bucket import Bucket
from storage.remote.url import RemoteUrl, parse_url


class BucketPublication(Publication):
    """What is public of a dataset in a bucket: as in a folder, and then brought there.

    The folder's manifest is published first, among the makers on this machine; what other machines
    have finished is taken up before. Two may bring their manifests at the same time, so each looks
    again afterwards and brings a newer one where somebody else's shard is not in it.
    """

    def __init__(
        self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings, mirror: Mirror
    ) -> None:
        super().__init__(folder, manifest, splits)
        self._mirror = mirror

    def dataset(self) -> Dataset:
        return self._mirror.dataset(self.manifest)

    def send_documents(self) -> None:
        self._mirror.send_documents()

    def send_index(self) -> None:
        self._mirror.send_index()

    def lock_objects(self, objects: list[LockedObject]) -> None:
        self.add_failures(())  # where nothing was rejected, there is a file that says so
        self._mirror.freeze(encode_objects_lock(objects))
        super().lock_objects(objects)
        self.publish()  # somebody may have frozen the same before, and made shards

    def add_shard(self, shard: ShardEntry) -> None:
        self._require_here(shard.name)
        if sent := self._mirror.send(shard.name, shard):
            super().add_shard(sent)

    def publish(self) -> None:
        self.learn()
        super().publish()
        self._mirror.send_manifest()
        while self.learn():
            super().publish()
            self._mirror.send_manifest()

    def missing_shards(self) -> list[int]:
        names = [shard_name(index, self._splits) for index in range(self.num_shards)]
        for name in names:
            if self.folder.shard(name).exists():  # a kill, or another maker here, has left it
                self._mirror.send(name)
        self.learn()
        return super().missing_shards()

    def _is_there(self, name: str) -> bool:
        return self.folder.is_sent(name)

    def _has(self, name: str) -> bool:
        if not self.folder.has_shard(name):
            self.learn()
        return self.folder.has_shard(name)

    def learn(self) -> bool:
        """Take notice of what others have finished and planned; say whether there was news."""
        news, planned = self._mirror.receive({entry.name for entry in self.manifest.shards})
        grown = planned > self.manifest.num_scenes
        if grown:
            with self._turn():
                self._write(num_scenes=max(planned, self.manifest.num_scenes))
        return news > 0 or grown


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
    names = mirror.names()
    if "manifest.json" not in names:
        require_free(folder, names)
        url = parse_url(folder.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        Bucket(url).require_create()
    publication = begun()
    if "manifest.json" not in names and not mirror.begin():  # another machine was first
        mirror.adopt()
        publication = begun()
    mirror.plan(publication.manifest.num_scenes)
    publication = BucketPublication(folder, publication.manifest, settings.splits, mirror)
    publication.learn()
    return publication


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
        manifest = read_manifest(folder.manifest)
        made = manifest.objects_lock_sha256 or manifest.shards or folder.shard_files()
        if not made and not any(folder.staged_samples.rglob("*.tar")):
            folder.manifest.unlink()
