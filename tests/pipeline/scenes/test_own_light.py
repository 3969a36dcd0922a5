"""Parts of objects that emit are lamps: the same arrays, and as bright as stated."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from pipeline.scenes.own_light import with_own_light
from pipeline.scenes.pieces import ScenePiece, Skin, dressed, emitter_piece, joined, object_piece
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.redrawn import with_new_lights
from scene_templates.layout import Emitter
from storage.records.material import EMISSION
from storage.records.objects import locked_uids
from storage.records.scene import Scene, SceneObject
from storage.records.texture import Texture
from storage.settings.changes import changed
from tests.pipeline.scenes.small_pool import first_scene
from tests.pipeline.scenes.test_own_materials import LOOK, OWN, _pool

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
    return dressed(piece, QUAD, FACES, skin)


def _lamp(corners: np.ndarray, radiance: tuple[float, float, float]) -> ScenePiece:
    emitter = Emitter(triangle=corners.astype(np.float64), radiance_rgb=radiance, reflectance=0.2)
    return emitter_piece(emitter, 0)


def test_an_emissive_triangle_is_the_same_lamp_to_the_last_bit() -> None:
    """Positions, normals and materials; pictures are a function of these."""
    lamp = _lamp(QUAD[FACES[0]] + [0, 0, 2], (8.0, 8.0, 8.0))
    piece = _object([[2, 1, 0], [0, 0, 0]])
    (left,), (own,) = with_own_light([piece], [lamp], share=0.25)
    power = 0.25 * 8.0  # areas are equal, and (2 + 1 + 0) / 3 is 1
    ours = joined([own])
    twin = joined([_lamp(QUAD[FACES[0]], (2 * power, power, 0.0))])
    for name in ("vertex_positions", "vertex_normals", "faces", "materials", "material_index"):
        assert np.array_equal(ours[name], twin[name]), name
    assert len(left.mesh.faces) == 1 and left.skin is not None and len(left.skin.uv) == 3
    assert np.array_equal(left.mesh.positions, QUAD[FACES[1]])
    assert own.entry.kind == "emitter" and own.entry.uid == "made/screen"


def test_no_part_outshines_the_brightest_lamp() -> None:
    lamp = _lamp(QUAD[FACES[0]] * 10, (3.0, 2.0, 1.0))
    _, (own,) = with_own_light([_object([[7, 0, 0], [0, 0, 0]])], [lamp], share=1.0)
    assert own.materials[0, EMISSION] == pytest.approx([3, 0, 0])


def test_an_object_all_of_which_emits_stays_in_its_place() -> None:
    lamp = _lamp(QUAD[FACES[0]] * 10, (3.0, 2.0, 1.0))
    pieces, more = with_own_light([_object([[1, 0, 0], [0, 1, 0]])], [lamp], share=0.1)
    assert [piece.entry.kind for piece in pieces] == ["emitter"] and not more
    assert len(pieces[0].materials) == 2 and pieces[0].skin is None
    entry = pieces[0].entry
    assert locked_uids([(entry.kind, entry.uid), ("emitter", "")], {}) == ["made/screen"]


@pytest.mark.parametrize(("lamps", "share"), [(True, 0.0), (False, 1.0)])
def test_without_lamps_or_share_all_stays_dark(lamps: bool, share: float) -> None:
    drawn = [_lamp(QUAD[FACES[0]], (1.0, 1.0, 1.0))] if lamps else []
    (piece,), more = with_own_light([_object([[1, 1, 1], [0, 0, 0]])], drawn, share)
    assert not more and len(piece.mesh.faces) == 2
    assert piece.skin is not None and piece.skin.emission is None


def test_new_lights_leave_parts_that_emit() -> None:
    scene = first_scene(GLOWS, glowing_pool(), seed=0, scene_index=1)
    again = with_new_lights(scene, GLOWS.lights, None, seed=3, index=0, attempt=0)
    again.check()
    count = sum(entry.is_lamp for entry in scene.objects)
    assert sum(entry.is_lamp for entry in again.objects) == count
    own = [entry for entry in scene.objects if entry.kind == "emitter" and entry.uid]
    assert own and [e for e in again.objects if e.kind == "emitter" and e.uid] == own
    assert powers(again)[False] == pytest.approx(powers(scene)[False])
