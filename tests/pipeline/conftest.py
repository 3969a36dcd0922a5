"""A hundred composed scenes, made once for all laws."""

import json
from pathlib import Path

import pytest
import trimesh

from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from tests.pipeline.scenes.small_pool import first_scene, pooled, small_pool


@pytest.fixture(scope="session")
def pool() -> list[PooledAsset]:
    return small_pool()


@pytest.fixture(scope="session")
def scenes(pool: list[PooledAsset]) -> list[Scene]:
    """A hundred scenes under the default settings."""
    settings = SceneSettings(families=DEFAULT_FAMILIES)
    return [first_scene(settings, pool, seed=3, scene_index=index) for index in range(100)]


LEAST_SHARE = 338
"""Triangles for each of three objects in the open box: (1536 - 512 - 8) / 3."""


@pytest.fixture(scope="session")
def real_pool(shared: Path) -> list[PooledAsset]:
    """Every twelfth real object that always fits as it is: thin, open, doubled, in many parts."""
    lines = (shared / "objects/objects.jsonl").read_text().splitlines()
    rows = sorted((json.loads(line) for line in lines), key=lambda row: str(row["uid"]))
    found = []
    for row in rows[::12]:
        mesh = trimesh.load_mesh(shared / "objects" / row["path"])
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
        if len(mesh.faces) <= LEAST_SHARE:
            found.append(pooled(row["uid"], [mesh]))
    return found
