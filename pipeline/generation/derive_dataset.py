"""Makes a dataset of finished ones, by merging, selecting or resharding: shards, then documents.

The keys of the first source stay; each following source's keys are raised by one number, which the
manifest states as `key_offset`. So every scene can be found in its source, and keys are unique.
Members are copied byte for byte under their new keys, one sample at a time. The result depends on
the sources, their order and the arguments alone. It is written into a hidden folder beside its
path, which is renamed when it is complete. A killed run leaves that folder, and the next one clears
it.
"""

import dataclasses
import itertools
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from pipeline.documents.dataset_documents import write_documents
from pipeline.shards.expression import Condition, condition
from pipeline.shards.finished_dataset import SceneFacts, open_finished, read_facts
from storage.atomic import write_error
from storage.conventions import MANIFEST_VERSION, SPLITS
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    Derivation,
    Manifest,
    ShardEntry,
    common,
    derivation_of,
    derived_settings,
    index_shard,
    source_record,
    write_manifest,
)
from storage.dataset.shard import write_shard
from storage.dataset.splits import named_shard
from storage.dataset.statistics import Statistics
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    write_failures,
    write_objects_lock,
)
from storage.records.quantities import QUANTITIES
from storage.records.sample import sample_key
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class Selection:
    """Conditions that a scene must meet.

    By default there are none.
    """

    split: Literal["train", "validation", "test"] | None = None
    """Keep only the scenes of this split; by default all."""
    template: str | None = None
    """Keep only the scenes of this layout, such as plane; by default all."""
    min_noise_floor_db: Annotated[float | None, Within(-100, 200, unit="dB")] = None
    """Keep only scenes whose views all have this stated error (psnr_log_db); by default all."""
    where: str | None = None
    """Keep only scenes that meet a condition such as "max(roughness) < 0.3"; by default all. The
    reference page Quantities has the names."""

    def __post_init__(self) -> None:
        _ = self.condition

    @cached_property
    def condition(self) -> Condition | None:
        """The parsed `where`, or None; raises TrilightError if it is malformed."""
        return None if self.where is None else condition(self.where)

    def takes(self, facts: SceneFacts) -> bool:
        return (
            self.split in (None, facts.shard.split)
            and self.template in (None, facts.template)
            and (self.min_noise_floor_db is None or facts.noise_floor_db >= self.min_noise_floor_db)
            and (self.condition is None or self.condition.holds(facts.values))
        )


_HELD_BY = attrgetter("dataset", "shard")
"""Returns the source and the shard that hold a selected scene."""


def select_scenes(
    sources: Sequence[Dataset],
    selection: Selection,
    *,
    value_names: Sequence[str] = (),
    shard_done: Callable[[], None],
) -> list[SceneFacts]:
    """Return the selected scenes, in the order of the sources and of their shards.

    Args:
        value_names: names of values to read for each scene beside those of the condition.

    Raises:
        TrilightError: two sources hold the same scene, or a source is damaged.
    """
    names = {*value_names, *(selection.condition.names if selection.condition else ())}
    selected: list[SceneFacts] = []
    seen: dict[str, SceneFacts] = {}
    for source in sources:
        for entry in read_facts(source, names=names, shard_done=shard_done):
            if not selection.takes(entry):
                continue
            first = seen.setdefault(entry.arrays_sha256, entry)
            if first.dataset is not source:
                raise TrilightError(
                    f"scene {entry.key} of {source.folder.root} is scene {first.key} of "
                    f"{first.dataset.folder.root}; expected each scene once. Leave one of "
                    "the datasets out, or generate it with another --seed."
                )
            selected.append(entry)
    return selected


