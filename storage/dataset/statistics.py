"""Statistics of a dataset, read without its pictures."""

from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset, reading
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import ShardReader
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.profiles import PACKED, PLAIN, unpack_arrays
from storage.records.sample import SampleJson
from storage.records.scene_file import read_scene_record

MOST_SCENES = 20_000
"""Scenes that are read to describe a dataset: of a percentile over as many, chance moves less than
half a point (binomial, 95 %), and they take minutes."""


def described_shards(dataset: Dataset) -> list[ShardEntry]:
    """Return the shards by which a dataset is described, in its order.

    They are all where those hold no more than MOST_SCENES; else every n-th of each split, its first
    one among them.
    """
    every = -(-dataset.manifest.num_samples // MOST_SCENES)
    if every <= 1:
        return list(dataset.manifest.shards)
    chosen = {shard.name for split in SPLITS for shard in dataset.shards_of(split)[::every]}
    return [shard for shard in dataset.manifest.shards if shard.name in chosen]


def of_how_many(num_read: int, num_scenes: int) -> str:
    """Return the remark that a sample of the scenes stands for all; else an empty text."""
    return "" if num_read >= num_scenes else f"of a sample of {num_read} of {num_scenes} scenes"


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """Counts and distributions of a dataset."""

    num_scenes: int
    scenes_by_split: Mapping[str, int]
    scenes_by_template: Mapping[str, int]
    """Scenes that were read per layout template."""
    scenes_by_excursion: Mapping[str, int]
    """Likewise per axis along which they leave the usual range; empty where none does."""
    num_scenes_read: int
    """Scenes of which the views are: all, or a sample (storage.dataset.statistics)."""
    scene_digest: str
    """sha256 over the keys and arrays of all scenes, without pictures: equal for equal scenes,
    whatever they were rendered and packed with; empty where a sample was read."""
    num_bytes: int
    spp: NDArray[np.int64]
    """Samples per pixel of each view [views]."""
    noise_floor_db: NDArray[np.float64]
    """Stated error of each view [views] as psnr_log_db."""
    noise_floor_linear_db: NDArray[np.float64]
    """Stated error of each view [views] as psnr_linear_db."""
    object_noise_floor_db: NDArray[np.float64]
    """Stated error of each view [views] as object_psnr_log_db."""
    at_cap: NDArray[np.bool_]
    """[views] whether sampling ended at the cap."""
    expected_error_db: NDArray[np.float64] | None = None
    """Expected error of each view [views] as psnr_log_db; None where a view states none."""
    part_noise_floor_db: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """[views] psnr_log_db of each part that is stored; empty where none is."""

    @property
    def num_views(self) -> int:
        return len(self.spp)

    def lines(self) -> Sequence[tuple[str, str]]:
        """Return (name, value) rows to print, without what there is none of."""
        if not self.num_views:
            return [("scenes", "0")]
        kb_per_scene = self.num_bytes / max(self.num_scenes, 1) / 1e3
        rows = [
            ("scenes", f"{self.num_scenes} ({_counts(self.scenes_by_split)})"),
            ("templates", _counts(self.scenes_by_template)),
            ("beyond the range", _counts(self.scenes_by_excursion)),
            ("what follows is", of_how_many(self.num_scenes_read, self.num_scenes)),
            ("views", f"{self.num_views}"),
            ("stated error", _spread(self.noise_floor_db)),
            ("expected error", _spread(self.expected_error_db)),
            *(
                (f"stated error, {part}", _spread(floors_db))
                for part, floors_db in self.part_noise_floor_db.items()
            ),
            ("views at the cap", f"{100 * self.at_cap.mean():.1f} %"),
            ("samples per pixel", f"median {np.median(self.spp):.0f}, most {self.spp.max()}"),
            ("scene digest", self.scene_digest),
            ("size", f"{self.num_bytes / 1e6:.1f} MB, {kb_per_scene:.0f} kB a scene"),
        ]
        return [row for row in rows if row[1]]


def dataset_statistics(dataset: Dataset) -> Statistics:
    """Read samples but their pictures, through the headers of the shards: all, or a sample of them.

    Raises:
        TrilightError: a shard is missing or damaged.
    """
    read = described_shards(dataset)
    is_complete = len(read) == len(dataset.manifest.shards)
    by_split = Counter[str]()
    for shard in dataset.manifest.shards:
        by_split[shard.split] += shard.num_samples
    templates = Counter[str]()
    excursions = Counter[str]()
    digests: dict[str, str] = {}
    # of each view eight bytes a column, however many there are
    views = {name: array("d") for name in _OF_VIEWS}
    expected = array("d")
    parts: dict[str, array[float]] = {}
    for key, sha256, record in _read_scenes(dataset, read):
        digests[f"{key}.{PLAIN}"] = sha256
        templates[record.provenance.get("template", "unknown")] += 1
        if excursion := record.provenance.get("excursion"):
            excursions[excursion["axis"]] += 1
        for view in record.views:
            for name, column in views.items():
                column.append(getattr(view, name))
            if view.expected is not None:
                expected.append(view.expected.noise_floor_db)
            for name, part in (view.parts or {}).items():
                parts.setdefault(name, array("d")).append(part.noise_floor_db)
    num_views = len(views["spp"])
    has_parts = all(len(column) == num_views for column in parts.values())
    return Statistics(
        num_scenes=dataset.manifest.num_samples,
        scenes_by_split=+by_split,
        num_scenes_read=sum(shard.num_samples for shard in read),
        scenes_by_template=templates,
        scenes_by_excursion=excursions,
        scene_digest=digest_of_scenes(digests) if is_complete else "",
        num_bytes=dataset.manifest.num_bytes,
        **{name: np.asarray(views[name], kind) for name, kind in _OF_VIEWS.items()},
        expected_error_db=np.asarray(expected) if 0 < len(expected) == num_views else None,
        part_noise_floor_db={
            name: np.asarray(column) for name, column in sorted(parts.items()) if has_parts
        },
    )


_OF_VIEWS: Mapping[str, Any] = {
    "spp": np.int64,
    "noise_floor_db": np.float64,
    "noise_floor_linear_db": np.float64,
    "object_noise_floor_db": np.float64,
    "at_cap": np.bool_,
}


def _read_scenes(
    dataset: Dataset, shards: Sequence[ShardEntry]
) -> Iterator[tuple[str, str, SampleJson]]:
    """Yield key, sha256 of the unpacked arrays and record of each scene of some shards."""
    for shard in shards:
        with (
            dataset.open_stream(shard, checked=False) as stream,
            reading(dataset.display_name, shard.name),
        ):
            num_bytes = dataset.store.num_bytes(shard.name)
            if num_bytes not in (None, shard.num_bytes):
                raise TrilightError(f"{num_bytes} bytes; expected {shard.num_bytes}")
            opened = ShardReader(stream, shard.name)
            for key, members in opened.samples.items():
                text = opened.read(members["json"])
                record = read_scene_record(text, SampleJson, f"member {key}.json")
                packed = opened.members(key, {PLAIN, PACKED}.__contains__)
                yield key, sha256_hex(unpack_arrays(packed)), record


def digest_of_scenes(members: Mapping[str, str]) -> str:
    """Return the digest of scenes from the sha256 of each unpacked `KEY.scene.safetensors`."""
    lines = (f"{name} {digest}" for name, digest in sorted(members.items()))
    return sha256_hex("\n".join(lines).encode())


def _spread(floors_db: NDArray[np.float64] | None) -> str:
    if floors_db is None:
        return ""
    median, low = np.percentile(floors_db, [50, 5])
    return f"median {median:.1f} dB, 5th percentile {low:.1f} dB (psnr_log_db)"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
