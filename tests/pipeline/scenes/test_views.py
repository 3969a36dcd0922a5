"""Cameras: where they stand and what they see; and scenes with new materials or lights."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.presets.registry import preset_settings
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from pipeline.scenes.views import (
    CAMERA_ATTEMPTS,
    ViewCamera,
    Visibility,
    cameras_of_view,
    require_valid,
    visibility_problem,
    with_cameras,
)
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings, ViewLaws
from storage.conventions import camera_rays, look_at_c2w
from storage.errors import Rejected
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.records.scene_facts import lights, surfaces
from storage.seeds import SceneKey
from tests.pipeline.scenes.scene_facts import points_of, ray_distances, rows_of
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scene_templates.balls import ROOMS
from tests.scenes_by_hand import tiny_scene
from tests.sky_maps import constant, one_sun
from tests.textured_by_hand import sky, textured_scene

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def _slow_view(scene: Scene, view: int, grid: int) -> tuple[float, float, float]:
    """Coverage, share of shell backs and least depth of a view, by the slow twin."""
    solid = ~scene.triangle_emits
    triangles = scene.vertex_positions[scene.faces[solid]].astype(np.float64)
    is_object = np.array([entry.kind == "object" for entry in scene.objects])
    face_is_object = is_object[scene.object_index[solid]]
    origin, directions = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), grid)
    rays = directions.reshape(-1, 3)
    distances = ray_distances(np.broadcast_to(origin, rays.shape), rays, triangles)
    face, depth = distances.argmin(axis=1), distances.min(axis=1)
    met = np.isfinite(depth)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    behind = met & ~face_is_object[face] & (np.sum(normal[face] * rays, axis=1) > 0)
    return float((met & face_is_object[face]).mean()), float(behind.mean()), float(depth.min())


def test_facts_agree_with_the_slow_twin(scenes: list[Scene]) -> None:
    for scene in scenes[::25]:
        facts = Visibility(scene).facts(scene.c2w[0], float(scene.fov_deg[0]), 32)
        coverage, shell_back, depth = _slow_view(scene, 0, 32)
        # A ray through an edge may fall to either side in single precision: two of 1024.
        assert abs(facts.coverage - coverage) <= 2 / 1024
        assert abs(facts.shell_back - shell_back) <= 2 / 1024
        assert facts.depth <= depth + 1e-5  # the box of an object is nearer than the object


@pytest.mark.slow("every")
def test_accepted_views_hold_on_a_finer_grid_that_shares_no_ray(scenes: list[Scene]) -> None:
    for scene in scenes[::25]:
        for view in range(scene.num_views):
            coverage, shell_back, depth = _slow_view(scene, view, 45)
            # The outline of an object crosses about 4 sqrt(coverage) of the 32 cells of a side,
            # and each crossing errs by a third of a cell or so, independently: under 0.01.
            assert coverage > SETTINGS.views.min_coverage - 0.01
            assert shell_back < SETTINGS.views.max_shell_back + 0.01
            assert depth > SETTINGS.views.min_depth


def test_cameras_are_outside_of_every_objects_box(scenes: list[Scene]) -> None:
    for scene in scenes:
        for row in rows_of(scene, "object"):
            points, eyes = points_of(scene, row), scene.c2w[:, :3, 3]
            inside = (eyes > points.min(axis=0)) & (eyes < points.max(axis=0))
            assert not inside.all(axis=1).any()


def _camera(eye: list[float]) -> NDArray[np.float32]:
    return look_at_c2w(eye=eye, target=[0, 0, 0], up=[0, 1, 0.1]).astype(np.float32)


def test_light_is_seen_from_its_side_past_emitters_and_not_through_roofs() -> None:
    """The hand-made floor is lit from above: fully so from above, not at all from below."""
    visibility = Visibility(tiny_scene())
    above, below = (visibility.facts(_camera([0, 0, z]), 30.0, 16) for z in (1.0, -1.0))
    assert (above.lit, above.shell_back, above.coverage) == (1.0, 0.0, 0.0)
    assert (below.lit, below.shell_back, below.coverage) == (0.0, 1.0, 0.0)
    # A scene without objects need not show any, and one with objects must.
    assert visibility_problem(above, ViewLaws(), has_objects=False) is None
    assert (
        visibility_problem(above, ViewLaws(), has_objects=True) == "sees too little of the objects"
    )
    assert visibility_problem(below, ViewLaws(), has_objects=False) == "sees the back of the shell"
    assert visibility_problem(below, ViewLaws(max_shell_back=1.0), has_objects=False) is not None
    scene = tiny_scene()
    roof = scene.vertex_positions[:4] + np.array([0, 0, 1.5], np.float32)
    covered = dataclasses.replace(
        scene,
        vertex_positions=np.concatenate([scene.vertex_positions, roof]),
        vertex_normals=np.concatenate([scene.vertex_normals, scene.vertex_normals[:4]]),
        faces=np.concatenate([scene.faces, scene.faces[:2] + np.uint32(7)]),
        material_index=np.concatenate([scene.material_index, scene.material_index[:2]]),
        object_index=np.concatenate([scene.object_index, scene.object_index[:2]]),
    )
    assert Visibility(covered).facts(_camera([0, 0, 1.0]), 30.0, 16).lit == 0.0
    # Below the roof the light of an even sky still comes from the sides, and of black none does.
    for around, lit in ((constant(1.0), 1.0), (constant(0.0), 0.0)):
        under = Visibility(dataclasses.replace(covered, environment=around))
        assert under.facts(_camera([0, 0, 1.0]), 30.0, 16).lit == lit
    # From right above the emitter the view goes through it to the floor.
    facts = Visibility(tiny_scene()).facts(_camera([0, 0, 2.01]), 5.0, 16)
    assert facts.lit == 1.0
    # The rays nearest to the axis are half a pixel off it, which lengthens them by 7e-6.
    assert 2.01 < facts.depth < 2.01 * 1.00001


@pytest.mark.parametrize("turned", [False, True])
def test_a_sun_lights_the_side_that_it_shines_on(turned: bool) -> None:
    """Through a lid over the lamp, so that only the sun is left; turned over, it shines below."""
    over = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float32)
    sun = one_sun(1e6, rotation=over if turned else np.eye(3, dtype=np.float32))
    scene = tiny_scene()
    unlit = scene.vertex_positions.copy()
    unlit[scene.faces[scene.triangle_emits].ravel()] *= np.array([1, 1, -1], np.float32)
    alone = dataclasses.replace(scene, vertex_positions=unlit, environment=sun)
    lit = Visibility(alone).facts(_camera([0, 0, 1.0]), 30.0, 16).lit
    assert lit == (0.0 if turned else 1.0)


def test_cameras_of_a_view_need_nothing_but_the_stored_scene_until_they_are_used_up(
    scenes: list[Scene],
) -> None:
    scene, found = scenes[0], list[ViewCamera]()
    with pytest.raises(Rejected, match="no_camera: view 1: none of attempts"):
        for camera in cameras_of_view(scene, Visibility(scene), SETTINGS, 1):
            found.append(camera)
    np.testing.assert_array_equal(found[0].c2w, scene.c2w[1])
    attempts = [camera.attempt for camera in found]
    assert attempts[0] == scene.provenance["camera_attempts"][1]
    assert attempts == sorted(set(attempts)) and attempts[-1] < CAMERA_ATTEMPTS
    assert len({camera.c2w.tobytes() for camera in found}) == len(found) > 5
    stored = scene.with_provenance(json.loads(json.dumps(dict(scene.provenance))))
    own, other, *_ = found
    for camera, same in zip(found, cameras_of_view(stored, Visibility(stored), SETTINGS, 1)):  # noqa: B905
        assert camera.attempt == same.attempt
        np.testing.assert_array_equal(camera.c2w, same.c2w)
        if camera is other:
            break
    seen = with_cameras(scene, [other, own])
    seen.check()
    assert seen.provenance == {
        **scene.provenance,
        "camera_attempts": [other.attempt, own.attempt],
    }
    for name in set(ARRAY_FIELDS) - {"c2w", "fov_deg"}:
        assert np.array_equal(getattr(seen, name), getattr(scene, name))
    np.testing.assert_array_equal(seen.c2w, [other.c2w, own.c2w])
    np.testing.assert_array_equal(seen.fov_deg, [other.fov_deg, own.fov_deg])


SMOKE = preset_settings("smoke").scenes
KEY = SceneKey(7, 3)


@pytest.fixture(scope="module", params=range(4))
def scene(request: pytest.FixtureRequest) -> Scene:
    """The first scene of one of the four rooms."""
    name = sorted(ROOMS)[request.param]
    scenes = (first_scene(SMOKE, small_pool(), seed=0, scene_index=index) for index in range(40))
    return next(scene for scene in scenes if scene.provenance["template"] == name)


def surface_points(scene: Scene) -> list[np.ndarray]:
    """Return corners and normals of all triangles but the emitters', in their order."""
    kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
    faces = scene.faces[kinds != "emitter"]
    return [scene.vertex_positions[faces], scene.vertex_normals[faces]]


