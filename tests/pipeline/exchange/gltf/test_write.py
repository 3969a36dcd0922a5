"""A textured mesh as GLB comes back as what it was."""

from pathlib import Path

import numpy as np

from pipeline.exchange.gltf.write import encode_mesh_glb
from storage.records.asset import Level
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, write_glb
from tests.pipeline.assets.source_materials.textured_kit import (
    CORNERS,
    KEEP,
    QUARTERS,
    picture_bytes,
    seen_at,
    textured_glb,
    textured_tree,
)

STEPS = 0.03
"""The texture is resampled once more, and rounded to 8 bits as base colour and as diffuse part."""


def _written(path: Path, level: Level) -> Path:
    assert level.skin is not None
    path.write_bytes(
        encode_mesh_glb(level.positions, level.faces, level.skin.uv, level.skin.textures)
    )
    return path


def test_colours_and_triangles_come_back(tmp_path: Path) -> None:
    asset = prepare(textured_glb(tmp_path / "a.glb", picture_bytes(CORNERS)), KEEP)
    again = prepare(_written(tmp_path / "b.glb", asset.levels[0]), KEEP)
    assert geometry(again) == geometry(asset)
    for place in QUARTERS:
        for column in range(3):
            before, after = seen_at(asset, *place, column), seen_at(again, *place, column)
            assert np.abs(before - after).max() < STEPS, (place, column)


def test_metal_comes_back_as_the_same_light(tmp_path: Path) -> None:
    """Not as a metal: what both lobes reflect is what we keep."""
    tree, buffer = textured_tree(picture_bytes(np.array([[[9, 51, 0], [9, 204, 255]]], np.uint8)))
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal |= {"metallicRoughnessTexture": metal.pop("baseColorTexture"), "metallicFactor": 1}
    metal["baseColorFactor"] = [0.9, 0.4, 0.2, 1]
    asset = prepare(write_glb(tmp_path / "a.glb", tree, buffer), KEEP)
    again = prepare(_written(tmp_path / "b.glb", asset.levels[0]), KEEP)
    for right in (-0.25, 0.25):
        for column in range(3):
            before, after = seen_at(asset, right, 0, column), seen_at(again, right, 0, column)
            assert np.abs(before - after).max() < STEPS, (right, column)
