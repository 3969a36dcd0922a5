"""Rays on the surfaces of a scene, where the answers are known by hand."""

import numpy as np

from storage.records.surfaces import MISS, Surfaces
from tests.pipeline.renders.scene_kit import join, light
from tests.scenes_by_hand import tiny_scene

DOWN = np.array([[0, 0, -1]], np.float32)


def test_rays_from_both_sides_and_past_the_floor() -> None:
    origins = np.array([[0.5, -0.2, 3], [0.5, -0.2, -3], [5, 0, 3]], np.float32)
    met = Surfaces(tiny_scene()).met(origins, np.array([[0, 0, -2], [0, 0, 1], [0, 0, -1]], "f4"))
    assert met.triangle.tolist() == [0, 0, MISS]
    # in lengths of the direction; processors of other vector widths round the last bits otherwise
    np.testing.assert_allclose(met.distance_m[:2], [1.5, 3], rtol=4 * 2**-23)
    assert (met.normal[:2, 2] > 0).all() and not met.normal[:2, :2].any()


def test_rows_are_those_of_the_scene_where_lights_stand_first() -> None:
    scene = tiny_scene()
    order = [2, 0, 1]
    moved = tiny_scene(
        faces=scene.faces[order],
        material_index=scene.material_index[order],
        object_index=scene.object_index[order],
    )
    above = np.array([[0, 0, 3], [0.5, -0.2, 3], [-0.5, 0.2, 3]], np.float32)
    met = Surfaces(moved).met(above, np.repeat(DOWN, 3, axis=0))
    assert met.triangle[1:].tolist() == [1, 2]
    assert met.triangle[0] in (1, 2), "the lamp lets rays pass"


def test_what_is_free() -> None:
    origins = np.repeat(np.array([[0.5, -0.2, 3]], np.float32), 3, axis=0)
    free = Surfaces(tiny_scene()).is_free(
        origins, np.repeat(DOWN, 3, axis=0), np.array([2.9, 3.1, 1e9], np.float32)
    )
    assert free.tolist() == [True, False, False]


def test_lights_alone() -> None:
    surfaces = Surfaces(join([light([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], 1.0)]))
    origin = np.array([[0, 1, 0]], np.float32)
    toward = np.array([[0, -1, 0]], np.float32)
    assert surfaces.met(origin, toward).triangle.tolist() == [MISS]
    assert surfaces.is_free(origin, toward, np.array([9], np.float32)).all()