def test_new_materials_leave_shape_light_and_the_pattern_of_colours(scene: Scene) -> None:
    new = with_new_materials(scene, SMOKE.materials, KEY)
    new.check()
    for name in ("vertex_positions", "vertex_normals", "faces", "object_index", "c2w"):
        assert np.array_equal(getattr(new, name), getattr(scene, name)), name
    for row in range(len(scene.objects)):
        mine = scene.object_index == row
        before = scene.materials[scene.material_index[mine]]
        after = new.materials[new.material_index[mine]]
        if scene.objects[row].kind == "emitter":
            assert np.array_equal(before, after)
            continue
        assert np.all(after[:, EMISSION] == 0)
        same = scene.material_index[mine][:, None] == scene.material_index[mine]
        assert np.array_equal(new.material_index[mine][:, None] == new.material_index[mine], same)
        assert not np.any(np.all(before[:, DIFFUSE] == after[:, DIFFUSE], axis=1))
        num_colours = len(np.unique(scene.material_index[mine]))
        assert len(np.unique(after[:, DIFFUSE], axis=0)) == num_colours
        sums = (after[:, DIFFUSE] + after[:, SPECULAR]).max(axis=1)
        assert sums.max() <= SMOKE.materials.albedo_sum[1] + 1e-6  # rounding of float32


