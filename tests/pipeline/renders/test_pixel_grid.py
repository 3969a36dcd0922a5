"""The rays of the renderer are those of storage.conventions: the same pixel sees the same thing."""

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from storage.conventions import camera_rays
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import flat, join, light, material, quad, sampled_like_scene


def _slow_hits(scene: Scene, view: int, resolution: int) -> NDArray[np.bool_]:
    """Every ray against every triangle in float64 (Moeller and Trumbore)."""
    rows = scene.faces[~scene.triangle_emits]
    corners = scene.vertex_positions[rows].astype(np.float64)
    origin, directions = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    to_origin = origin - corners[:, 0]
    found = np.zeros(resolution**2, bool)
    for index, direction in enumerate(directions.reshape(-1, 3)):
        side = np.cross(direction, edge2)
        determinant = (edge1 * side).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (to_origin * side).sum(1) / determinant
            other = np.cross(to_origin, edge1)
            v = (other @ direction) / determinant
            t = (edge2 * other).sum(1) / determinant
        found[index] = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any()
    return found.reshape(resolution, resolution)


def test_hits_are_those_of_a_slow_ray_caster() -> None:
    for seed in range(3):
        scene = sampled_like_scene(np.random.default_rng(seed), num_views=2)
        tracer = load_tracer(scene, max_depth=2, rr_depth=5)
        for view in range(2):
            expected = _slow_hits(scene, view, 24)
            assert 0 < expected.sum() < expected.size
            # Float32 rays may pass an edge on the other side where the float64 ray grazes it.
            assert (tracer.hits(camera_of(scene, 24, view)) != expected).sum() <= 1


def test_a_lit_square_covers_the_pixels_that_it_should() -> None:
    """Edges on pixel borders: inside fully lit, outside exactly black, nothing mirrored."""
    resolution, distance = 16, 2.0
    unit = 2 * np.tan(np.radians(20)) * distance / resolution  # one pixel at the square's depth
    left, right, top, bottom = 3, 7, 2, 10  # in pixels from the top left corner
    x0, x1 = (unit * (column - resolution / 2) for column in (left, right))
    z0, z1 = (unit * (resolution / 2 - row) for row in (bottom, top))
    square = quad([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]], material(diffuse=1))
    lamp = light([[-50, -30, -30], [50, -30, -30], [0, -30, 60]], 1.0)
    scene = join([square, lamp], eye=(0, -distance, 0), fov_deg=40)
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    camera = camera_of(scene, resolution)
    expected = np.zeros((resolution, resolution), bool)
    expected[top:bottom, left:right] = True
    picture = tracer.radiance(camera, seed=0, spp=64)
    features = tracer.features(camera, spp=64)
    np.testing.assert_array_equal(tracer.hits(camera), expected)
    # A sample within a float32 rounding of a border may fall on its other side.
    np.testing.assert_allclose(features.albedo[..., 0], expected, atol=0.02)
    np.testing.assert_allclose(features.normal, expected[..., None] * [0, -1, 0], atol=0.02)
    assert (picture[expected] > 0.2).all()
    assert (picture[~expected] < 0.02).all()


def test_emitters_are_invisible_to_the_auxiliary_pictures() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    in_front = flat([[[-1, -1, 0.5], [1, -1, 0.5], [0, 1, 0.5]]], material(emission=1), "emitter")
    lamp = light([[-1, -1, 3], [1, -1, 3], [0, 1, 3]], 1.0)
    pictures = [
        load_tracer(join(parts, eye=(0, -0.1, 2)), max_depth=2, rr_depth=5)
        for parts in ([floor, lamp], [floor, lamp, in_front])
    ]
    camera = camera_of(join([floor, lamp], eye=(0, -0.1, 2)), 16)
    without, with_emitter = (tracer.features(camera, spp=16) for tracer in pictures)
    np.testing.assert_array_equal(without.albedo, with_emitter.albedo)
    np.testing.assert_array_equal(without.normal, with_emitter.normal)
    np.testing.assert_array_equal(pictures[0].hits(camera), pictures[1].hits(camera))
