"""Rays among the triangles of a scene: what they meet, and that they meet nothing else."""

import numpy as np

from tests.model.hits.kit import FLOOR, WALL, lit_scene
from tests.pipeline.renders.scene_kit import join, material, quad
from tests.sky_maps import constant


def test_a_ray_towards_a_triangle_meets_it_and_others_meet_nothing() -> None:
    """From just above the middle of each triangle, down to it and up to the sky."""
    parts = [quad(FLOOR, material()), quad(WALL, material())]
    scene = lit_scene(join(parts, eye=(0, -3, 1), sky=constant(1.0)))
    towards = -scene.plane
    start = scene.corners.mean(axis=0) - np.float32(1e-3) * towards
    points, met = scene.meet(scene.everything, start, towards)
    assert met.all() and points.triangle.tolist() == list(range(scene.num_triangles))
    up = np.zeros_like(start) + np.array([[0], [0], [1]], np.float32)
    _, met = scene.meet(scene.everything, start, up)
    assert not met.any()