def key_offsets(sources: Sequence[Dataset]) -> dict[Dataset, int]:
    """Return what is added to the keys of each source: 0, then beyond all keys before.

    Scenes that could not be made count too: `failures.jsonl` names them.
    """
    offsets = {}
    following = 0
    for source in sources:
        offsets[source] = following
        last = -1
        if derivation_of(source.manifest.settings):  # else keys are indices
            keys = (key for shard in source.manifest.shards for key in source.keys(shard))
            last = max((int(key) for key in keys if key.isdecimal()), default=-1)
        following += max(last + 1, source.manifest.num_scenes)
    return offsets


def offset_key(key: str, offset: int) -> str:
    """Return a key raised by an offset; raises TrilightError if it is not a number."""
    if not offset:
        return key
    if not (key.isascii() and key.isdecimal()):
        raise TrilightError(f"sample {key!r}: expected a number as key, to raise it by {offset}.")
    return sample_key(int(key) + offset)


def used_objects(selected: Sequence[SceneFacts]) -> list[LockedObject]:
    """Return the locked objects that the selected scenes use.

    Raises:
        TrilightError: an object is in scenes of two splits, known by its uid or by its asset: what
            is learnt from one would be judged on the other. Or an object is in no lock.
    """
    locked_by_uid: dict[Dataset, dict[str, list[LockedObject]]] = {}
    for source in {entry.dataset for entry in selected}:
        objects = locked_by_uid[source] = {}
        for locked in source.objects_lock():  # a merged dataset may have several under one uid
            objects.setdefault(locked.uid, []).append(locked)
    splits: dict[str, tuple[str, SceneFacts]] = {}
    used: dict[LockedObject, None] = {}
    for entry in selected:
        objects = locked_by_uid[entry.dataset]
        for uid in entry.uids:
            if uid not in objects:
                raise TrilightError(
                    f"{entry.dataset.folder.root}: object {uid!r} of scene {entry.key} is not in "
                    "objects.lock.jsonl; run `trilight verify`."
                )
            for locked in objects[uid]:
                used[locked] = None
                for name in (f"uid {uid}", f"asset {locked.asset_sha256}"):
                    split, first = splits.setdefault(name, (entry.shard.split, entry))
                    if split != entry.shard.split:
                        places = " and in ".join(
                            f"{each.shard.split} of {each.dataset.folder.root} (scene {each.key})"
                            for each in (first, entry)
                        )
                        raise TrilightError(
                            f"object {uid!r} is in {places}; expected every object in one split "
                            "only. Generate both with the same splits.held_out_objects, or take "
                            "one split of each with `trilight shards select` first."
                        )
    return list(used)


_TEXTS = ("split", "template")
_COLUMNS = {
    "triangles_per_scene": ("triangles", np.min),
    "lights_per_scene": ("lights", np.min),
    "coverage": ("coverage", np.min),
    "noise_floor_db": ("floor", np.min),
    "noise_floor_linear_db": ("linear", np.min),
    "spp": ("spp", np.max),
}
"""Quantities with the name of their column, and the function that reduces several values."""


