"""Stage "shards" on finished datasets: merges, selects and reshards.

Members are copied byte for byte under their new keys, one sample at a time. The result depends on
the sources, their order and the arguments alone; it is written into a folder of its own.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.shards.finished_dataset import FinishedDataset, SampleReader
from pipeline.shards.plans import (
    SelectedScene,
    Selection,
    even_shards,
    kept_shards,
    key_offsets,
    offset_key,
    select_scenes,
    used_objects,
)
from storage.conventions import MANIFEST_VERSION
from storage.dataset.derived import Derivation, common, derived_settings, source_record
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.splits import named_shard
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    read_failures,
    write_failures,
    write_objects_lock,
)

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

    @property
    def arguments(self) -> dict[str, Any]:
        """The user's arguments, as the manifest states them."""
        arguments = {
            **dataclasses.asdict(self.selection),
            "scenes_per_shard": self.scenes_per_shard,
        }
        return {name: value for name, value in arguments.items() if value is not None}


def derive_shards(
    sources: Sequence[FinishedDataset],
    derive: DeriveOptions,
    out: DatasetFolder,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write shards, lock, failures and manifest of the new dataset; the manifest comes last.

    Args:
        sources: finished datasets; `select` and `reshard` take one.
        derive: operation and arguments.
        out: an empty folder.
        progress: called with the number of shards read or written so far, and the total.

    Raises:
        TrilightError: the sources do not fit together, one is damaged, nothing is selected, an
            object would be in two splits, or the disk is full.
    """
    _require_alike(sources)
    total = sum(len(source.manifest.shards) for source in sources)
    done = itertools.count(1)
    selected = select_scenes(
        sources, derive.selection, shard_done=lambda: progress(next(done), total)
    )
    if not selected:
        num_scenes = sum(source.manifest.num_samples for source in sources)
        raise TrilightError(f"none of the {num_scenes} scenes is selected; expected at least one.")
    objects = sorted(
        used_objects(sources, selected), key=lambda row: canonical_json(dataclasses.asdict(row))
    )
    groups, scenes_per_shard = _group_scenes(sources, derive, selected)
    write_objects_lock(out.objects_lock, objects)
    write_failures(out.failures, _failures(sources, selected))
    shards = []
    for number, group in enumerate(groups):
        name = named_shard(number, group[0].facts.shard.split)
        write_shard(out.shard(name), _samples(sources, group))
        shards.append(index_shard(out.shard(name)))
        progress(next(done), total + len(groups))
    write_manifest(
        out.manifest, _manifest(sources, derive, objects, tuple(shards), scenes_per_shard)
    )


def _group_scenes(
    sources: Sequence[FinishedDataset], derive: DeriveOptions, selected: Sequence[SelectedScene]
) -> tuple[list[list[SelectedScene]], int | None]:
    """Return the scenes of each new shard, and the shard size if it is not the sources'."""
    if derive.operation == "merge":
        return kept_shards(selected), None
    size = derive.scenes_per_shard
    if size is None:
        size = max(shard.num_samples for shard in sources[0].manifest.shards)
    return even_shards(selected, size), size


def _samples(
    sources: Sequence[FinishedDataset], group: Sequence[SelectedScene]
) -> Iterator[tuple[str, Mapping[str, bytes]]]:
    with contextlib.ExitStack() as opened:
        readers = [
            opened.enter_context(contextlib.closing(SampleReader(source))) for source in sources
        ]
        for entry in group:
            facts = entry.facts
            yield entry.key, readers[entry.source].members(facts.shard, facts.key)


def _manifest(
    sources: Sequence[FinishedDataset],
    derive: DeriveOptions,
    objects: Sequence[LockedObject],
    shards: tuple[ShardEntry, ...],
    scenes_per_shard: int | None,
) -> Manifest:
    manifests = [source.manifest for source in sources]
    derivation = Derivation(
        operation=derive.operation,
        arguments=derive.arguments,
        sources=[
            source_record(manifest, key_offset=offset)
            for manifest, offset in zip(manifests, key_offsets(sources), strict=True)
        ],
    )
    builds = {manifest.build for manifest in manifests}
    return dataclasses.replace(
        manifests[0],
        build=builds.pop() if len(builds) == 1 else "merged",
        settings=derived_settings(derivation, scenes_per_shard=scenes_per_shard),
        environment=_environment(manifests),
        extensions=_extensions(manifests),
        num_scenes=sum(shard.num_samples for shard in shards),
        schema_version=MANIFEST_VERSION,
        objects_lock_sha256=sha256_hex(encode_objects_lock(objects)),
        shards=shards,
    )


def _environment(manifests: Sequence[Manifest]) -> Mapping[str, Any]:
    """Return the common environment of all sources; if they differ, also that of each."""
    environments = [dict(manifest.environment) for manifest in manifests]
    if all(environment == environments[0] for environment in environments):
        return environments[0]
    return {**common(environments), "of_sources": environments}


def _extensions(manifests: Sequence[Manifest]) -> Mapping[str, str]:
    """Return the extensions of all sources; one name may have several digests."""
    digests: dict[str, set[str]] = {}
    for manifest in manifests:
        for name, sha256 in manifest.extensions.items():
            digests.setdefault(name, set()).update(sha256.split(" "))
    return {name: " ".join(sorted(several)) for name, several in sorted(digests.items())}


def _failures(
    sources: Sequence[FinishedDataset], selected: Sequence[SelectedScene]
) -> list[Failure]:
    """Return the rejections of the selected scenes, and of objects.

    A given-up scene is never selected. `merge` and `reshard`, which select all scenes, keep its
    rejections too.
    """
    keys = {(entry.source, entry.facts.key) for entry in selected}
    held = sum(source.manifest.num_samples for source in sources)
    rows = []
    for row, (source, offset) in enumerate(zip(sources, key_offsets(sources), strict=True)):
        for failure in read_failures(source.folder.failures):
            key, dot, view = failure.item.partition(".")
            if failure.stage not in ("scenes", "renders"):
                rows.append(failure)
            elif (row, key) in keys or held == len(selected):
                item = f"{offset_key(key, offset)}{dot}{view}"
                rows.append(dataclasses.replace(failure, item=item))
    return rows


def _require_alike(sources: Sequence[FinishedDataset]) -> None:
    first = sources[0]
    for other in sources[1:]:
        pairs = [
            ("number of views", first.manifest.num_views, other.manifest.num_views),
            *((name, _setting(first, name), _setting(other, name)) for name in _SAME),
        ]
        for name, before, now in pairs:
            if before != now:
                raise TrilightError(
                    f"{other.folder.root}: its {name} is {now}; expected {before}, as "
                    f"{first.folder.root} has it. Generate one of them again."
                )


def _setting(dataset: FinishedDataset, name: str) -> Any:
    group, _, setting = name.partition(".")
    return dataset.manifest.settings.get(group, {}).get(setting, False)
