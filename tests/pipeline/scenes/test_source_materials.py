"""Objects in their own materials and with their own light in composed scenes."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh

from pipeline.scenes.pieces import (
    ScenePiece,
    Skin,
    apply_skin,
    concatenate_pieces,
    emitter_piece,
    object_piece,
)
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.redrawn import with_new_lights
from pipeline.scenes.source_emission import with_source_emission
from pipeline.scenes.source_materials import source_skins
from pipeline.scenes.subdivision import subdivide
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Emitter
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.records.asset import Level
from storage.records.lookup import texture_values
from storage.records.material import EMISSION
from storage.records.objects import locked_uids
from storage.records.packed_maps import pack_texture
from storage.records.scene import Scene, SceneObject
from storage.records.skin import LevelSkin, SkinQuality
from storage.records.texture import Texture
from storage.seeds import SceneKey
from storage.settings.changes import changed
from tests.pipeline.scenes.small_pool import LOOK, first_scene, pooled, small_pool
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


def test_textures_have_the_rights_and_the_means_of_their_objects() -> None:
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
    both = changed(OWN, {"textures.share": 1.0, "textures.surfaces.size": 8})
    drawn = first_scene(both, _pool(), seed=0, scene_index=1)
    names = {texture.source.name for texture in drawn.textures}
    assert any(name.startswith("made/") for name in names)
    assert any(not name.startswith("made/") for name in names)
    assert {texture.sha256 for texture in scene.textures} <= {t.sha256 for t in drawn.textures}
    assert scene.material_textures is not None
    row = int(np.flatnonzero(scene.material_textures[:, 0] >= 0)[0])
    texture = scene.textures[scene.material_textures[row, 0]]
    assert np.array_equal(scene.materials[row, :3], texture.mean)
    assert texture_values(texture, np.zeros(2)).shape == (3,)


def test_as_many_objects_keep_their_own_as_stated() -> None:
    some = changed(OWN, {"materials.own_share": 0.3})
    entries = _pool()[1:]
    levels = [entry.asset.levels[0] for entry in entries]
    found = []
    for index in range(60):
        scene_key = SceneKey(0, index)
        skins = source_skins(entries, levels, some.materials, scene_key)
        found += [skin is not None for skin in skins]
        everybody = source_skins(entries, levels, OWN.materials, scene_key)
        assert all(skin is not None for skin in everybody)
    require_plausible({"own": share(found, 0.3)})


def test_an_object_whose_textures_break_a_law_costs_scenes_by_its_name() -> None:
    entries, level = _pool()[1:2], _skinned(small_pool()[1].asset.levels[0])
    assert level.skin is not None
    broken = pack_texture(Texture(texels=np.full((1, 1, 3), np.nan, np.float32)))
    skin = dataclasses.replace(level.skin, packed=(broken, *level.skin.packed[1:]))
    levels = [dataclasses.replace(level, skin=skin)]
    with pytest.raises(Rejected, match=f"^law_broken: object {entries[0].locked.uid}: .*diffuse"):
        source_skins(entries, levels, OWN.materials, SceneKey(0, 0))


def test_subdivision_moves_no_colour() -> None:
    level = _skinned(small_pool()[1].asset.levels[0])
    assert level.skin is not None
    positions = level.positions
    box, rng = SceneObject(name="box", kind="object"), np.random.default_rng(0)
    piece = object_piece(box, positions, level.faces, LOOK, rng, 30.0)
    entries = [pooled("a", [trimesh.creation.box()])]
    (skin,) = source_skins(entries, [level], OWN.materials, SceneKey(0, 0))
    assert skin is not None
    whole = apply_skin(piece, positions, level.faces, skin)
    more = subdivide(whole, 100)
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


GLOWS = changed(OWN, {"materials.own_emission": 0.5})
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def glowing_pool(every: int = 4) -> list[PooledAsset]:
    """The first levels' every so-manieth triangle emits, redder along the object."""

    def glow(level: Any) -> Any:
        if level.skin is None:
            return level
        emission = np.zeros((len(level.faces), 3), np.float32)
        emission[::every] = np.linspace([1, 0.5, 0.2], [3, 0.1, 0], len(emission[::every]))
        return dataclasses.replace(level, skin=dataclasses.replace(level.skin, emission=emission))

    return [
        dataclasses.replace(
            entry,
            asset=dataclasses.replace(entry.asset, levels=tuple(map(glow, entry.asset.levels))),
        )
        for entry in _pool()
    ]


def powers(scene: Scene) -> dict[bool, float]:
    """Area times mean radiance by whether an emitter is a lamp."""
    corners = scene.vertex_positions[scene.faces].astype(float)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    power = np.linalg.norm(cross, axis=1) / 2
    power *= scene.materials[scene.material_index, EMISSION].mean(axis=1)
    lamp = np.array([entry.is_lamp for entry in scene.objects])[scene.object_index]
    return {True: float(power[lamp].sum()), False: float(power[~lamp].sum())}


def triangles(scene: Scene) -> np.ndarray:
    return np.sort(scene.vertex_positions[scene.faces].reshape(-1, 9), axis=0)


