"""Normal maps in the kernel: frames and energy; test_twin_tracers has Mitsuba's `normalmap`."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.tracer import load_tracer
from scene_templates.rotations import uniform_rotation
from storage.raycast.first_hits import first_hits
from storage.records.lookup import FLAT, LEAST_Z, mapped_normals, u_directions
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.pipeline.renders.sampling import (
    camera_of,
    lambert_irradiance,
)
from tests.pipeline.renders.scene_kit import (
    SKY_LAMP,
    furnace,
    join,
    light,
    mapped,
    material,
    noise_map,
    sphere,
    textured_floor,
)
from tests.rigid_motion import moved
from tests.textured_by_hand import bumps

pytestmark = pytest.mark.usefixtures("llvm")


def one_slope(normal: NDArray[np.float64]) -> Texture:
    return Texture(texels=((normal + 1) / 2).astype(np.float32)[None, None])


def test_a_flat_map_is_none_in_every_bit_and_flat_texels_change_nothing() -> None:
    row = material(diffuse=[0.2, 0.4, 0.3], specular=0.4, roughness=0.3)
    parts = [textured_floor(row), sphere([0.1, 0, 0.4], 0.3, row, 6), SKY_LAMP]
    flat = np.tile(np.array(FLAT, np.float32), (8, 8, 1))
    edge = flat.copy()
    edge[:, 0] = 0.9, 0.5, 0.8  # where nothing lies
    plain = join(parts, eye=(0, -0.02, 4), fov_deg=30)
    np.testing.assert_array_equal(_traced(mapped(parts, Texture(texels=flat))), _traced(plain))
    away = mapped(parts, Texture(texels=edge), 0.2 * np.eye(2))
    assert away.uv is not None and away.material_textures is not None
    colours = away.material_textures.copy()
    colours[0, 0] = 1
    bumpy = dataclasses.replace(
        away,
        uv=away.uv + np.float32(0.5),
        textures=(*away.textures, noise_map(1, 3, 0.1, 0.5)),
        material_textures=colours,
    )
    smooth = dataclasses.replace(bumpy, normal_textures=None)
    assert np.abs(_traced(bumpy) - _traced(smooth)).max() < 1e-6


def _traced(scene: Scene) -> NDArray[np.float32]:
    tracer = load_tracer(scene, max_depth=5, rr_depth=3)
    return tracer.radiance(camera_of(scene, 16), seed=3, spp=16)


@pytest.mark.parametrize("turned", [False, True])
def test_a_slope_reflects_what_a_tilted_plane_does(turned: bool) -> None:
    """By Lambert's formula, above the horizons of both; u and v may go anywhere on the floor."""
    slope = np.array([0.5, -0.3, 0.0])
    slope[2] = np.sqrt(1 - slope @ slope)
    lamp = np.array([[1.0, -1.5, 3.0], [1.6, -1.5, 3.0], [1.2, -1.0, 3.2]])
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]]) if turned else None  # u grows with y, v against x
    scene = mapped(
        [textured_floor(material(diffuse=[0.6, 0.5, 0.4])), light(lamp, 30.0)],
        one_slope(slope),
        turn,
    )
    normal = np.array([-slope[1], slope[0], slope[2]]) if turned else slope
    hits = first_hits(scene, resolution=16)
    assert np.allclose(hits.shading_normal[hits.met], normal, atol=1e-6)
    shown = load_tracer(scene, max_depth=2, rr_depth=5).radiance(
        camera_of(scene, 16), seed=1, spp=256
    )
    points = hits.position[hits.met]
    wanted = lambert_irradiance(points, normal, lamp, 30.0)[:, None] * [0.6, 0.5, 0.4] / np.pi
    error = (shown[hits.met] / wanted - 1).mean(axis=0)
    assert np.abs(error).max() < 0.005, error


