"""A finished dataset, for whoever reads it: the manifest and the samples of its shards."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import BinaryIO

from storage.conventions import SPLITS
from storage.dataset.damage import reading
from storage.dataset.files import DatasetFiles, RemoteDatasetFiles, dataset_files
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, decode_manifest
from storage.dataset.shard_reader import samples_of
from storage.errors import TrilightError
from storage.records.failures import decode_failures
from storage.records.objects import Failure, LockedObject
from storage.records.objects_lock import decode_objects_lock
from storage.records.sample import Sample, SceneRecord, decode_sample, decode_scene


class Dataset:
    """The shards of one dataset, checked by digest as they are read."""

    def __init__(self, files: DatasetFiles, manifest: Manifest) -> None:
        self.files = files
        self.manifest = manifest

    @property
    def shown(self) -> str:
        """Where the dataset is, for people: without secrets."""
        return self.files.shown

    @property
    def folder(self) -> DatasetFolder:
        """The dataset's folder; raises TrilightError where it is on a server."""
        if isinstance(self.files, RemoteDatasetFiles):
            raise TrilightError(f"dataset {self.shown!r} is on a server; expected a local folder.")
        return DatasetFolder(self.files.root)

    @property
    def digest(self) -> str:
        """The dataset digest (storage.dataset.manifest)."""
        return self.manifest.dataset_digest

    def shards_of(self, split: str) -> list[ShardEntry]:
        """Return the shards of one split, by name."""
        return [shard for shard in self.manifest.shards if shard.split == split]

    def scenes(self, split: str | None = None) -> Iterator[SceneRecord]:
        """Yield the scenes of a split, or of all, without their pictures; as `read_scenes`."""
        for shard in self._shards(split):
            yield from self.read_scenes(shard)

    def samples(self, split: str | None = None) -> Iterator[Sample]:
        """Yield the scenes of a split, or of all, with their pictures, as `read_shard` does.

        `sample.radiance_rgb` is [V, R, R, 3] float32 linear radiance of the cameras of
        `sample.scene`, and `sample.views` says of each how it was rendered, and its error.
        """
        for shard in self._shards(split):
            yield from self.read_shard(shard)

    def _shards(self, split: str | None) -> list[ShardEntry]:
        if split is None:
            return list(self.manifest.shards)
        if split not in SPLITS:
            raise TrilightError(f"split is {split!r}; expected one of {', '.join(SPLITS)}.")
        return self.shards_of(split)

    def read_shard(self, shard: ShardEntry) -> Iterator[Sample]:
        """Yield the samples of a shard in the order of the file, after checking its digest.

        Raises:
            TrilightError: the file is missing or its bytes are not those of the manifest.
        """
        with self.files.open(shard, checked=True) as stream:
            for key, members in samples_of(stream, shard.name):
                yield decode_sample(key, members)

    def read_scenes(self, shard: ShardEntry) -> Iterator[SceneRecord]:
        """Yield the samples of a shard without their pictures, through the manifest's index.

        Only what is needed is read, so that a large dataset can be looked at; the digest of the
        shard is therefore not checked (`read_shard` and `trilight verify` do that).

        Raises:
            TrilightError: the shard is missing or shorter than its index, or a scene in it is
                unreadable or breaks a law.
        """
        with self.files.open(shard, checked=False) as stream:
            for key, members in shard.index.items():
                scene_members = [suffix for suffix in members if not suffix.endswith("exr")]
                with reading(self.shown, shard.name):
                    record = decode_scene(key, _read(stream, members, scene_members))
                    _require_lawful(record)
                yield record

    def read_samples(self, shard: ShardEntry, keys: Iterable[str]) -> Iterator[Sample]:
        """Yield some samples of a shard with their pictures; otherwise as `read_scenes`."""
        index = shard.index
        with self.files.open(shard, checked=False) as stream:
            for key in keys:
                with reading(self.shown, shard.name):
                    sample = decode_sample(key, _read(stream, index[key], index[key]))
                    _require_lawful(sample)
                yield sample

    def objects_lock(self) -> list[LockedObject]:
        """Return the objects that were used; none where the dataset has no lock."""
        data = self.files.read("objects.lock.jsonl")
        return [] if data is None else decode_objects_lock(data, "objects.lock.jsonl")

    def failures(self) -> list[Failure]:
        """Return what was rejected; none where the dataset does not say."""
        return decode_failures(self.files.read("failures.jsonl") or b"")


def _read(
    stream: BinaryIO,
    index: Mapping[str, tuple[int, int]],
    suffixes: Iterable[str],
) -> dict[str, bytes]:
    members = {}
    for suffix in suffixes:
        offset, num_bytes = index[suffix]
        stream.seek(offset)
        members[suffix] = stream.read(num_bytes)
        if len(members[suffix]) != num_bytes:
            raise TrilightError("shorter than the manifest says")
    return members


def _require_lawful(record: SceneRecord | Sample) -> None:
    try:
        record.scene.check()
    except TrilightError as error:
        raise TrilightError(f"sample {record.key}: {error}") from error
    if record.scene.num_views != len(record.views):
        raise TrilightError(
            f"sample {record.key}: {len(record.views)} view records; expected "
            f"{record.scene.num_views}, one for each camera."
        )


def open_dataset(
    url: str, *, shard_read: Callable[[ShardEntry], ShardEntry] = lambda shard: shard
) -> Dataset:
    """Open the dataset in a local folder, or below a URL of http, https, s3, gs or hf.

    Args:
        url: where it is.
        shard_read: returns what is kept of each shard of the manifest (storage.dataset.manifest).

    Raises:
        TrilightError: there is no readable manifest, the URL is refused, or the driver for it is
            not installed.
    """
    files = dataset_files(url)
    stream = files.open_beside("manifest.json")
    if stream is None:
        raise TrilightError(
            f"{files.shown}: no manifest.json here; expected a dataset, as `trilight generate ... "
            "--out` makes it."
        )
    with stream:
        place = f"{files.shown}/manifest.json"
        return Dataset(files, decode_manifest(stream, place, shard_read))