def test_draws_are_those_of_composition(scene: Scene) -> None:
    """The means of many draws are those of the stated ranges: albedo sums, specular shares."""
    drawn = [
        surface
        for attempt in range(40)
        for surface in surfaces(with_new_materials(scene, SMOKE.materials, SceneKey(7, 3, attempt)))
    ]
    share = np.array([one.specular / 0.95 for one in drawn])
    # uniform in [0, 1] times a sum within 5 % of 0.95: mean 0.5, five standard errors
    assert abs(share.mean() - 0.5) < 5 * 0.29 / np.sqrt(len(drawn))
    assert len({one.roughness for one in drawn}) == len(drawn)


def test_new_lights_leave_surfaces_and_follow_the_ranges(scene: Scene) -> None:
    for count in (None, 1, 5):
        new = with_new_lights(scene, SMOKE.lights, count, KEY)
        new.check()
        for before, after in zip(surface_points(scene), surface_points(new), strict=True):
            assert np.array_equal(before, after)
        old, lit = lights(scene), lights(new)
        assert len(lit) == (len(old) if count is None else count)
        assert {one.centre for one in old}.isdisjoint(one.centre for one in lit)
        low, high = SMOKE.lights.total_emission
        total = sum(one.emission for one in lit)
        assert low * (1 - 1e-6) <= total <= high * (1 + 1e-6)  # float32
        assert [entry.kind for entry in new.objects][-len(lit) :] == ["emitter"] * len(lit)
        assert len(np.unique(new.faces)) == len(new.vertex_positions)  # no vertex is left over
        assert len(np.unique(new.material_index)) == len(new.materials)


def test_redrawn_scenes_are_equal_for_equal_arguments_and_keep_the_laws(scene: Scene) -> None:
    def redrawn(attempt: int) -> Scene:
        key = SceneKey(7, 3, attempt)
        lit = with_new_lights(scene, SMOKE.lights, None, key)
        return with_new_materials(lit, SMOKE.materials, key)

    first, again, other = redrawn(0), redrawn(0), redrawn(1)
    for name in ("materials", "vertex_positions"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
        assert not np.array_equal(getattr(first, name), getattr(other, name))
    # A light that is drawn into an object's box is refused, as composition refuses it.
    near = dataclasses.replace(SMOKE.lights, distance=(0.01, 0.02), target_jitter=0.0)
    with pytest.raises(Rejected, match="emitter_inside"):
        require_valid(with_new_lights(scene, near, 8, KEY), SMOKE)


def test_a_scene_of_a_file_draws_no_lights() -> None:
    scene = tiny_scene(provenance={"template": "renderformer-json"})
    with pytest.raises(Rejected, match="no_layout: 'renderformer-json' is no layout"):
        with_new_lights(scene, SMOKE.lights, 1, KEY)


def test_textures_go_with_the_materials_and_stay_with_the_triangles() -> None:
    """New materials are plain; new lamps stand behind triangles that keep their coordinates."""
    scene = textured_scene(environment=sky())
    plain = with_new_materials(scene, SMOKE.materials, KEY)
    plain.check()
    assert not plain.textures and plain.uv is None and plain.environment is scene.environment
    lit = with_new_lights(scene, SMOKE.lights, 3, KEY)
    lit.check()
    assert lit.num_triangles > scene.num_triangles and lit.environment is scene.environment
    assert lit.uv is not None and scene.uv is not None and lit.material_textures is not None
    assert np.array_equal(lit.uv[:6], scene.uv[:6]) and not lit.uv[6:].any()
    assert lit.textures == scene.textures
    rows = [[0, -1, 1], *[[-1, -1, -1]] * (len(lit.materials) - 1)]
    assert lit.material_textures.tolist() == rows
    assert scene.material_textures is not None
    of_lamps = dataclasses.replace(scene, material_textures=scene.material_textures[::-1].copy())
    of_lamps.check()  # a texture of lamps alone goes with them
    lit = with_new_lights(of_lamps, SMOKE.lights, 1, KEY)
    lit.check()
    assert not lit.textures and lit.uv is None and lit.material_textures is None
