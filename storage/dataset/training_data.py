"""Data that `--data` names: datasets by their roots, or shards by a list.

The shards of several datasets are numbered one dataset after another, and each dataset stays a part
of its own. What share of a stream comes from which, the trainer decides (train.data.order).
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from storage.conventions import SPLITS
from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import Manifest
from storage.dataset.shard_set import (
    KeysSeen,
    ListedShards,
    ManifestShards,
    OpenShard,
    ShardSet,
    listed_shards,
)
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
    num_views: int | None


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
    num_views: int | None
    """Pictures per scene, where a manifest says it."""
    build: str | None = None
    """Name of the preset, where a manifest says it."""
    max_triangles: int | None = None
    """Most triangles of a scene, where a manifest says it."""
    notes: tuple[str, ...] = ()
    """Messages for the user, each printed once."""
    sources: tuple[DataSource, ...] = ()
    """The datasets, in the order of the parts of their splits (ShardSet.parts)."""

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


def open_training_data(data: Sequence[str]) -> TrainingData:
    """Open what `--data` names.

    Args:
        data: one root of a dataset, or any number of paths, URLs and brace patterns that end in
            `.tar`.

    Raises:
        TrilightError: nothing is named, roots and shards are mixed, a URL is refused, or there is
            no readable manifest. That no key is in two shards of a dataset, `trilight verify` says.
    """
    shards = [text for text in data if is_shards(text)]
    if shards and len(shards) == len(data):
        return _of_list(shards)
    if len(data) != 1:
        raise TrilightError(
            f"data: {len(data)} places of which {len(shards)} are shards; expected one dataset, or "
            "shards only (each ends in .tar)."
        )
    return _of_dataset(data[0])


def is_shards(text: str) -> bool:
    """Return whether a place names shards; a folder is a dataset, whatever its name."""
    is_folder = "://" not in text and os.path.isdir(parse_local_path(text))
    return not is_folder and text.partition("?")[0].endswith((".tar", "}"))


def _of_dataset(root: str) -> TrainingData:
    dataset = open_dataset(root)
    splits: dict[str, ShardSet] = {}
    for split in SPLITS:
        entries = [shard for shard in dataset.shards_of(split) if shard.num_samples]
        if entries:
            splits[split] = ManifestShards(dataset, entries)
    build = dataset.manifest.build
    num_views = dataset.manifest.num_views
    return TrainingData(
        display_name=dataset.display_name,
        digest=dataset.digest,
        splits=splits,
        num_views=num_views,
        build=build,
        sources=(DataSource(name=build, digest=dataset.digest, num_views=num_views),),
        max_triangles=_max_triangles(dataset.manifest),
    )


def _max_triangles(manifest: Manifest) -> int | None:
    scenes = manifest.settings.get("scenes")
    limit = scenes.get("max_triangles") if isinstance(scenes, Mapping) else None
    return limit if isinstance(limit, int) else None


def _of_list(patterns: Sequence[str]) -> TrainingData:
    places = listed_shards(patterns)
    seen = KeysSeen()
    splits: dict[str, ShardSet] = {}
    for split in SPLITS:
        chosen = [place for place in places if place.split == split]
        if chosen:
            splits[split] = ListedShards(chosen, seen)
    names = sorted(place.display_name for place in places)
    digest = f"list:{sha256_hex(canonical_json(names))}"
    display_name = f"the list of {len(places)} shards"
    return TrainingData(
        display_name=display_name,
        digest=digest,
        splits=splits,
        num_views=None,
        sources=(DataSource(name=display_name, digest=digest, num_views=None),),
        notes=(NO_MANIFEST,),
    )


MIXED = "mix:"
"""Begins the digest of several datasets."""


class MixedShards(ShardSet):
    """The shards of one split of several datasets, one dataset after another."""

    def __init__(self, sets: Mapping[str, ShardSet]) -> None:
        """Take the shards by what each dataset is called in messages."""
        self._at: list[tuple[ShardSet, int]] = []
        names = list[str]()
        parts = list[range]()
        for called, shards in sets.items():
            parts.append(range(len(names), len(names) + len(shards.names)))
            names += [f"{called}: {name}" for name in shards.names]
            self._at += [(shards, number) for number in range(len(shards.names))]
        self.names = names
        self._parts = tuple(parts)

    @property
    def parts(self) -> Sequence[range]:
        return self._parts

    def num_samples(self, number: int) -> int:
        shards, at = self._at[number]
        return shards.num_samples(at)

    def open(self, number: int) -> OpenShard:
        shards, at = self._at[number]
        opened = shards.open(at)
        opened.name = self.names[number]
        return opened


def open_mixture(data: Sequence[str]) -> TrainingData:
    """Open what `--data` names where it may be more than one dataset.

    Args:
        data: roots of datasets, or any number of shards as `open_training_data` takes them.

    Raises:
        TrilightError: as `open_training_data`; a dataset is there twice, or shards beside datasets.
    """
    if len(data) < 2 or any(is_shards(text) for text in data):
        return open_training_data(data)
    opened = [open_training_data([root]) for root in data]
    for row, each in enumerate(opened):
        before = next((other for other in opened[:row] if other.digest == each.digest), None)
        if before is not None:
            raise TrilightError(
                f"data: {each.display_name} holds the same dataset as {before.display_name}; "
                "expected each once. How often its scenes are drawn, data_weights says."
            )
        each.split("train")
    return TrainingData(
        display_name=" and ".join(each.display_name for each in opened),
        digest=MIXED + sha256_hex(canonical_json([each.digest for each in opened])),
        splits={split: shards for split in SPLITS if (shards := _mix_split(opened, split))},
        num_views=_of_all([each.num_views for each in opened], min),
        max_triangles=_of_all([each.max_triangles for each in opened], max),
        notes=tuple(dict.fromkeys(note for each in opened for note in each.notes)),
        sources=tuple(source for each in opened for source in each.sources),
    )


def _mix_split(opened: Sequence[TrainingData], split: str) -> MixedShards | None:
    having = [row for row, each in enumerate(opened) if split in each.splits]
    if not having:
        return None
    # by number too, since folders may have one name and datasets one preset
    return MixedShards({f"dataset {row + 1}": opened[row].split(split) for row in having})


def _of_all(values: Sequence[int | None], chosen: Callable[[Sequence[int]], int]) -> int | None:
    """Return one number of all datasets; None where one of them does not say it."""
    known = [value for value in values if value is not None]
    return chosen(known) if len(known) == len(values) else None
