"""What a dataset holds, without its pictures."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.dataset import Dataset
from storage.digests import sha256_hex
from storage.profiles import PACKED, PLAIN, unpack_arrays


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """Counts and distributions of a dataset."""

    num_scenes: int
    """Scenes in all shards."""
    scenes_by_split: Mapping[str, int]
    """Scenes per split."""
    scenes_by_template: Mapping[str, int]
    """Scenes per layout template."""
    scenes_by_excursion: Mapping[str, int]
    """Scenes per axis along which they leave the usual range; empty where none does."""
    scene_digest: str
    """sha256 over the keys and arrays of all scenes, without pictures: equal for equal scenes,
    whatever they were rendered and packed with."""
    num_bytes: int
    """Bytes of all shards."""
    spp: NDArray[np.int64]
    """[views] samples per pixel."""
    noise_floor_db: NDArray[np.float64]
    """[views] psnr_log_db."""
    at_cap: NDArray[np.bool_]
    """[views] whether sampling ended at the cap."""

    @property
    def num_views(self) -> int:
        return len(self.spp)

    def lines(self) -> Sequence[tuple[str, str]]:
        """Return (name, value) rows for people."""
        if not self.num_views:
            return [("scenes", "0")]
        excursions = _counts(self.scenes_by_excursion)
        beyond = [("beyond the range", excursions)] if excursions else []
        median, low = np.percentile(self.noise_floor_db, [50, 5])
        return [
            ("scenes", f"{self.num_scenes} ({_counts(self.scenes_by_split)})"),
            ("templates", _counts(self.scenes_by_template)),
            *beyond,
            ("views", f"{self.num_views}"),
            ("noise floor", f"median {median:.1f} dB, 5th percentile {low:.1f} dB (psnr_log_db)"),
            ("views at the cap", f"{100 * self.at_cap.mean():.1f} %"),
            ("samples per pixel", f"median {np.median(self.spp):.0f}, most {self.spp.max()}"),
            ("scene digest", self.scene_digest),
            ("size", f"{self.num_bytes / 1e6:.1f} MB, {self.bytes_per_scene / 1e3:.0f} kB a scene"),
        ]

    @property
    def bytes_per_scene(self) -> float:
        return self.num_bytes / max(self.num_scenes, 1)


def dataset_statistics(dataset: Dataset) -> Statistics:
    """Read every sample but its pictures through the manifest's index.

    Raises:
        TrilightError, OSError: a shard is missing or shorter than its index.
    """
    splits: Counter[str] = Counter()
    templates: Counter[str] = Counter()
    excursions: Counter[str] = Counter()
    views: list[Any] = []
    scene_members: dict[str, str] = {}
    for shard in dataset.manifest.shards:
        with dataset.files.open(shard, checked=False) as stream:
            for name, offset, num_bytes in shard.members:
                key, _, suffix = name.partition(".")
                if suffix not in ("json", PLAIN, PACKED):
                    continue
                stream.seek(offset)
                member = stream.read(num_bytes)
                if suffix != "json":
                    arrays = unpack_arrays({suffix: member})
                    scene_members[f"{key}.{PLAIN}"] = sha256_hex(arrays)
                    continue
                record = json.loads(member)
                splits[shard.split] += 1
                templates[record["provenance"]["template"]] += 1
                if excursion := record["provenance"].get("excursion"):
                    excursions[excursion["axis"]] += 1
                views.extend(record["views"])
    return Statistics(
        num_scenes=dataset.manifest.num_samples,
        scenes_by_split=splits,
        scenes_by_template=templates,
        scenes_by_excursion=excursions,
        scene_digest=digest_of_scenes(scene_members),
        num_bytes=dataset.manifest.num_bytes,
        spp=np.array([view["spp"] for view in views], np.int64),
        noise_floor_db=np.array([view["noise_floor_db"] for view in views], np.float64),
        at_cap=np.array([view["at_cap"] for view in views], np.bool_),
    )


def digest_of_scenes(members: Mapping[str, str]) -> str:
    """Return the digest of scenes from the sha256 of each unpacked `KEY.scene.safetensors`."""
    lines = (f"{name} {digest}" for name, digest in sorted(members.items()))
    return sha256_hex("\n".join(lines).encode())


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
