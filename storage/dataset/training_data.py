"""Data that `--data` names: datasets by their roots, or shards by a list.

The shards of several datasets are numbered one dataset after another, and each dataset stays a part
of its own. What share of a stream comes from which, the trainer decides (train.data.order).
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.shard_set import KeysSeen, SetShard, ShardSet, listed_shards
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.remote.url import parse_local_path

NO_MANIFEST = (
    "the shards come from a list, without a manifest: no hash is checked, sample counts are found "
    "as shards are read, and a resumed run reads again what it has passed"
)


@dataclass(frozen=True, kw_only=True)
class DataSource:
    """One dataset, as records name it."""

    name: str
    """Name of the dataset preset, or the display name of a list of shards."""
    digest: str
    num_views: int | None = None
    """Pictures per scene, where a manifest says it."""
    max_triangles: int | None = None
    """Most triangles of a scene, where a manifest says it."""


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """The shards of every split that holds a sample, of one dataset or several."""

    display_name: str
    """Paths or URLs as messages show them."""
    digest: str
    """Identity that a checkpoint stores: the dataset digest; for a list, a digest of its names
    only."""
    splits: Mapping[str, ShardSet]
    """Shards by split; splits without a shard are left out."""
    sources: tuple[DataSource, ...]
    """The datasets, in the order of the parts of their splits (ShardSet.parts)."""
    build: str | None = None
    """Name of the preset, where the manifest of a single dataset says it."""
    notes: tuple[str, ...] = ()
    """Messages for the user, each printed once."""

    @property
    def num_views(self) -> int | None:
        """Fewest pictures of a scene, where all manifests say it."""
        return _of_all([source.num_views for source in self.sources], min)

    @property
    def max_triangles(self) -> int | None:
        """Most triangles of a scene, where all manifests say it."""
        return _of_all([source.max_triangles for source in self.sources], max)

    def split(self, name: str) -> ShardSet:
        """Return the shards of a split; raises TrilightError where it holds no scene."""
        if name not in self.splits:
            names = ", ".join(self.splits) or "no split"
            raise TrilightError(
                f"{self.display_name}: the {name} split holds no scene; expected at least one. "
                f"There is {names}: choose it, or generate the dataset with more scenes; in a "
                f"list, name shards {name}-....tar too."
            )
        return self.splits[name]


def open_training_data(data: Sequence[str], *, may_mix: bool = False) -> TrainingData:
    """Open what `--data` names.

    Args:
        data: one root of a dataset, or any number of paths, URLs and brace patterns that end in
            `.tar`.
        may_mix: several roots are allowed too, each of them with a train split.

    Raises:
        TrilightError: nothing is named, roots and shards are mixed, a dataset is there twice, a URL
            is refused, or there is no readable manifest. That no key is in two shards of a dataset,
            `trilight verify` says.
    """
    shards = [text for text in data if is_shards(text)]
    if shards and len(shards) == len(data):
        return _of_list(shards)
    is_mixed = may_mix and len(data) > 1 and not shards
    if len(data) != 1 and not is_mixed:
        raise TrilightError(
            f"data: {len(data)} places of which {len(shards)} are shards; expected one dataset, or "
            "shards only (each ends in .tar)."
        )
    datasets: dict[str, Dataset] = {}
    for dataset in map(open_dataset, data):
        before = datasets.setdefault(dataset.digest, dataset)
        if before is not dataset:
            raise TrilightError(
                f"data: {dataset.display_name} holds the same dataset as {before.display_name}; "
                "expected each once. How often its scenes are drawn, data_weights says."
            )
        if is_mixed:
            _of_datasets([dataset]).split("train")
    return _of_datasets([*datasets.values()])


def is_shards(text: str) -> bool:
    """Return whether a place names shards; a folder is a dataset, whatever its name."""
    is_folder = "://" not in text and os.path.isdir(parse_local_path(text))
    return not is_folder and text.partition("?")[0].endswith((".tar", "}"))


MIXED = "mix:"
"""Begins the digest of several datasets."""


def _of_datasets(datasets: Sequence[Dataset]) -> TrainingData:
    """Return the data of one dataset, or of several that are mixed."""
    sources = tuple(
        DataSource(
            name=dataset.manifest.build,
            digest=dataset.digest,
            num_views=dataset.manifest.num_views,
            max_triangles=dataset.manifest.setting("scenes.max_triangles", int),
        )
        for dataset in datasets
    )
    is_mixed = len(sources) > 1
    mixed = MIXED + sha256_hex(canonical_json([source.digest for source in sources]))
    splits = {}
    for split in SPLITS:
        held = [
            # by number too, since folders may have one name and datasets one preset
            _shards(dataset, split, f"dataset {number}: " if is_mixed else "")
            for number, dataset in enumerate(datasets, start=1)
        ]
        if any(held):
            splits[split] = ShardSet(*filter(None, held))
    return TrainingData(
        display_name=" and ".join(dataset.display_name for dataset in datasets),
        digest=mixed if is_mixed else sources[0].digest,
        splits=splits,
        sources=sources,
        build=None if is_mixed else sources[0].name,
    )


def _shards(dataset: Dataset, split: str, prefix: str) -> list[SetShard]:
    return [
        SetShard(
            name=f"{prefix}{entry.name}",
            open=partial(dataset.open_stream, entry, checked=True),
            num_samples=entry.num_samples,
        )
        for entry in dataset.shards_of(split)
        if entry.num_samples
    ]


def _of_list(patterns: Sequence[str]) -> TrainingData:
    shards = listed_shards(patterns)
    seen = KeysSeen()
    by_split = {split: [each for each in shards if each.split == split] for split in SPLITS}
    digest = f"list:{sha256_hex(canonical_json(sorted(shard.name for shard in shards)))}"
    display_name = f"the list of {len(shards)} shards"
    return TrainingData(
        display_name=display_name,
        digest=digest,
        splits={split: ShardSet(held, seen=seen) for split, held in by_split.items() if held},
        sources=(DataSource(name=display_name, digest=digest),),
        notes=(NO_MANIFEST,),
    )


def _of_all(values: Sequence[int | None], chosen: Callable[[Sequence[int]], int]) -> int | None:
    """Return one number of all datasets; None where one of them does not say it."""
    known = [value for value in values if value is not None]
    return chosen(known) if len(known) == len(values) else None
