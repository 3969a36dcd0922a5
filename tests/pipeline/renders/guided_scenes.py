"""Scenes in which mirrors light rough surfaces, so that path guiding has something to learn."""

import functools

import numpy as np

from storage.records.scene import Scene
from tests.pipeline.renders.scene_kit import box, flat, join, light, material, quad, sphere

FLOOR = [[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]]
WALL = [[-1.5, 1.5, 0], [1.5, 1.5, 0], [1.5, 1.5, 2], [-1.5, 1.5, 2]]
LAMP = [[0.8, 0.3, 1.3], [1.2, 0.3, 1.3], [0.9, 0.7, 1.4]]


def mirrors(roughness: float = 0.3) -> Scene:
    """A mirror shows a matt floor on which metal throws light."""
    metal = material(specular=[0.9, 0.8, 0.7], roughness=roughness)
    parts = [
        quad(FLOOR, material(diffuse=0.6, specular=0.2, roughness=0.5)),
        quad(np.subtract(WALL, [0, 0.3, 0]), material(specular=0.9, roughness=0.2)),
        box([0.4, -0.2, 0.4], 0.5, metal, 0.4),
        sphere([-0.4, 0.2, 0.3], 0.25, metal, 6),
        light(LAMP, 30.0, 0.5),
    ]
    return join(parts, eye=(0.3, -2.4, 1.0), target=(0, 0.6, 0.4), fov_deg=50)


@functools.cache
def lit_by_a_mirror(size: float, roughness: float = 0.3) -> Scene:
    """A lamp of so many metres in a black box, which is open towards a mirror.

    Floor and walls are matt, and all light on them came from the mirror. So both hits of camera
    paths and light paths have a large part of it: what one of them takes for the density of the
    other shows in the mean.
    """
    centre, matt = np.array([-0.9, 0, 0.8]), material(diffuse=0.8)
    shade = box([0, 0, 0], 1.0, material()).triangles
    open_shade = shade[shade.mean(axis=1)[:, 0] < 0.49] * [0.21, 1.2 * size, 1.2 * size]
    mirror = [[1.2, -0.6, 0.2], [1.2, 0.6, 0.2], [1.2, 0.6, 1.4], [1.2, -0.6, 1.4]]
    lamp = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0, 0.5]]) * size
    parts = [
        quad(FLOOR, matt),
        quad(WALL, matt),
        quad([[-1.5, -1.5, 0], [-1.5, 1.5, 0], [-1.5, 1.5, 2], [-1.5, -1.5, 2]], matt),
        quad(mirror, material(specular=0.95, roughness=roughness)),
        flat(open_shade + centre + [0.095, 0, 0], material(), "shell"),
        light(lamp + centre, 200.0),
    ]
    return join(parts, eye=(-0.2, -3.2, 1.2), target=(0, 0.6, 0.6), fov_deg=45)
