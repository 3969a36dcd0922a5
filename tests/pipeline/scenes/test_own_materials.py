"""Objects in their own materials in composed scenes: draws, shares, rights, subdivision."""

import dataclasses

import numpy as np
import trimesh

from pipeline.scenes.own_materials import own_skins
from pipeline.scenes.pieces import dressed, object_piece
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.subdivision import subdivided
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import SurfaceLook
from scene_templates.settings import SceneSettings
from storage.records.asset import Level
from storage.records.lookup import texture_values
from storage.records.packed_maps import pack_texture
from storage.records.scene import SceneObject
from storage.records.skin import LevelSkin, SkinQuality
from storage.records.texture import Texture
from storage.settings.changes import changed
from tests.pipeline.scenes.small_pool import first_scene, pooled, small_pool
from tests.scene_templates.statistics import require_plausible, share

DRAWN = SceneSettings(families=DEFAULT_FAMILIES, num_views=1)
OWN = changed(DRAWN, {"materials.source": "object"})
QUALITY = SkinQuality(
    colour_error=0.0,
    colour_error_p95=0.0,
    missed_cells=0.0,
    torn_seams=0.0,
    texels_per_length=1.0,
)
LOOK = SurfaceLook(
    diffuse_scale=1.0,
    diffuse_rgb=(0.1, 0.2, 0.3),
    specular_rgb=(0, 0, 0),
    roughness=0.5,
    smooth=False,
    colours="one",
)


def _skinned(level: Level, seed: int = 0) -> Level:
    drawn = np.random.default_rng(seed).uniform(0, 0.5, (4, 4, 7)).astype(np.float32)
    parts = (slice(0, 3), slice(3, 6), slice(6, 7))
    first, second, third = (pack_texture(Texture(texels=drawn[..., part])) for part in parts)
    uv = np.random.default_rng(seed).random((len(level.faces), 3, 2)).astype(np.float32)
    return dataclasses.replace(
        level, skin=LevelSkin(uv=uv, packed=(first, second, third), quality=QUALITY)
    )


def _pool() -> list[PooledAsset]:
    """All but the first object have a skin at every level."""
    bare, *others = small_pool()
    dressed_ones = [
        dataclasses.replace(
            entry,
            asset=dataclasses.replace(
                entry.asset,
                levels=tuple(_skinned(level, seed) for level in entry.asset.levels),
            ),
        )
        for seed, entry in enumerate(others)
    ]
    return [bare, *dressed_ones]


def test_own_materials_change_no_other_draw() -> None:
    for index in range(4):
        plain = first_scene(DRAWN, small_pool(), seed=0, scene_index=index)
        own = first_scene(OWN, _pool(), seed=0, scene_index=index)
        for name in ("vertex_positions", "vertex_normals", "faces", "object_index", "c2w"):
            assert np.array_equal(getattr(plain, name), getattr(own, name)), name
        assert plain.uv is None and own.material_textures is not None
        for row, entry in enumerate(own.objects):
            mine = own.object_index == row
            textured = (own.material_textures[own.material_index[mine]] >= 0).any()
            assert textured == (entry.kind == "object" and entry.uid != "made/ball"), entry
            if not textured:
                before = plain.materials[plain.material_index[mine]]
                assert np.array_equal(before, own.materials[own.material_index[mine]])


def test_textures_have_the_rights_of_their_objects() -> None:
    scene = first_scene(OWN, _pool(), seed=0, scene_index=1)
    owners = {entry.uid: entry for entry in scene.objects if entry.uid}
    assert scene.textures
    for texture in scene.textures:
        owner = owners[texture.source.name.rsplit(" ", 1)[0]]
        assert texture.source.licence == owner.licence
        assert (texture.source.attribution, texture.source.source_url) == (
            owner.attribution,
            owner.source_url,
        )


def test_as_many_objects_keep_their_own_as_stated() -> None:
    some = changed(OWN, {"materials.own_share": 0.3})
    entries = _pool()[1:]
    levels = [entry.asset.levels[0] for entry in entries]
    found = []
    for index in range(60):
        name = {"seed": 0, "scene_index": index, "attempt": 0}
        skins = own_skins(entries, levels, some.materials, **name)
        found += [skin is not None for skin in skins]
        everybody = own_skins(entries, levels, OWN.materials, **name)
        assert all(skin is not None for skin in everybody)
    require_plausible({"own": share(found, 0.3)})


def test_drawn_textures_do_not_cover_own_ones() -> None:
    both = changed(OWN, {"textures.share": 1.0, "textures.surfaces.size": 8})
    scene = first_scene(both, _pool(), seed=0, scene_index=1)
    names = {texture.source.name for texture in scene.textures}
    assert any(name.startswith("made/") for name in names)
    assert any(not name.startswith("made/") for name in names)
    own = first_scene(OWN, _pool(), seed=0, scene_index=1)
    assert {texture.sha256 for texture in own.textures} <= {t.sha256 for t in scene.textures}


def test_subdivision_moves_no_colour() -> None:
    level = _skinned(small_pool()[1].asset.levels[0])
    assert level.skin is not None
    positions = level.positions
    piece = object_piece(
        SceneObject(name="box", kind="object"),
        positions,
        level.faces,
        LOOK,
        np.random.default_rng(0),
        30.0,
    )
    (skin,) = own_skins(
        [pooled("a", [trimesh.creation.box()])],
        [level],
        OWN.materials,
        seed=0,
        scene_index=0,
        attempt=0,
    )
    assert skin is not None
    whole = dressed(piece, positions, level.faces, skin)
    more = subdivided(whole, 100)
    assert more.skin is not None and len(more.mesh.faces) > 90

    centres = more.mesh.positions[more.mesh.faces].astype(np.float64).mean(axis=1)
    uv = more.skin.uv.reshape(-1, 3, 2).astype(np.float64).mean(axis=1)
    corners = whole.mesh.positions[whole.mesh.faces].astype(np.float64)
    before = skin.uv.reshape(-1, 3, 2).astype(np.float64)
    for centre, found in zip(centres, uv, strict=True):
        matches = []
        for triangle, its_uv in zip(corners, before, strict=True):
            weights = np.linalg.lstsq(np.vstack([triangle.T, np.ones(3)]), [*centre, 1], rcond=None)
            off = np.abs(np.vstack([triangle.T, np.ones(3)]) @ weights[0] - [*centre, 1]).max()
            if off < 1e-6 and weights[0].min() > -1e-6:
                matches.append(np.abs(weights[0] @ its_uv - found).max())
        assert min(matches) < 1e-5  # float32 positions


def test_means_stand_for_the_textures() -> None:
    scene = first_scene(OWN, _pool(), seed=0, scene_index=1)
    assert scene.material_textures is not None
    row = int(np.flatnonzero(scene.material_textures[:, 0] >= 0)[0])
    texture = scene.textures[scene.material_textures[row, 0]]
    assert np.array_equal(scene.materials[row, :3], texture.mean)
    assert texture_values(texture, np.zeros(2)).shape == (3,)
