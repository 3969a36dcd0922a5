"""What rays and pixels see in closed form; test_passes has the same in pictures of Mitsuba."""

import numpy as np
import pytest

from storage.conventions import camera_rays, look_at_c2w
from storage.errors import TrilightError
from storage.raycast import MISS, FirstHits, SeenFrom, Surfaces, first_hits
from tests.pipeline.renders.scene_kit import join, light
from tests.scenes_by_hand import tiny_scene


def test_the_floor_in_closed_form() -> None:
    scene = tiny_scene(
        c2w=look_at_c2w(eye=[0, 0, 1], target=[0, 0, 0], up=[0, 1, 0])[None].astype(np.float32),
        fov_deg=np.array([90], np.float32),
    )
    hits = first_hits(scene, resolution=4)
    _, rays = camera_rays(scene.c2w[0], 90, 4)
    assert hits.met.all()  # the lamp hangs behind the camera; the picture is the floor exactly
    np.testing.assert_allclose(hits.depth_m, -1 / rays[..., 2], rtol=1e-12)
    np.testing.assert_allclose(hits.position[0, 0], [-0.75, 0.75, 0], atol=1e-12)
    np.testing.assert_array_equal(hits.geometric_normal, np.broadcast_to([0, 0, 1], (4, 4, 3)))
    np.testing.assert_array_equal(hits.object, 0)
    np.testing.assert_array_equal(hits.material, np.broadcast_to(scene.materials[0], (4, 4, 10)))


