"""A finished dataset, for whoever reads it: the manifest and the samples of its shards."""

from collections.abc import Iterator
from pathlib import Path

from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.manifest import Manifest, ShardEntry, read_manifest
from storage.sample import Sample, decode_sample
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


def open_dataset(url: str) -> Dataset:
    """Open the dataset in a local folder.

    Raises:
        TrilightError: there is no readable manifest. Remote datasets are not read yet.
    """
    if "://" in url:
        raise TrilightError(f"{url}: only local folders can be read; expected a path.")
    folder = DatasetFolder(Path(url))
    return Dataset(folder, read_manifest(folder.manifest))
