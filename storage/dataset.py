"""A finished dataset, for whoever reads it: the manifest and the samples of its shards."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.manifest import Manifest, ShardEntry, read_manifest
from storage.sample import Sample, SceneRecord, decode_sample, decode_scene
from storage.shard_reader import iterate_samples


class Dataset:
    """The shards of one dataset folder, checked by digest as they are read."""

    def __init__(self, folder: DatasetFolder, manifest: Manifest) -> None:
        self.folder = folder
        self.manifest = manifest

    @property
    def digest(self) -> str:
        """The dataset digest (storage.manifest)."""
        return self.manifest.dataset_digest

    def shards_of(self, split: str) -> list[ShardEntry]:
        """Return the shards of one split, by name."""
        return [shard for shard in self.manifest.shards if shard.split == split]

    def read_shard(self, shard: ShardEntry) -> Iterator[Sample]:
        """Yield the samples of a shard in the order of the file, after checking its digest.

        Raises:
            TrilightError: the file is missing or its bytes are not those of the manifest.
        """
        path = self.folder.shard(shard.name)
        if not path.exists():
            raise TrilightError(
                f"{path}: the shard is missing; run `trilight generate` again to make it."
            )
        if sha256_of_file(path) != shard.sha256:
            raise TrilightError(
                f"{path}: the bytes are not those of the manifest (sha256 differs). Delete the "
                "file and run `trilight generate` again to make it anew."
            )
        for key, members in iterate_samples(path):
            yield decode_sample(key, members)

    def read_scenes(self, shard: ShardEntry) -> Iterator[SceneRecord]:
        """Yield the samples of a shard without their pictures, through the manifest's index.

        Only what is needed is read, so that a large dataset can be looked at; the digest of the
        shard is therefore not checked (`read_shard` and `trilight verify` do that).

        Raises:
            TrilightError: the shard is missing or shorter than its index, or a scene in it is
                unreadable or breaks a law.
        """
        with self._opened(shard) as stream:
            for key, members in shard.index.items():
                scene_members = [suffix for suffix in members if not suffix.endswith("exr")]
                record = decode_scene(key, _read(stream, shard, members, scene_members))
                _require_lawful(record)
                yield record

    def read_samples(self, shard: ShardEntry, keys: Iterable[str]) -> Iterator[Sample]:
        """Yield some samples of a shard with their pictures; otherwise as `read_scenes`."""
        index = shard.index
        with self._opened(shard) as stream:
            for key in keys:
                sample = decode_sample(key, _read(stream, shard, index[key], index[key]))
                _require_lawful(sample)
                yield sample

    def _opened(self, shard: ShardEntry) -> BinaryIO:
        path = self.folder.shard(shard.name)
        try:
            return path.open("rb")
        except OSError as error:
            raise TrilightError(
                f"{path}: cannot be read ({error.strerror}); run `trilight generate` again to make "
                "what is missing."
            ) from error


def _read(
    stream: BinaryIO,
    shard: ShardEntry,
    index: Mapping[str, tuple[int, int]],
    suffixes: Iterable[str],
) -> dict[str, bytes]:
    members = {}
    for suffix in suffixes:
        offset, num_bytes = index[suffix]
        stream.seek(offset)
        members[suffix] = stream.read(num_bytes)
        if len(members[suffix]) != num_bytes:
            raise TrilightError(
                f"{shard.name}: shorter than the manifest says; run `trilight verify`."
            )
    return members


def _require_lawful(record: SceneRecord | Sample) -> None:
    try:
        record.scene.check()
    except TrilightError as error:
        raise TrilightError(f"sample {record.key}: {error} Run `trilight verify`.") from error
    if record.scene.num_views != len(record.views):
        raise TrilightError(
            f"sample {record.key}: {len(record.views)} view records; expected "
            f"{record.scene.num_views}, one for each camera. Run `trilight verify`."
        )


def open_dataset(url: str) -> Dataset:
    """Open the dataset in a local folder.

    Raises:
        TrilightError: there is no readable manifest. Remote datasets are not read yet.
    """
    if "://" in url:
        raise TrilightError(f"{url}: only local folders can be read; expected a path.")
    folder = DatasetFolder(Path(url))
    return Dataset(folder, read_manifest(folder.manifest))
