"""Distributions of a dataset's contents: reads it scene by scene, without the pictures."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.statistics import described_shards, of_how_many
from storage.errors import TrilightError
from storage.records.objects import OBJECT, Failure, LockedObject, locked_uids
from storage.records.profiles import PACKED, PLAIN
from storage.records.quantities import QUANTITIES, summary
from storage.records.sample import SceneRecord
from storage.records.scene_facts import Values, scene_values, surfaces, texture_families


@dataclass(frozen=True, kw_only=True, eq=False)
class Distributions:
    """Counts and values over all scenes of a dataset."""

    num_scenes: int
    """Number of scenes of the dataset; if only a sample was read, the counts describe it."""
    values: dict[str, Mapping[str, Values]] = field(default_factory=dict)
    """All values, float32, by split, then by name (storage.records.quantities)."""
    scenes: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of scenes by (template, split)."""
    placements: Counter[str] = field(default_factory=Counter)
    """Number of placements of each object in scenes, by uid; unused objects are missing."""
    map_uses: Counter[str] = field(default_factory=Counter)
    """Number of scenes with each of the user's textures and maps, by uid; unused are missing."""
    surfaces: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of surfaces by (object or shell; all, smooth, many_colours or textured)."""
    maps: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Number of scenes by (texture or sky; its family, or the name of its map)."""
    views_at_cap: Counter[str] = field(default_factory=Counter)
    """Views whose sampling ended at the cap, by split."""
    packings: set[str] = field(default_factory=set)
    """Suffixes under which samples have their arrays (storage.records.profiles)."""
    locked: Sequence[LockedObject]
    """The objects, textures and maps that scenes may draw from, whose rights documents list."""
    failures: Sequence[Failure]
    """Rejections of objects, scenes and views."""
    targets: Mapping[str, float | None]
    """Target values of the settings: max_triangles, the three stated errors, min_spp, max_spp; None
    if the manifest lacks one."""

    def add(self, record: SceneRecord, split: str) -> Mapping[str, Values]:
        """Count one scene and return its values."""
        self.scenes[str(record.scene.provenance.get("template", "unknown")), split] += 1
        self.map_uses.update(locked_uids((), record.scene.provenance))
        self.views_at_cap[split] += sum(bool(view.at_cap) for view in record.views)
        for surface in surfaces(record.scene):
            self.surfaces[surface.kind, "all"] += 1
            self.surfaces[surface.kind, "smooth"] += surface.smooth
            self.surfaces[surface.kind, "many_colours"] += surface.num_colours > 1
            self.surfaces[surface.kind, "textured"] += surface.textured
            if surface.kind == "object":
                self.placements[str(record.scene.objects[surface.row].uid)] += 1
        self.maps.update(("texture", name) for name in texture_families(record.scene))
        if (sky := record.scene.environment) is not None:
            self.maps["sky", sky.source.name] += 1
        return scene_values(record)

    def all(self, name: str) -> Values:
        """Return the values of one quantity over all splits."""
        chunks = [by_name[name] for by_name in self.values.values()]
        return np.concatenate(chunks) if chunks else np.zeros(0, np.float32)

    def reaches_targets(self, split: str) -> NDArray[np.bool_] | None:
        """Return a mask of the views of a split that reach all targets; None without targets."""
        checks = [
            self.values[split][measured] >= target
            for name, measured in MEASURED.items()
            if (target := self.targets[name]) is not None
        ]
        return np.logical_and.reduce(checks) if checks else None

    @property
    def splits(self) -> list[str]:
        """The splits that have scenes, in their usual order."""
        return [split for split in SPLITS if split in self.values]

    @property
    def scenes_by_split(self) -> dict[str, int]:
        return {
            split: sum(count for (_, of), count in self.scenes.items() if of == split)
            for split in self.splits
        }

    @property
    def rejections(self) -> Mapping[tuple[str, str], Counter[int]]:
        """Rejections per attempt, by (stage, reason), the most frequent first."""
        counts: dict[tuple[str, str], Counter[int]] = {}
        for failure in self.failures:
            counts.setdefault((failure.stage, failure.reason), Counter())[failure.attempt] += 1
        return dict(sorted(counts.items(), key=lambda entry: (-entry[1].total(), entry[0])))

    @property
    def objects(self) -> list[LockedObject]:
        return [entry for entry in self.locked if entry.kind == OBJECT]

    @property
    def licences(self) -> Mapping[str, tuple[int, int, int]]:
        """Counts per licence: objects and maps, those in scenes, and their placements."""
        rows: dict[str, tuple[int, int, int]] = {}
        for entry in self.locked:
            count, used, places = rows.get(entry.licence, (0, 0, 0))
            uses = self.placements.get(entry.uid, 0) + self.map_uses.get(entry.uid, 0)
            rows[entry.licence] = (count + 1, used + (uses > 0), places + uses)
        return dict(sorted(rows.items()))

    @property
    def sample(self) -> str:
        """Note for the reader if only a sample of the scenes was read; else empty."""
        return of_how_many(sum(self.scenes.values()), self.num_scenes)

    def uses_per_object(self) -> list[int]:
        """Return the number of placements of each object, zeros included, in falling order."""
        unused = [entry.uid for entry in self.objects if entry.uid not in self.placements]
        return sorted([*self.placements.values(), *(0 for _ in unused)], reverse=True)

    def as_json(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        return {
            "licences": {
                name: {"objects": count, "used": used, "placements": places}
                for name, (count, used, places) in self.licences.items()
            },
            "maps": [
                {"kind": kind, "family": family, "scenes": count}
                for (kind, family), count in sorted(self.maps.items())
            ],
            "object_uses": summary(self.uses_per_object()),
            "quantities": {name: summary(self.all(name)) for name in QUANTITIES},
            "rejections": [
                {"stage": stage, "reason": reason, "attempts": dict(sorted(counts.items()))}
                for (stage, reason), counts in self.rejections.items()
            ],
            "scenes": [
                {"template": template, "split": split, "count": count}
                for (template, split), count in sorted(self.scenes.items())
            ],
            "surfaces": {
                kind: {name: self.surfaces[kind, name] for name in SURFACE_COUNTS}
                for kind in ("object", "shell")
            },
            "targets": dict(self.targets),
            "views_at_cap": {split: self.views_at_cap[split] for split in self.splits},
        }


SURFACE_COUNTS = ("all", "smooth", "many_colours", "textured")

MEASURED = {
    "noise_floor_db": "noise_floor_db",
    "noise_floor_linear_db": "noise_floor_linear_db",
    "noise_floor_objects_db": "object_noise_floor_db",
}
"""Measured quantity of a view, by the name of its target in the settings of renders."""


_TARGETS = {
    "max_triangles": "scenes",
    **dict.fromkeys((*MEASURED, "min_spp", "max_spp"), "renders"),
}
"""Group of settings of each target; a derived dataset may lack one."""


def dataset_distributions(
    dataset: Dataset, *, shard_done: Callable[[str], None] = lambda name: None
) -> Distributions:
    """Read the scenes of a dataset, one at a time and without their pictures: all, or a sample.

    Memory grows by about 200 bytes per read scene (storage.dataset.statistics chooses the sample).
    The digests of the shards are not checked.

    `shard_done` is called with the name of each shard that was read.

    Raises:
        TrilightError: a shard is missing, or a sample is unreadable or breaks a law.
    """
    distributions = Distributions(
        num_scenes=dataset.manifest.num_samples,
        locked=dataset.objects_lock(),
        failures=dataset.failures(),
        targets={
            name: dataset.manifest.setting(f"{group}.{name}", int | float)
            for name, group in _TARGETS.items()
        },
    )
    chunks: dict[str, list[Mapping[str, Values]]] = {}
    for shard in described_shards(dataset):
        rows = []
        distributions.packings.update(dataset.suffixes(shard) & {PLAIN, PACKED})
        for record in dataset.read_scenes(shard):
            try:
                rows.append(distributions.add(record, shard.split))
            except (KeyError, TypeError, ValueError) as error:
                raise TrilightError(
                    f"sample {record.key}: its JSON member is not as expected ({error!r}); run "
                    "`trilight verify`."
                ) from error
        if rows:
            chunks.setdefault(shard.split, []).append(_concatenate(rows))
        shard_done(shard.name)
    distributions.values.update({split: _concatenate(rows) for split, rows in chunks.items()})
    return distributions


def _concatenate(rows: Sequence[Mapping[str, Values]]) -> Mapping[str, Values]:
    return {name: np.concatenate([row[name] for row in rows]) for name in QUANTITIES}
