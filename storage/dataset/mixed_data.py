"""Several datasets as one: `--data A --data B`.

Their shards are numbered one dataset after another, and each dataset stays a part of its own. What
share of a stream comes from which, the trainer decides (train.data.order).
"""

from collections.abc import Callable, Mapping, Sequence

from storage.conventions import SPLITS
from storage.dataset.shard_set import OpenShard, ShardSet
from storage.dataset.training_data import TrainingData, is_shards, open_training_data
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError

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
