"""Small finished datasets to merge, select from and reshard, as `trilight generate` leaves them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.digests import sha256_hex
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    write_failures,
    write_objects_lock,
)
from storage.records.profiles import Profile
from storage.records.sample import Sample, encode_sample
from storage.records.scene import Scene
from tests.pipeline.documents.dataset_by_hand import furnished, locked, sample

SETTINGS = {
    "build": "smoke",
    "renders": {"noise_floor_db": 40.0, "max_spp": 256, "resolution": 16},
    "scenes": {"max_triangles": 9},
    "splits": {"scenes_per_shard": 2},
}
TRAIN_OBJECT = dataclasses.replace(locked("a"), asset_sha256="a" * 64)
TEST_OBJECT = dataclasses.replace(locked("c", "CC-BY-4.0", split="test"), asset_sha256="c" * 64)


def lit(index: int, salt: int, uids: Sequence[str], template: str = "plane") -> Sample:
    """Return a sample whose scene no other (index, salt) has; floors rise with the index."""
    scene: Scene = furnished(uids, template)
    scene.materials[0, 0] = 0.3 + 0.001 * index + 0.1 * salt
    return sample(index, scene, noise_floor_db=36.0 + index)


def scenes(salt: int, *, train: str = "a", test: str = "c") -> dict[str, list[Sample]]:
    """Return four scenes for training in two shards, and two for testing."""
    return {
        "train-000000.tar": [lit(0, salt, [train]), lit(1, salt, [], "wall")],
        "train-000001.tar": [lit(2, salt, [train], "wall"), lit(3, salt, [train])],
        "test-000002.tar": [lit(4, salt, [test], "wall"), lit(5, salt, [test])],
    }


def finished(
    root: Path,
    shards: Mapping[str, Sequence[Sample]],
    *,
    objects: Sequence[LockedObject] = (TRAIN_OBJECT, TEST_OBJECT, locked("unused", "MIT")),
    failures: Sequence[Failure] = (),
    seed: int = 0,
    profiles: Sequence[Profile] = (),
    **changes: object,
) -> Path:
    """Write a finished dataset; `changes` replace fields of its manifest.

    Shards are packed by `profiles`, one for each, or all without loss.
    """
    folder = DatasetFolder(root)
    for row, (name, of_shard) in enumerate(shards.items()):
        profile = profiles[row] if profiles else "lossless"
        members = [(entry.key, encode_sample(entry, profile)) for entry in of_shard]
        write_shard(folder.shard(name), members)
    write_objects_lock(folder.objects_lock, objects)
    write_failures(folder.failures, failures)
    manifest = Manifest(
        build="smoke",
        settings={**SETTINGS, "seed": seed},
        environment={"mitsuba_variant": "none"},
        num_scenes=2 * len(shards),
        num_views=2,
        objects_lock_sha256=sha256_hex(encode_objects_lock(objects)),
        shards=tuple(index_shard(folder.shard(name)) for name in shards),
    )
    write_manifest(folder.manifest, dataclasses.replace(manifest, **changes))  # type: ignore[arg-type]
    return root