@pytest.mark.parametrize("columns", [{"diffuse": 1.0}, {"specular": 1.0, "roughness": 0.3}])
def test_a_white_furnace_gets_no_brighter_and_nothing_black(columns: dict[str, float]) -> None:
    """A lobe around a normal t off loses what lies below the floor: diffuse (1 + cos t) / 2."""
    map_ = bumps(3, 3.0)
    scene = mapped([textured_floor(material(**columns)), furnace()], map_)
    tracer = load_tracer(scene, max_depth=6, rr_depth=5)
    camera = dataclasses.replace(camera_of(scene, 16), c2w=_from_the_side())
    shown = tracer.radiance(camera, seed=1, spp=256)[tracer.hits(camera)]
    assert np.isfinite(shown).all()
    assert shown.max() < 1 + 1e-3 if "diffuse" in columns else shown.max() < 1.05
    assert shown.min() > (0.25 if "diffuse" in columns else 0.15)  # half of it at the rim
    if "diffuse" in columns:
        above = camera_of(scene, 16)
        seen = tracer.radiance(above, seed=1, spp=256)[2:-2, 2:-2]
        cosine = first_hits(scene, resolution=64).shading_normal[8:-8, 8:-8, 2]
        assert abs(seen.mean() - np.mean((1 + cosine) / 2)) < 0.01


def _from_the_side() -> NDArray[np.float64]:
    scene = join([textured_floor(material()), SKY_LAMP], eye=(0.3, -3.0, 0.7), fov_deg=30)
    pose: NDArray[np.float64] = scene.c2w[0].astype(np.float64)
    return pose


def test_guides_and_passes_are_the_definition_and_turn_with_the_scene() -> None:
    """On a ball, mirrored coordinates and all; where u has no direction, the normal stays."""
    row = material(diffuse=0.5, roughness=0.5)
    for turn in (None, np.diag([-1.0, 1.0]), np.zeros((2, 2))):
        scene = mapped([sphere([0, 0, 0], 0.8, row, 9), SKY_LAMP], bumps(5, 1.0), turn)
        tracer = load_tracer(scene, max_depth=2, rr_depth=5)
        guide = tracer.features(camera_of(scene, 32), spp=1).normal
        hits = first_hits(scene, resolution=32)
        off = np.linalg.norm(np.nan_to_num(hits.shading_normal) - guide, axis=-1)
        assert np.mean(off > 1e-3) < 0.02  # texels' borders, and the ball's
        kept = view_passes(scene, ["shading_normal"], resolution=32)["shading_normal"]
        assert np.array_equal(kept, hits.shading_normal, equal_nan=True)
        smooth = dataclasses.replace(scene, normal_textures=None)
        bent = np.nan_to_num(first_hits(smooth, resolution=32).shading_normal) - guide
        assert (np.abs(bent).max() > 0.3) == (turn is None or turn.any())
        rotation = uniform_rotation(np.random.default_rng(1))
        there = first_hits(moved(scene, rotation, [0.3, -0.2, 0.1]), resolution=32)
        back = np.nan_to_num(there.shading_normal) @ rotation
        assert np.mean(np.linalg.norm(back - guide, axis=-1) > 1e-3) < 0.03


def test_frames_without_a_direction_and_odd_texels_leave_unit_normals() -> None:
    up = np.array([[0.0, 0, 1]] * 5)
    directions = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0]])
    texels = np.array([[1, 0.5, 0.5], [1, 1, 1], [1, 1, 1], [0.5, 0.5, 0.5], [0.5, 0.5, 0.0]])
    found = mapped_normals(up, directions, texels)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.array_equal(found[1:], up[1:])
    assert np.allclose(found[0], [1, 0, LEAST_Z], atol=1e-4)
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 4, np.float64)
    uv = np.array(
        [
            [[0, 0], [1, 0], [0, 1]],
            [[0, 0], [-1, 0], [0, 1]],
            [[0, 0]] * 3,
            [[0, 0], [1, 1], [2, 2]],
        ],
        np.float64,
    )
    wanted = [[1, 0, 0], [-1, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert np.allclose(u_directions(corners, uv), wanted)
    assert np.array_equal(u_directions(np.full_like(corners, np.nan), uv), np.zeros((4, 3)))
