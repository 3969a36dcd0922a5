"""Frames, units, metrics and intervals, against what is known on paper; rays in closed form.

tests/pipeline/renders/test_passes.py has what rays see in pictures of Mitsuba.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.conventions import (
    camera_rays,
    focal_px,
    in_camera,
    log10_radiance,
    look_at_c2w,
    pixel_places,
    preview_srgb8,
    radiance_from_log10,
    srgb8,
)
from storage.errors import TrilightError
from storage.metrics import (
    MAX_DB,
    mean_interval,
    object_psnr_log_db,
    pepper,
    psnr_linear_db,
    psnr_log_db,
    seam,
)
from storage.raycast import MISS, FirstHits, SeenFrom, Surfaces, first_hits
from tests.pipeline.renders.scene_kit import join, light
from tests.scenes_by_hand import from_above, tiny_scene

angles = st.floats(1, 170)


def test_a_camera_looks_along_minus_z_with_y_up() -> None:
    c2w = look_at_c2w(eye=[0, -3, 0], target=[0, 0, 0], up=[0, 0, 1])
    assert np.allclose(c2w @ [0, 0, -1, 0], [0, 1, 0, 0])
    assert np.allclose(c2w @ [0, 1, 0, 0], [0, 0, 1, 0])
    assert np.allclose(c2w @ [1, 0, 0, 0], [1, 0, 0, 0])


@given(fov_deg=angles, resolution=st.integers(2, 64))
def test_the_outer_pixel_edges_span_the_field_of_view(fov_deg: float, resolution: int) -> None:
    half_width = 0.5 * resolution / focal_px(fov_deg, resolution)
    assert np.isclose(2 * np.degrees(np.arctan(half_width)), fov_deg)


@given(fov_deg=angles)
def test_rays_are_unit_and_turn_with_the_picture(fov_deg: float) -> None:
    c2w = look_at_c2w(eye=[1, 2, 3], target=[0, 0, 0], up=[0, 0, 1])
    origin, directions = camera_rays(c2w, fov_deg, 8)
    assert np.allclose(origin, [1, 2, 3])
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    up, right = c2w[:3, 1], c2w[:3, 0]
    assert (np.diff(directions @ up, axis=0) < 0).all()  # row 0 is the top
    assert (np.diff(directions @ right, axis=1) > 0).all()
    middle = directions[3:5, 3:5].mean(axis=(0, 1))
    assert np.allclose(middle / np.linalg.norm(middle), -c2w[:3, 2])
    _, rows = camera_rays(c2w, fov_deg, 8, slice(2, 5))
    assert np.allclose(rows, directions[2:5], rtol=0, atol=1e-15)


@given(angles)
def test_places_in_the_picture_invert_the_rays(fov_deg: float) -> None:
    c2w = look_at_c2w(eye=[1, 2, 3], target=[0, 0.5, 0], up=[0, 0, 1])
    c2w[:3, :3] *= 1 + 1e-5  # as far from a rotation as float32 poses that passed through files
    origin, rays = camera_rays(c2w, fov_deg, 7)
    row, column = np.indices((7, 7))
    centres = np.stack([column, row], axis=-1) + 0.5
    for distance in (0.1, 30):
        points = origin + distance * rays
        assert np.allclose(pixel_places(points, c2w, fov_deg, 7), centres, atol=1e-9)
        assert (in_camera(points, c2w)[..., 2] < 0).all()
    assert np.isnan(pixel_places(origin - rays, c2w, fov_deg, 7)).all()
    assert np.isnan(pixel_places(origin, c2w, fov_deg, 7)).all()


@given(st.floats(0, 6e4))
def test_the_output_space_is_inverted(radiance: float) -> None:
    # float64 rounding grows with the exponent: relative 1e-12 plus what 1 + L loses near 0
    assert np.isclose(radiance_from_log10(log10_radiance(radiance)), radiance, 1e-12, 1e-15)


def test_a_preview_is_monotone_ends_at_white_and_has_known_values() -> None:
    ramp = np.linspace(0, 2, 200)[:, None, None]
    preview = preview_srgb8(ramp).astype(int).ravel()
    assert preview[0] == 0
    assert (np.diff(preview) >= 0).all()
    assert (preview[100:] == 255).all()  # radiance 1 and above
    # 0.2140 is what IEC 61966-2-1 gives for code 127.5 of 255; the first piece ends at 0.0031308
    assert srgb8([-1, 0, 0.003, 0.2140, 1, 7]).tolist() == [0, 0, 10, 127, 255, 255]


def test_a_decade_is_zero_db_linear_sees_nothing_above_one_and_background_earns_nothing() -> None:
    assert psnr_log_db(np.full((4, 4, 3), 9.0), np.full((4, 4, 3), 99.0)) == pytest.approx(0)
    picture = np.random.default_rng(0).random((8, 8, 3)) * 10
    brighter = (1 + picture) * 10**0.1 - 1
    assert psnr_log_db(picture, brighter) == pytest.approx(20)
    assert psnr_log_db(picture, picture) == MAX_DB
    a, b = np.random.default_rng(1).random((2, 6, 6, 3)) * 100
    for psnr in (psnr_log_db, psnr_linear_db):
        assert psnr(a, b) == psnr(b, a)
    # Twelve and seven: one side clamped elsewhere would still pass with a value of 1 on the other.
    assert psnr_linear_db(np.full(9, 12.0), np.full(9, 7.0)) == MAX_DB
    assert psnr_linear_db(np.full(9, 0.5), np.full(9, 0.6)) == pytest.approx(20)
    hits = np.zeros((10, 10), bool)
    hits[0, 0] = True
    a, b = np.zeros((10, 10, 3)), np.zeros((10, 10, 3))
    b[0, 0] = 9
    assert object_psnr_log_db(a, b, hits) == pytest.approx(0)
    assert psnr_log_db(a, b) == pytest.approx(20)  # a hundredth of the pixels: 20 dB for nothing


def test_the_interval_of_a_mean_goes_by_clusters() -> None:
    """Ten scenes of which each has the same figure 8 times know no more than ten figures."""
    figures = [float(scene < 3) for scene in range(10) for _ in range(8)]
    clusters = [f"scene {scene}" for scene in range(10) for _ in range(8)]
    low, high = mean_interval(figures, clusters)
    alone_low, alone_high = mean_interval(figures, [str(n) for n in range(80)])
    assert low < alone_low < 0.3 < alone_high < high
    assert low == pytest.approx(0.3 - 1.96 * np.sqrt(0.3 * 0.7 / 10), abs=0.06)
    assert mean_interval([0.5] * 4, ["a", "a", "b", "b"]) == (0.5, 0.5)


def test_pepper_is_noise_and_not_a_smooth_error_and_seams_are_steps_between_tiles() -> None:
    ramp = np.linspace(0.2, 1.5, 64)
    picture = np.stack([ramp[:, None] * ramp] * 3, axis=-1)
    rng = np.random.default_rng(0)
    peppers = [
        pepper(
            radiance_from_log10(log10_radiance(picture) + rng.normal(0, rms, picture.shape)),
            picture,
        )
        for rms in (0.01, 0.02)
    ]
    assert 0.007 < peppers[0] < 0.01, "the standard deviation over nine pixels, of their mean"
    assert 1.9 < peppers[1] / peppers[0] < 2.1
    offset = radiance_from_log10(log10_radiance(picture) + 0.1)
    assert pepper(offset, picture) < 1e-6
    blurred = np.full_like(picture, picture.mean())
    assert pepper(blurred, picture) == 0
    noise = np.random.default_rng(0).normal(0, 0.01, picture.shape)
    noisy = radiance_from_log10(log10_radiance(picture) + noise)
    assert seam(noisy, picture) == pytest.approx(1, abs=0.05)
    for tile, steps in ((4, True), (8, True), (3, False)):
        number = np.arange(64) // tile
        tiles = ((number[:, None] + number) % 2)[..., None] * 0.02
        tiled = radiance_from_log10(log10_radiance(picture) + noise + tiles)
        assert (seam(tiled, picture) > 1.2) == steps, tile
    assert seam(picture, picture) == 1
    assert seam(noisy[:8, :8], picture[:8, :8]) > 0, "tiles of a pixel have nothing inside"


def test_the_floor_in_closed_form_emitters_are_hidden_and_normals_interpolated() -> None:
    slanted = np.tile(np.array([0, 0, 1], np.float32), (7, 1))
    slanted[0] = [0.6, 0, 0.8]
    scene = from_above(4, 40, vertex_normals=slanted)  # the lamp is before the floor
    hit = first_hits(scene, resolution=9, pixel=(4, 4))
    assert hit.object == 0
    assert hit.depth_m == pytest.approx(4, abs=1e-9)
    corner = first_hits(scene, resolution=64, pixel=(50, 18))
    shares = corner.barycentric[..., None] * slanted[scene.faces[corner.triangle]]
    expected = shares.sum(axis=-2) / np.linalg.norm(shares.sum(axis=-2))
    np.testing.assert_allclose(corner.shading_normal, expected, rtol=1e-6)
    assert corner.shading_normal[0] > 0.05
    scene = from_above()
    hits = first_hits(scene, resolution=4)
    _, rays = camera_rays(scene.c2w[0], 90, 4)
    assert hits.met.all()  # the lamp hangs behind the camera; the picture is the floor exactly
    np.testing.assert_allclose(hits.depth_m, -1 / rays[..., 2], rtol=1e-12)
    np.testing.assert_allclose(hits.position[0, 0], [-0.75, 0.75, 0], atol=1e-12)
    np.testing.assert_array_equal(hits.geometric_normal, np.broadcast_to([0, 0, 1], (4, 4, 3)))
    np.testing.assert_array_equal(hits.object, 0)
    np.testing.assert_array_equal(hits.material, np.broadcast_to(scene.materials[0], (4, 4, 10)))


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


def test_rays_meet_both_sides_up_to_their_length_also_where_lights_stand_first_or_alone() -> None:
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
    surfaces = Surfaces(join([light([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], 1.0)]))
    origin = np.array([[0, 1, 0]], np.float32)
    toward = np.array([[0, -1, 0]], np.float32)
    assert surfaces.intersect(origin, toward).triangle.tolist() == [MISS]
    assert surfaces.is_free(origin, toward, np.array([9], np.float32)).all()
