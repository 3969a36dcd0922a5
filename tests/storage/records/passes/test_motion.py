"""Motion in pixels: between two cameras, two moments, and of scenes that do not fit."""

import dataclasses

import numpy as np
import pytest

from storage.conventions import look_at_c2w, pixel_places
from storage.errors import TrilightError
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene
from tests.scenes_by_hand import tiny_scene
from tests.storage.records.passes.view_kit import from_above, room


def test_nothing_moves_where_nothing_changes() -> None:
    scene = room(0)
    seen = view_passes(scene, resolution=16, then=scene)
    np.testing.assert_allclose(seen["motion_px"][seen["hit"]], 0, atol=1e-9)
    assert np.isnan(seen["motion_px"][~seen["hit"]]).all()


def test_a_camera_that_steps_aside_in_closed_form() -> None:
    """At fov 90 and 1 m, 16 pixels are 2 m: a step of 0.25 m to the right moves all left by 2."""
    scene = from_above(height=1, fov_deg=90)
    poses = np.concatenate([scene.c2w, scene.c2w])
    poses[1, :3, 3] += [0.25, 0.125, 0]  # right and up in the picture
    both = scene.with_cameras(poses, np.array([90, 90], np.float32))
    for a_side in (1, 2):
        motion = view_passes(both, ["motion_px"], resolution=16, rays_a_side=a_side, then_view=1)
        expected = np.broadcast_to([-2.0, 1.0], (16, 16, 2))
        np.testing.assert_allclose(motion["motion_px"], expected, atol=1e-6)


def test_it_is_the_difference_of_projections() -> None:
    scene = room(1)
    seen = view_passes(scene, resolution=24, view=0, then_view=1)
    now, then = (
        pixel_places(seen["position_m"], scene.c2w[view], float(scene.fov_deg[view]), 24)
        for view in (0, 1)
    )
    np.testing.assert_allclose(seen["motion_px"], then - now, atol=1e-6)


def test_points_are_followed_by_their_triangles() -> None:
    """The floor slides by 0.5 m to the right, which is 4 of 16 pixels."""
    scene = from_above(height=1, fov_deg=90)
    moved = scene.vertex_positions.copy()
    moved[:4, 0] += 0.5
    later = dataclasses.replace(scene, vertex_positions=moved)
    motion = view_passes(scene, ["motion_px"], resolution=16, then=later)["motion_px"]
    np.testing.assert_allclose(motion, np.broadcast_to([4.0, 0.0], (16, 16, 2)), atol=1e-6)


def test_what_is_behind_the_other_camera_does_not_move() -> None:
    scene = from_above()
    up = look_at_c2w(eye=[0, 0, 1], target=[0, 0, 2], up=[0, 1, 0])[None].astype(np.float32)
    later = scene.with_cameras(up, scene.fov_deg)
    seen = view_passes(scene, resolution=4, rays_a_side=2, then=later)
    assert seen["hit"].all() and np.isnan(seen["motion_px"]).all()


def test_other_triangles_are_refused() -> None:
    scene = tiny_scene()
    with pytest.raises(TrilightError, match=r"2 triangles; expected the 3 of this one"):
        view_passes(scene, then=_first_triangles(2))
    turned = dataclasses.replace(scene, faces=scene.faces[:, [1, 2, 0]])
    with pytest.raises(TrilightError, match=r"faces\[0\] .* \[1, 2, 0\]; expected \[0, 1, 2\]"):
        view_passes(scene, then=turned)


def _first_triangles(count: int) -> Scene:
    scene = tiny_scene()
    return dataclasses.replace(
        scene,
        faces=scene.faces[:count],
        material_index=scene.material_index[:count],
        object_index=scene.object_index[:count],
    )