def test_parts_that_emit_give_the_stated_share_of_light() -> None:
    found = 0
    for index in range(4):
        dark = first_scene(OWN, glowing_pool(), seed=0, scene_index=index)
        lit = first_scene(GLOWS, glowing_pool(), seed=0, scene_index=index)
        assert np.array_equal(triangles(dark), triangles(lit))
        assert np.array_equal(dark.c2w, lit.c2w)
        own = [entry for entry in lit.objects if entry.kind == "emitter" and entry.uid]
        assert not [entry for entry in dark.objects if entry.kind == "emitter" and entry.uid]
        skinned = {entry.uid for entry in dark.objects if entry.uid} - {"made/ball"}
        assert {entry.uid for entry in own} == skinned
        owners = {entry.uid: entry for entry in lit.objects if entry.kind == "object"}
        assert all(entry.licence == owners[entry.uid].licence for entry in own)
        power = powers(lit)
        emits = lit.materials[:, EMISSION]
        lamps = [row for row, entry in enumerate(lit.objects) if entry.is_lamp]
        of_lamps = emits[lit.material_index[np.isin(lit.object_index, lamps)]]
        is_bound = emits.max() <= of_lamps.max() * (1 + 1e-6)
        assert is_bound and power[False] <= 0.5 * power[True] * (1 + 1e-5)
        found += power[False] == pytest.approx(0.5 * power[True], rel=1e-4)
        assert power[True] == pytest.approx(powers(dark)[True], rel=1e-6)
    assert found >= 2


def test_nothing_changes_where_nobody_asks() -> None:
    for index in range(2):
        said = first_scene(OWN, glowing_pool(), seed=0, scene_index=index)
        silent = first_scene(OWN, _pool(), seed=0, scene_index=index)
        for field in dataclasses.fields(said):
            ours, theirs = getattr(said, field.name), getattr(silent, field.name)
            same = np.array_equal(ours, theirs) if isinstance(ours, np.ndarray) else True
            assert same, field.name
        assert said.objects == silent.objects


def _object(emission: list[list[float]], name: str = "screen") -> ScenePiece:
    """A square of two triangles that emit so much."""
    entry = SceneObject(name=name, kind="object", uid=f"made/{name}")
    rng = np.random.default_rng(0)
    piece = object_piece(entry, QUAD, FACES, LOOK, rng, 30.0)
    first, second, third = (
        Texture(texels=np.full((1, 1, channels), 0.1, np.float32)) for channels in (3, 3, 1)
    )
    skin = Skin(
        uv=np.zeros((6, 2), np.float32),
        textures=(first, second, third),
        emission=np.array(emission, np.float32),
    )
    return apply_skin(piece, QUAD, FACES, skin)


def _lamp(corners: np.ndarray, radiance: tuple[float, float, float]) -> ScenePiece:
    emitter = Emitter(triangle=corners.astype(np.float64), radiance_rgb=radiance, reflectance=0.2)
    return emitter_piece(emitter, 0)


def test_an_emissive_triangle_is_the_same_lamp_to_the_last_bit() -> None:
    """Positions, normals and materials; pictures are a function of these."""
    lamp = _lamp(QUAD[FACES[0]] + [0, 0, 2], (8.0, 8.0, 8.0))
    piece = _object([[2, 1, 0], [0, 0, 0]])
    (left,), (own,) = with_source_emission([piece], [lamp], share=0.25)
    power = 0.25 * 8.0  # areas are equal, and (2 + 1 + 0) / 3 is 1
    ours = concatenate_pieces([own])
    twin = concatenate_pieces([_lamp(QUAD[FACES[0]], (2 * power, power, 0.0))])
    for name in ("vertex_positions", "vertex_normals", "faces", "materials", "material_index"):
        assert np.array_equal(ours[name], twin[name]), name
    assert len(left.mesh.faces) == 1 and left.skin is not None and len(left.skin.uv) == 3
    assert np.array_equal(left.mesh.positions, QUAD[FACES[1]])
    assert own.entry.kind == "emitter" and own.entry.uid == "made/screen"


def test_no_part_outshines_the_brightest_lamp_and_what_emits_stays_in_its_place() -> None:
    lamp = _lamp(QUAD[FACES[0]] * 10, (3.0, 2.0, 1.0))
    _, (own,) = with_source_emission([_object([[7, 0, 0], [0, 0, 0]])], [lamp], share=1.0)
    assert own.materials[0, EMISSION] == pytest.approx([3, 0, 0])
    pieces, more = with_source_emission([_object([[1, 0, 0], [0, 1, 0]])], [lamp], share=0.1)
    assert [piece.entry.kind for piece in pieces] == ["emitter"] and not more
    assert len(pieces[0].materials) == 2 and pieces[0].skin is None
    entry = pieces[0].entry
    assert locked_uids([(entry.kind, entry.uid), ("emitter", "")], {}) == ["made/screen"]


@pytest.mark.parametrize(("lamps", "share"), [(True, 0.0), (False, 1.0)])
def test_without_lamps_or_share_all_stays_dark(lamps: bool, share: float) -> None:
    drawn = [_lamp(QUAD[FACES[0]], (1.0, 1.0, 1.0))] if lamps else []
    (piece,), more = with_source_emission([_object([[1, 1, 1], [0, 0, 0]])], drawn, share)
    assert not more and len(piece.mesh.faces) == 2
    assert piece.skin is not None and piece.skin.emission is None


def test_new_lights_leave_parts_that_emit() -> None:
    scene = first_scene(GLOWS, glowing_pool(), seed=0, scene_index=1)
    again = with_new_lights(scene, GLOWS.lights, None, SceneKey(3, 0))
    again.check()
    count = sum(entry.is_lamp for entry in scene.objects)
    assert sum(entry.is_lamp for entry in again.objects) == count
    own = [entry for entry in scene.objects if entry.kind == "emitter" and entry.uid]
    assert own and [e for e in again.objects if e.kind == "emitter" and e.uid] == own
    assert powers(again)[False] == pytest.approx(powers(scene)[False])
