"""Cameras and meshes in their places, judged by slow twins; and scenes with new materials."""

import dataclasses
import itertools
import json
from typing import Literal

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.presets.registry import preset_settings
from pipeline.scenes.compose import MeshShape, normalize_to_unit_sphere, pose_points
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from pipeline.scenes.shading_normals import (
    ShadedMesh,
    face_normals,
    flat_shaded,
    has_area,
    shading_groups,
    smooth_shaded,
)
from pipeline.scenes.triangle_budget import PooledAsset
from pipeline.scenes.views import (
    CAMERA_ATTEMPTS,
    ViewCamera,
    Visibility,
    cameras_of_view,
    require_valid,
    visibility_problem,
    with_cameras,
)
from scene_templates.layout import Pose
from scene_templates.rotations import rotation_xyz, uniform_rotation
from scene_templates.sample_layout import scene_plan
from scene_templates.settings import ViewLaws
from storage.conventions import camera_rays, look_at_c2w
from storage.errors import Rejected
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.records.scene_facts import lights, surfaces
from storage.seeds import SceneKey
from storage.settings.overrides import apply_overrides
from tests.pipeline.renders.scene_kit import join, light, material, textured_floor
from tests.pipeline.scenes.small_pool import (
    TOUCH,
    first_scene,
    level,
    points_of,
    ray_distances,
    rows_of,
    small_pool,
    triangles_of,
)
from tests.scene_templates.balls import DEFAULTS as SETTINGS
from tests.scene_templates.balls import ROOMS
from tests.scenes_by_hand import tiny_scene
from tests.sky_maps import constant, one_sun
from tests.textured_by_hand import sky, textured_scene


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
    problem = visibility_problem(above, ViewLaws(), has_objects=True)
    assert problem == "sees too little of the objects"
    assert visibility_problem(below, ViewLaws(), has_objects=False) == "sees the back of the shell"
    assert visibility_problem(below, ViewLaws(max_shell_back=1.0), has_objects=False) is not None
    floor = textured_floor(material(diffuse=0.5))
    roof = dataclasses.replace(floor, triangles=floor.triangles + np.array([0, 0, 1.5]))
    lamp = light([[-0.1, -0.1, 2], [0, 0.1, 2], [0.1, -0.1, 2]], 100.0)
    assert Visibility(join([floor, lamp])).facts(_camera([0, 0, 1.0]), 30.0, 16).lit == 1.0
    covered = join([floor, roof, lamp])
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
    attempts = [other.attempt, own.attempt]
    assert seen.provenance == {**scene.provenance, "camera_attempts": attempts}
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
    keys = (SceneKey(7, 3, attempt) for attempt in range(40))
    new_scenes = (with_new_materials(scene, SMOKE.materials, key) for key in keys)
    drawn = [surface for new in new_scenes for surface in surfaces(new)]
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
    glowing = [dataclasses.replace(entry, uid=entry.uid or "mine:x") for entry in scene.objects]
    lit_by_objects = dataclasses.replace(scene, objects=tuple(glowing))
    assert with_new_lights(lit_by_objects, SMOKE.lights, None, KEY) is lit_by_objects


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


ROUNDING = 1e-6
"""Unit vectors in float32 (6e-8 per entry) from positions in float32."""


def _arrays(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)


def _shapes() -> list[tuple[NDArray[np.float32], NDArray[np.uint32]]]:
    create = trimesh.creation
    shapes = [create.icosphere(2), create.box(), create.cylinder(0.3, 1, sections=20)]
    shapes += [create.cone(0.5, 1, sections=9), create.torus(0.5, 0.2, 12, 8), create.capsule()]
    rng = np.random.default_rng(0)
    bumpy = create.icosphere(2)
    bumpy.vertices += rng.normal(scale=0.08, size=bumpy.vertices.shape)
    return [_arrays(mesh) for mesh in [*shapes, bumpy]]


