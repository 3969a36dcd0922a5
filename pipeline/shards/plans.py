"""Plans a derived dataset: which scenes of its sources go into which shard, under which key.

The keys of the first source stay; each following source's keys are raised by one number, which the
manifest states as `key_offset`. So every scene can be found in its source, and keys are unique.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.shards.expression import Condition, condition
from pipeline.shards.finished_dataset import FinishedDataset, SampleReader, SceneFacts, read_facts
from storage.conventions import SPLITS
from storage.dataset.derived import derivation_of
from storage.errors import TrilightError
from storage.records.objects import LockedObject
from storage.records.sample import sample_key


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Conditions that a selected scene must meet; by default none."""

    split: str | None = None  # take only scenes of this split
    template: str | None = None  # take only scenes of this layout
    min_noise_floor_db: float | None = None
    """Take only scenes whose views all have at least this stated error (psnr_log_db)."""
    where: str | None = None
    """Take only scenes for which this condition holds (pipeline.shards.expression)."""

    def __post_init__(self) -> None:
        if self.split not in (None, *SPLITS):
            raise TrilightError(f"--split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if self.where is not None:
            self.condition()

    def condition(self) -> Condition | None:
        """Return the parsed `where`, or None; raises TrilightError if it is malformed."""
        return None if self.where is None else condition(self.where)

    def takes(self, facts: SceneFacts) -> bool:
        return (
            self.split in (None, facts.shard.split)
            and self.template in (None, facts.template)
            and (self.min_noise_floor_db is None or facts.noise_floor_db >= self.min_noise_floor_db)
        )


@dataclass(frozen=True, kw_only=True)
class SelectedScene:
    """One scene of the new dataset."""

    source: int  # number of its source, from 0
    facts: SceneFacts  # its facts in the source
    key: str  # its new key


def select_scenes(
    sources: Sequence[FinishedDataset],
    selection: Selection,
    *,
    value_names: Sequence[str] = (),
    shard_done: Callable[[], None],
) -> list[SelectedScene]:
    """Return the selected scenes, in the order of the sources and of their shards.

    Args:
        sources: finished datasets.
        selection: conditions on the scenes.
        value_names: names of values to read for each scene beside those of the condition.
        shard_done: called after each shard.

    Raises:
        TrilightError: two sources hold the same scene, or a source is damaged.
    """
    offsets = key_offsets(sources)
    where = selection.condition()
    names = {*value_names, *(where.names if where else ())}
    selected: list[SelectedScene] = []
    seen: dict[str, SelectedScene] = {}
    for row, source in enumerate(sources):
        for facts in read_facts(source, names=names, shard_done=shard_done):
            if not selection.takes(facts) or not (where is None or where.holds(facts.values)):
                continue
            entry = SelectedScene(source=row, facts=facts, key=offset_key(facts.key, offsets[row]))
            first = seen.setdefault(facts.arrays_sha256, entry)
            if first.source != row:
                raise TrilightError(
                    f"scene {facts.key} of {source.folder.root} is scene {first.facts.key} of "
                    f"{sources[first.source].folder.root}; expected each scene once. Leave one of "
                    "the datasets out, or generate it with another --seed."
                )
            selected.append(entry)
    return selected


def key_offsets(sources: Sequence[FinishedDataset]) -> list[int]:
    """Return the offset of the keys of each source: 0, then beyond all keys before.

    Scenes that could not be made count too: `failures.jsonl` names them.
    """
    offsets = []
    following = 0
    for source in sources:
        offsets.append(following)
        following += max(_last_key(source) + 1, source.manifest.num_scenes)
    return offsets


def _last_key(source: FinishedDataset) -> int:
    """Return the largest key of a derived dataset; -1 for a generated one (keys are indices)."""
    if not derivation_of(source.manifest.settings):
        return -1
    with contextlib.closing(SampleReader(source)) as reader:
        keys = (key for shard in source.manifest.shards for key in reader.keys(shard))
        return max((int(key) for key in keys if key.isdecimal()), default=-1)


def offset_key(key: str, offset: int) -> str:
    """Return a key raised by an offset; raises TrilightError if it is not a number."""
    if not offset:
        return key
    if not (key.isascii() and key.isdecimal()):
        raise TrilightError(f"sample {key!r}: expected a number as key, to raise it by {offset}.")
    return sample_key(int(key) + offset)


def used_objects(
    sources: Sequence[FinishedDataset], selected: Sequence[SelectedScene]
) -> list[LockedObject]:
    """Return the locked objects that the selected scenes use.

    Raises:
        TrilightError: an object is in scenes of two splits, known by its uid or by its asset: what
            is learnt from one would be judged on the other. Or an object is in no lock.
    """
    splits: dict[str, tuple[str, SelectedScene]] = {}
    used: dict[LockedObject, None] = {}
    for entry in selected:
        source = sources[entry.source]
        for uid in entry.facts.uids:
            if uid not in source.objects:
                raise TrilightError(
                    f"{source.folder.root}: object {uid!r} of scene {entry.facts.key} is not in "
                    "objects.lock.jsonl; run `trilight verify`."
                )
            for locked in source.objects[uid]:
                used[locked] = None
                for name in (f"uid {uid}", f"asset {locked.asset_sha256}"):
                    split, first = splits.setdefault(name, (entry.facts.shard.split, entry))
                    if split != entry.facts.shard.split:
                        raise TrilightError(_leak(uid, sources, first, entry))
    return list(used)


def _leak(
    uid: str, sources: Sequence[FinishedDataset], first: SelectedScene, second: SelectedScene
) -> str:
    places = " and in ".join(
        f"{entry.facts.shard.split} of {sources[entry.source].folder.root} (scene "
        f"{entry.facts.key})"
        for entry in (first, second)
    )
    return (
        f"object {uid!r} is in {places}; expected every object in one split only. Generate both "
        "with the same splits.held_out_objects, or take one split of each with `trilight shards "
        "select` first."
    )


def kept_shards(selected: Sequence[SelectedScene]) -> list[list[SelectedScene]]:
    """Return the scenes grouped by the shards of their sources."""
    groups: dict[tuple[int, str], list[SelectedScene]] = {}
    for entry in selected:
        groups.setdefault((entry.source, entry.facts.shard.name), []).append(entry)
    return list(groups.values())


def even_shards(
    selected: Sequence[SelectedScene], scenes_per_shard: int
) -> list[list[SelectedScene]]:
    """Return the scenes of each split in shards of one size; the last of a split may be smaller.

    Shards are ordered by their first scene, so that numbers follow keys.

    Raises:
        TrilightError: the size is below 1.
    """
    if scenes_per_shard < 1:
        raise TrilightError(f"--scenes-per-shard is {scenes_per_shard}; expected at least 1.")
    of_split: Mapping[str, list[SelectedScene]] = {
        split: [entry for entry in selected if entry.facts.shard.split == split] for split in SPLITS
    }
    shards = [
        entries[start : start + scenes_per_shard]
        for entries in of_split.values()
        for start in range(0, len(entries), scenes_per_shard)
    ]
    return sorted(shards, key=lambda entries: entries[0].key)
