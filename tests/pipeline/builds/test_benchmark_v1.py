"""The frozen test set: whoever composes it gets the published scenes."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.builds.named import BUILDS
from pipeline.builds.settings import BuildSettings
from pipeline.making.attempt_scene import MAX_ATTEMPTS
from pipeline.making.prepare_isolated import prepare_isolated
from pipeline.objects.generated import generate_objects
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from storage.dataset.statistics import digest_of_scenes
from storage.digests import sha256_hex
from storage.errors import Rejected
from storage.records.asset import decode_asset
from storage.records.objects import LockedObject
from storage.records.sample import Sample, encode_sample, sample_key
from storage.records.scene import Scene


@pytest.mark.slow("every")
def test_the_scenes_are_the_published_ones(tmp_path: Path) -> None:
    """All that decides them: built-in objects, the mesh stage and its libraries, the templates."""
    full = BUILDS["benchmark-v1"]
    settings = full.settings()
    pool = _pool(settings, tmp_path)
    members = {}
    for scene_index in range(full.num_scenes):
        key = sample_key(scene_index)
        members[f"{key}.scene.safetensors"] = sha256_hex(
            _arrays(key, _composed(settings, pool, scene_index))
        )
    mini = BUILDS["benchmark-v1-mini"]
    assert digest_of_scenes(dict(list(members.items())[: mini.num_scenes])) == mini.scene_digest
    assert digest_of_scenes(members) == full.scene_digest


def _pool(settings: BuildSettings, tmp_path: Path) -> list[PooledAsset]:
    records = generate_objects(str(settings.source), tmp_path)
    prepared, rejected = prepare_isolated(records, settings.assets, workers=2, done=lambda: None)
    assert not rejected
    pool = []
    for asset in prepared:
        record = asset.record
        locked = LockedObject(
            uid=record.uid,
            asset_sha256=asset.asset_sha256,
            split="test",
            licence=record.licence,
            licence_source=record.licence_source,
            title=record.title,
            attribution=record.attribution,
            source_url=record.source_url,
        )
        pool.append(PooledAsset(locked=locked, asset=decode_asset(asset.path.read_bytes())))
    return sorted(pool, key=lambda entry: entry.locked.uid)


def _composed(settings: BuildSettings, pool: list[PooledAsset], scene_index: int) -> Scene:
    for attempt in range(MAX_ATTEMPTS):
        try:
            return compose_scene(
                settings.scenes,
                pool,
                seed=settings.seed,
                scene_index=scene_index,
                attempt=attempt,
            )
        except Rejected:
            continue
    raise AssertionError(f"scene {scene_index} was rejected {MAX_ATTEMPTS} times")


def _arrays(key: str, scene: Scene) -> bytes:
    without_pictures = Sample(
        key=key, scene=scene, radiance_rgb=np.zeros((0, 8, 8, 3), np.float32), views=()
    )
    return encode_sample(without_pictures)["scene.safetensors"]