def _by_corner(mesh: ShadedMesh) -> NDArray[np.float32]:
    return mesh.normals[mesh.faces]


def test_shading_moves_no_triangle_turns_with_the_mesh_and_flat_normals_are_geometric() -> None:
    rotation = rotation_xyz([20, 50, -70])
    for positions, faces in _shapes():
        flat, smooth = flat_shaded(positions, faces), smooth_shaded(positions, faces, 30.0)
        for mesh in (flat, smooth):
            assert np.array_equal(mesh.positions[mesh.faces], positions[faces])
            assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < ROUNDING
            assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.positions)))
        geometric = face_normals(positions, faces)
        assert np.abs(_by_corner(flat) - geometric[:, None]).max() < ROUNDING
        assert len(flat.positions) == 3 * len(faces)
        # Coplanar means a cosine of at least 1 in float64: within 2e-8 radians of each other.
        sharp = smooth_shaded(positions, faces, 0.0)
        assert np.abs(_by_corner(sharp) - _by_corner(flat)).max() < ROUNDING
        for angle_deg in (30.0, 180.0):  # no corner is turned away from its face
            corners = _by_corner(smooth_shaded(positions, faces, angle_deg))
            assert np.einsum("tci,ti->tc", corners, geometric).min() > 0.1 - ROUNDING
        turned = (positions @ rotation.T).astype(np.float32)
        straight = _by_corner(smooth_shaded(positions, faces, 33.0)) @ rotation.T
        # Positions move by 6e-8 when rounded; the smallest edge is 0.05 long, and a normal turns
        # by their ratio, a few 1e-6.
        assert np.abs(_by_corner(smooth_shaded(turned, faces, 33.0)) - straight).max() < 1e-5


def test_a_cube_keeps_its_edges_and_a_sphere_becomes_round() -> None:
    positions, faces = _arrays(trimesh.creation.box())
    cube = smooth_shaded(positions, faces, 30.0)
    assert len(cube.positions) == 24
    assert len(set(cube.groups.tolist())) == 6
    assert np.abs(np.abs(cube.normals).max(axis=1) - 1).max() < ROUNDING
    positions, faces = _arrays(trimesh.creation.icosphere(3))
    ball = smooth_shaded(positions, faces, 30.0)
    assert len(ball.positions) == len(positions)
    assert set(ball.groups.tolist()) == {0}
    # The triangles of an icosphere are 9 degrees wide and nearly even about each vertex.
    assert np.sum(ball.normals * ball.positions, axis=1).min() > np.cos(np.radians(1))


def test_groups_agree_with_those_of_trimesh_and_an_edge_of_three_faces_is_sharp() -> None:
    for positions, faces in _shapes():
        normals = face_normals(positions, faces)
        beside = trimesh.graph.face_adjacency(faces)
        cosine = np.sum(np.prod(normals[beside], axis=1), axis=1)
        for angle_deg in (10.0, 30.0, 60.0):
            groups = shading_groups(faces, normals, angle_deg).tolist()
            joined = beside[cosine >= np.cos(np.radians(angle_deg))]
            twin = trimesh.graph.connected_component_labels(joined, len(faces)).tolist()
            pairs = set(zip(groups, twin, strict=True))
            assert len(pairs) == len(set(twin)) == len(set(groups))
    # An edge of three faces is sharp.
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.uint32)
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert len(set(shading_groups(faces, normals, 30.0).tolist())) == 3


def test_normals_do_not_depend_on_how_a_flat_side_is_cut() -> None:
    """A prism's side as two triangles or as eight: the same normals at its corners."""
    positions, faces = _arrays(trimesh.creation.cylinder(0.5, 1, sections=16))
    coarse = smooth_shaded(positions, faces, 30.0)
    fine_positions, fine_faces = trimesh.remesh.subdivide(positions, faces)
    fine = smooth_shaded(fine_positions.astype(np.float32), fine_faces.astype(np.uint32), 30.0)
    for position, normal in zip(coarse.positions, coarse.normals, strict=True):
        same = np.abs(fine.positions - position).max(axis=1) < ROUNDING
        assert np.abs(fine.normals[same] - normal).max(axis=1).min() < 1e-5  # as above