def list_scenes(
    source: Dataset,
    selection: Selection,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """Return a row for each scene that a selection takes, in the order of the shards.

    Args:
        progress: called with the number of shards read so far, and the total.

    Raises:
        TrilightError: a shard is damaged.
    """
    done = itertools.count(1)
    total = len(source.manifest.shards)
    selected = select_scenes(
        [source],
        selection,
        value_names=(*_TEXTS, *_COLUMNS),
        shard_done=lambda: progress(next(done), total),
    )
    return [{"key": entry.key, **columns_of(entry.values)} for entry in selected]


def columns_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a listed scene from its values by name."""
    row: dict[str, Any] = {name: values[name] for name in _TEXTS}
    for name, (column, of_several) in _COLUMNS.items():
        number = round(float(of_several(values[name])), QUANTITIES[name].digits)
        row[column] = number if QUANTITIES[name].digits else int(number)
    return row


Operation = Literal["merge", "select", "reshard"]

_SAME = (
    "renders.resolution",
    "renders.per_light",
    "renders.split",
    "renders.split_lobes",
    "storage.passes",
)
"""Settings that all samples of a dataset share."""


@dataclass(frozen=True, kw_only=True)
class DeriveOptions:
    """Operation on finished datasets, with its arguments."""

    operation: Operation  # what it is called
    selection: Selection = dataclasses.field(default_factory=Selection)  # which scenes are taken
    scenes_per_shard: int | None = None
    """Scenes of each new shard; `merge` keeps shards, `select` fills them as its source does."""


def derive_shards(
    sources: Sequence[Dataset],
    derive: DeriveOptions,
    out: DatasetFolder,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write shards, lock, failures and manifest of the new dataset; the manifest comes last.

    Args:
        sources: finished datasets; `select` and `reshard` take one.
        out: an empty folder.
        progress: called with the number of shards read or written so far, and the total.

    Raises:
        TrilightError: the sources do not fit together, one is damaged, nothing is selected, an
            object would be in two splits, or the disk is full.
    """
    _require_alike(sources)
    total = sum(len(source.manifest.shards) for source in sources)
    done = itertools.count(1)
    offsets = key_offsets(sources)
    selected = select_scenes(
        sources, derive.selection, shard_done=lambda: progress(next(done), total)
    )
    if not selected:
        num_scenes = sum(source.manifest.num_samples for source in sources)
        raise TrilightError(f"none of the {num_scenes} scenes is selected; expected at least one.")
    objects = sorted(
        used_objects(selected), key=lambda row: canonical_json(dataclasses.asdict(row))
    )
    groups, scenes_per_shard = _group_scenes(sources, derive, selected)
    for entry in selected:
        offset_key(entry.key, offsets[entry.dataset])  # raises before shards are written
    write_objects_lock(out.objects_lock, objects)
    write_failures(out.failures, _failures(offsets, selected))
    shards = []
    for number, group in enumerate(groups):
        name = named_shard(number, group[0].shard.split)
        write_shard(out.shard(name), _samples(group, offsets))
        shards.append(index_shard(out.shard(name)))
        progress(next(done), total + len(groups))
    arguments = dataclasses.asdict(derive.selection) | {"scenes_per_shard": derive.scenes_per_shard}
    derivation = Derivation(
        operation=derive.operation,
        arguments={name: value for name, value in arguments.items() if value is not None},
        sources=[
            source_record(source.manifest, key_offset=offset) for source, offset in offsets.items()
        ],
    )
    settings = derived_settings(derivation, scenes_per_shard=scenes_per_shard)
    write_manifest(out.manifest, _manifest(sources, settings, objects, tuple(shards)))


def _group_scenes(
    sources: Sequence[Dataset], derive: DeriveOptions, selected: Sequence[SceneFacts]
) -> tuple[list[list[SceneFacts]], int | None]:
    """Return the scenes of each new shard, and the shard size if it is not the sources'.

    Even shards hold one split each, of which the last may be smaller. They are ordered by their
    first scene, so that numbers follow keys.
    """
    if derive.operation == "merge":
        return [list(group) for _, group in itertools.groupby(selected, _HELD_BY)], None
    size = derive.scenes_per_shard
    if size is None:
        size = max(shard.num_samples for shard in sources[0].manifest.shards)
    of_splits = ([entry for entry in selected if entry.shard.split == split] for split in SPLITS)
    groups = [
        entries[start : start + size]
        for entries in of_splits
        for start in range(0, len(entries), size)
    ]
    return sorted(groups, key=lambda entries: entries[0].key), size


def _samples(
    group: Sequence[SceneFacts], offsets: Mapping[Dataset, int]
) -> Iterator[tuple[str, Mapping[str, bytes]]]:
    for (source, shard), entries in itertools.groupby(group, _HELD_BY):
        with source.open_shard(shard, checked=True) as opened:
            for entry in entries:
                yield offset_key(entry.key, offsets[source]), opened.members(entry.key)


def _manifest(
    sources: Sequence[Dataset],
    settings: Mapping[str, Any],
    objects: Sequence[LockedObject],
    shards: tuple[ShardEntry, ...],
) -> Manifest:
    manifests = [source.manifest for source in sources]
    environments = [dict(manifest.environment) for manifest in manifests]
    environment: Mapping[str, Any] = environments[0]
    if any(other != environment for other in environments):
        environment = {**common(environments), "of_sources": environments}
    builds = {manifest.build for manifest in manifests}
    return dataclasses.replace(
        manifests[0],
        build=builds.pop() if len(builds) == 1 else "merged",
        settings=settings,
        environment=environment,
        extensions=_extensions(manifests),
        num_scenes=sum(shard.num_samples for shard in shards),
        schema_version=MANIFEST_VERSION,
        objects_lock_sha256=sha256_hex(encode_objects_lock(objects)),
        shards=shards,
    )


def _extensions(manifests: Sequence[Manifest]) -> Mapping[str, str]:
    """Return the extensions of all sources; one name may have several digests."""
    digests: dict[str, set[str]] = {}
    for manifest in manifests:
        for name, sha256 in manifest.extensions.items():
            digests.setdefault(name, set()).update(sha256.split(" "))
    return {name: " ".join(sorted(several)) for name, several in sorted(digests.items())}


def _failures(offsets: Mapping[Dataset, int], selected: Sequence[SceneFacts]) -> list[Failure]:
    """Return the rejections of the selected scenes, and of objects.

    A given-up scene is never selected. `merge` and `reshard`, which select all scenes, keep its
    rejections too.
    """
    keys = {(entry.dataset, entry.key) for entry in selected}
    held = sum(source.manifest.num_samples for source in offsets)
    rows = []
    for source, offset in offsets.items():
        for failure in source.failures():
            key, dot, view = failure.item.partition(".")
            if failure.stage not in ("scenes", "renders"):
                rows.append(failure)
            elif (source, key) in keys or held == len(selected):
                item = f"{offset_key(key, offset)}{dot}{view}"
                rows.append(dataclasses.replace(failure, item=item))
    return rows


def _require_alike(sources: Sequence[Dataset]) -> None:
    def facts(source: Dataset) -> dict[str, Any]:
        of = source.manifest
        pairs = ((name, *name.split(".")) for name in _SAME)
        settings = {name: of.settings.get(a, {}).get(b, False) for name, a, b in pairs}
        return {"number of views": of.num_views, **settings}

    first = sources[0]
    expected = facts(first)
    for other in sources[1:]:
        for name, now in facts(other).items():
            if (before := expected[name]) != now:
                raise TrilightError(
                    f"{other.folder.root}: its {name} is {now}; expected {before}, as "
                    f"{first.folder.root} has it. Generate one of them again."
                )


def derive_dataset(
    paths: Sequence[str],
    derive: DeriveOptions,
    out: Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[str, Statistics]:
    """Make a dataset of finished ones by merging, selecting or resharding.

    Args:
        out: folder of the new dataset, which must not exist or be empty.
        progress: called with the number of shards read or written so far, and the total.

    Returns:
        The dataset digest, and the statistics of the dataset.

    Raises:
        TrilightError: as `derive_shards`, or `out` is not empty.
    """
    out = Path(os.path.realpath(out))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(
            f"{out}: is there already; expected a new folder. Choose another --out."
        )
    sources = [open_finished(path) for path in paths]
    work = DatasetFolder(out.with_name(f".{out.name}.part"))
    with work.hold_exclusive_lock():
        work.clear()  # what a killed run has left
        try:
            derive_shards(sources, derive, work, progress=progress)
            dataset = open_dataset(str(work.root))
            statistics = write_documents(dataset, work)
            os.replace(work.root, out)
        except OSError as error:
            raise write_error(out, error) from error
        finally:
            shutil.rmtree(work.root, ignore_errors=True)
        shutil.rmtree(DatasetFolder(out).staging, ignore_errors=True)
    return dataset.digest, statistics