def test_emitters_are_hidden_and_normals_interpolated() -> None:
    lamp_before_floor = look_at_c2w(eye=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    slanted = np.tile(np.array([0, 0, 1], np.float32), (7, 1))
    slanted[0] = [0.6, 0, 0.8]
    scene = tiny_scene(c2w=lamp_before_floor[None].astype(np.float32), vertex_normals=slanted,
                       fov_deg=np.array([40], np.float32))  # fmt: skip
    hit = first_hits(scene, resolution=9, pixel=(4, 4))
    assert hit.object == 0
    assert hit.depth_m == pytest.approx(4, abs=1e-9)
    corner = first_hits(scene, resolution=64, pixel=(50, 18))
    shares = corner.barycentric[..., None] * slanted[scene.faces[corner.triangle]]
    expected = shares.sum(axis=-2) / np.linalg.norm(shares.sum(axis=-2))
    np.testing.assert_allclose(corner.shading_normal, expected, rtol=1e-6)
    assert corner.shading_normal[0] > 0.05


def test_a_small_triangle_far_away_keeps_its_digits() -> None:
    """1 cm at 900 m, beside Moeller and Trumbore in the longer floats of numpy."""
    small = np.array([[-0.006, -0.004, 0.002], [0.007, -0.005, -0.003], [0.001, 0.008, 0]])
    positions = np.concatenate([tiny_scene().vertex_positions + np.array([[0, 0, 9]]), small])
    pose = look_at_c2w(eye=[500, 420, 620], target=[0, 0, 0], up=[0, 0, 1])
    scene = tiny_scene(
        vertex_positions=positions.astype(np.float32),
        vertex_normals=np.full((10, 3), [0, 0, 1], np.float32),
        faces=np.array([[7, 8, 9], [0, 2, 3], [4, 5, 6]], np.uint32),
        c2w=pose[None].astype(np.float32),
        fov_deg=np.array([0.01], np.float32),
    )
    hit = first_hits(scene, resolution=101, pixel=(50, 50))
    assert hit.triangle == 0
    origin, rays = camera_rays(scene.c2w[0], float(scene.fov_deg[0]), 101)
    a, b, c = scene.vertex_positions[7:].astype(np.longdouble)
    ray, start = rays[50, 50].astype(np.longdouble), origin - a
    p = np.cross(ray, c - a)
    q = np.cross(start, b - a)
    u, v = np.array([start @ p, ray @ q]) / ((b - a) @ p)
    # one rounding of a coordinate over the edge: 900 * 1e-16 / 0.01
    np.testing.assert_allclose(
        hit.barycentric, np.array([1 - u - v, u, v], float), rtol=0, atol=1e-10
    )


def test_slivers_give_finite_numbers_and_segments_none() -> None:
    """Corners on a line, to the rounding of float32: Embree does meet some of them."""
    rng = np.random.default_rng(0)
    starts, lines = rng.uniform(-1, 1, (200, 1, 3)), rng.normal(size=(200, 1, 3))
    corners = (starts + lines * rng.uniform(-1, 1, (200, 3, 1))).astype(np.float32)
    corners[:50] = corners[:50, :1]  # points
    corners[50:100, 2] = corners[50:100, 1]  # segments
    scene = tiny_scene(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=np.tile(np.array([0, 0, 1], np.float32), (600, 1)),
        faces=np.arange(600, dtype=np.uint32).reshape(-1, 3),
        material_index=np.zeros(200, np.uint16),
        object_index=np.zeros(200, np.uint16),
    )
    origin = np.array([3.0, 2.0, 1.0])
    shares = rng.dirichlet([1, 1, 1], (200, 100))
    rays = np.einsum("nkc,nci->nki", shares, corners.astype(np.float64)) - origin
    hits = SeenFrom(scene, origin).hits(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    assert hits.met.sum() > 1000 and hits.triangle[hits.met].min() >= 100
    for name in ("barycentric", "depth_m", "position", "geometric_normal", "shading_normal"):
        assert np.isfinite(getattr(hits, name)[hits.met]).all(), name


def test_a_ray_in_the_plane_of_its_triangle_stands_for_its_middle() -> None:
    """Float32 may see it a little above the plane in which float64 has it."""
    scene = tiny_scene()
    seen = SeenFrom(scene, np.array([-3.0, 0.5, 0.0]))
    hit = FirstHits(seen=seen, directions=np.array([[1.0, 0, 0]]), triangle=np.array([0]))
    np.testing.assert_allclose(hit.barycentric, [[1 / 3, 1 / 3, 1 / 3]])
    np.testing.assert_allclose(hit.position, [[1 / 3, -1 / 3, 0]])


def test_what_is_not_there_is_named() -> None:
    with pytest.raises(TrilightError, match="view is 2; expected 0 to 1"):
        first_hits(tiny_scene(), view=2)
    with pytest.raises(TrilightError, match="pixel column is 8; expected 0 to 7"):
        first_hits(tiny_scene(), resolution=8, pixel=(0, 8))


DOWN = np.array([[0, 0, -1]], np.float32)


def test_rays_from_both_sides_past_the_floor_and_only_up_to_it() -> None:
    origins = np.array([[0.5, -0.2, 3], [0.5, -0.2, -3], [5, 0, 3]], np.float32)
    met = Surfaces(tiny_scene()).intersect(
        origins, np.array([[0, 0, -2], [0, 0, 1], [0, 0, -1]], "f4")
    )
    assert met.triangle.tolist() == [0, 0, MISS]
    # in lengths of the direction; processors of other vector widths round the last bits otherwise
    np.testing.assert_allclose(met.distance_m[:2], [1.5, 3], rtol=4 * 2**-23)
    assert (met.normal[:2, 2] > 0).all() and not met.normal[:2, :2].any()
    above, down = np.repeat(origins[:1], 3, axis=0), np.repeat(DOWN, 3, axis=0)
    free = Surfaces(tiny_scene()).is_free(above, down, np.array([2.9, 3.1, 1e9], np.float32))
    assert free.tolist() == [True, False, False]


def test_rows_are_those_of_the_scene_where_lights_stand_first() -> None:
    scene = tiny_scene()
    order = [2, 0, 1]
    moved = tiny_scene(
        faces=scene.faces[order],
        material_index=scene.material_index[order],
        object_index=scene.object_index[order],
    )
    above = np.array([[0, 0, 3], [0.5, -0.2, 3], [-0.5, 0.2, 3]], np.float32)
    met = Surfaces(moved).intersect(above, np.repeat(DOWN, 3, axis=0))
    assert met.triangle[1:].tolist() == [1, 2]
    assert met.triangle[0] in (1, 2), "the lamp lets rays pass"


def test_lights_alone() -> None:
    surfaces = Surfaces(join([light([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], 1.0)]))
    origin = np.array([[0, 1, 0]], np.float32)
    toward = np.array([[0, -1, 0]], np.float32)
    assert surfaces.intersect(origin, toward).triangle.tolist() == [MISS]
    assert surfaces.is_free(origin, toward, np.array([9], np.float32)).all()