def test_a_doubled_sheet_has_usable_normals() -> None:
    """Two faces back to back share all three edges; even at 180 degrees no normal vanishes."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = smooth_shaded(positions, np.array([[0, 1, 2], [2, 1, 0]], np.uint32), 180.0)
    assert np.array_equal(_by_corner(mesh)[:, :, 2], [[1, 1, 1], [-1, -1, -1]])


def cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two triangle soups [T, 3, 3] cut each other.

    Triangles that cut each other, and do not lie in one plane, have an edge of one through the
    inside of the other. Mere touching is left open.
    """
    for soup, triangles in ((one, other), (other, one)):
        start, end = soup.reshape(-1, 3), np.roll(soup, -1, axis=1).reshape(-1, 3)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        near = ((np.maximum(start, end) >= low) & (np.minimum(start, end) <= high)).all(axis=1)
        if (ray_distances(start[near], (end - start)[near], triangles) < 1).any():
            return True
    return False


def encloses(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether the box of one soup lies in the box of the other."""
    low, high = one.min(axis=(0, 1)), one.max(axis=(0, 1))
    other_low, other_high = other.min(axis=(0, 1)), other.max(axis=(0, 1))
    inside = (low >= other_low).all() and (high <= other_high).all()
    outside = (low <= other_low).all() and (high >= other_high).all()
    return bool(inside or outside)


def _meeting(scene: Scene) -> int:
    """How many pairs of objects meet, by the slow twin."""
    soups = [triangles_of(scene, row) for row in rows_of(scene, "object")]
    return sum(cross(*pair) or encloses(*pair) for pair in itertools.combinations(soups, 2))


def test_meshes_meet_only_where_the_plan_lets_them(
    scenes: list[Scene], pool: list[PooledAsset]
) -> None:
    """Scenes are rounded to float32, a ten-millionth of a unit: none of these is so near."""
    pairs = 0
    for index, scene in enumerate(scenes[:60]):
        if not scene_plan(SETTINGS, seed=3, scene_index=index).overlaps:
            assert _meeting(scene) == 0, index
            pairs += len(rows_of(scene, "object")) // 2
    assert pairs > 25
    changes = {"families.num_objects": [3, 3], "placement.overlap_share": 1.0, "num_views": 1}
    settings = apply_overrides(SETTINGS, changes)
    may = [first_scene(settings, pool, seed=0, scene_index=index) for index in range(12)]
    assert sum(_meeting(scene) > 0 for scene in may) > 3


def _pose(rng: np.random.Generator, radius: float) -> Pose:
    centre = rng.uniform(-0.35, 0.35, size=3)
    return Pose(centre=centre, radius=radius, rotation=uniform_rotation(rng))


def _soup(shape: MeshShape, pose: Pose) -> NDArray[np.float64]:
    return pose_points(shape.points, pose).astype(np.float64)[shape.faces]


def test_meets_agrees_with_the_slow_twin_and_is_symmetric(pool: list[PooledAsset]) -> None:
    rng = np.random.default_rng(0)
    coarse = [MeshShape(entry.locked.uid, entry.asset.levels[-1], "box") for entry in pool]
    found = []
    for _ in range(60):
        one, other = (coarse[row] for row in rng.integers(len(coarse), size=2))
        pose, its_pose = _pose(rng, rng.uniform(0.1, 0.5)), _pose(rng, rng.uniform(0.1, 0.5))
        soup, its_soup = _soup(one, pose), _soup(other, its_pose)
        twin = cross(soup, its_soup) or encloses(soup, its_soup)
        assert one.overlaps(pose, other, its_pose) == twin
        assert other.overlaps(its_pose, one, pose) == twin
        found.append(twin)
    assert 12 < sum(found) < 48


HERE = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))


def _at(x: float, y: float = 0.0, z: float = 0.0, radius: float = 0.5) -> Pose:
    return dataclasses.replace(HERE, centre=np.array([x, y, z]), radius=radius)


def test_meshes_inside_and_beside_each_other_and_of_any_size() -> None:
    """No triangle touches another where a ball is in a closed box, and it is not beside it."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    ball = MeshShape("made", level(trimesh.creation.icosphere(2)), "box")
    within = _at(0, radius=0.1)
    assert not cross(_soup(box, HERE), _soup(ball, within))
    assert box.overlaps(HERE, ball, within) and ball.overlaps(within, box, HERE)
    side = 0.5 / np.sqrt(0.75)
    for gap in (1e-6, 1e-3):  # two cubes in float64: FCL tells a gap of a micrometre
        assert not box.overlaps(HERE, box, _at(side + gap))
        assert box.overlaps(HERE, box, _at(side - gap, 0.01, 0.02))
    # A shape's tree is kept for one size; another size must not be answered by the old tree.
    for radius in (0.5, 0.1, 0.5, 0.3, 0.5):
        assert not ball.overlaps(_at(0, radius=radius), ball, _at(radius + 0.21, radius=0.2))
        assert ball.overlaps(_at(0, radius=radius), ball, _at(radius + 0.17, radius=0.2))


def test_the_centre_is_the_mean_of_the_vertices_or_the_middle_of_the_source() -> None:
    for entry in small_pool():
        points = normalize_to_unit_sphere(entry.asset.levels[0].positions, "vertex_mean")
        # Sums of a thousand float64 below 1.
        assert np.abs(points.mean(axis=0)).max() < 1e-12
        assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    # A level that is not in the middle of its source: half of a ball is gone.
    half = level(trimesh.creation.icosphere(2)).positions
    half = half[half[:, 0] > 0]
    moved = normalize_to_unit_sphere(half + np.float32(0.3), "vertex_mean")
    # Positions are float32 before they are centred: 6e-8 of a number below 1, over a radius of 0.5.
    assert np.abs(moved - normalize_to_unit_sphere(half, "vertex_mean")).max() < TOUCH
    # It is the origin of the asset's unit box, however a level is cut: levels fit each other.
    points = normalize_to_unit_sphere(half, "box")
    assert np.array_equal(points, half / np.linalg.norm(half.astype(float), axis=1).max())
    assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    assert points[:, 0].min() >= 0  # the middle is where the other half would begin


def test_posing_is_a_similarity_that_fills_its_sphere() -> None:
    rng = np.random.default_rng(0)
    centrings: tuple[Literal["box", "vertex_mean"], ...] = ("box", "vertex_mean")
    for entry, centring in itertools.product(small_pool(), centrings):
        pose = _pose(rng, rng.uniform(0.2, 0.5))
        source = normalize_to_unit_sphere(entry.asset.levels[-1].positions, centring)
        points = pose_points(source, pose)
        assert points.dtype == np.float32
        reach = np.linalg.norm(points - pose.centre, axis=1).max()
        assert abs(reach - pose.radius) < TOUCH
        before, after = (
            np.linalg.norm(each[:, None] - each[None], axis=-1)
            for each in (source, points.astype(np.float64))
        )
        assert np.abs(after - pose.radius * before).max() < 5 * TOUCH  # differences of differences


def test_slivers_go_and_all_else_stays() -> None:
    positions, faces = _arrays(trimesh.creation.icosphere(1))
    middle = (positions[0] + positions[1]) / 2
    padded = np.concatenate([positions, [middle.astype(np.float32)]])
    sliver = np.array([[0, 1, 1], [0, 0, 0]], np.uint32)
    all_faces = np.concatenate([faces[:3], sliver, faces[3:]])
    assert np.array_equal(all_faces[has_area(padded, all_faces)], faces)
