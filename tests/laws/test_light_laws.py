"""Light does what it must: closed forms, superposition, two sides, hidden emitters, skies."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.tracer import load_tracer
from storage.conventions import camera_rays
from storage.records.lookup import environment_values
from storage.records.passes import view_passes
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import (
    SIGMAS,
    assert_agree,
    camera_of,
    exact,
    lambert_irradiance,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import (
    box,
    furnace,
    furniture,
    join,
    light,
    material,
    open_scene,
    quad,
    sphere,
)
from tests.sky_maps import COLOURS, POLES, constant, six_poles, smooth

pytestmark = pytest.mark.usefixtures("llvm")

LIGHT = np.array([[-0.3, -0.2, 1.0], [0.4, -0.1, 1.2], [0.0, 0.5, 0.9]])
FLOOR = [[-12, -12, 0], [12, -12, 0], [12, 12, 0], [-12, 12, 0]]
DIFFUSE = 0.7
BOWL_RINGS = 48


def _traced(scene: Scene, *, px: int = 16, max_depth: int = 10) -> NDArray[np.float32]:
    tracer = load_tracer(scene, max_depth=max_depth, rr_depth=5)
    return tracer.radiance(camera_of(scene, px), seed=1, spp=16)


def _lit_floor(triangle: NDArray, radiance: float = 5.0) -> Scene:
    floor = quad(FLOOR, material(diffuse=DIFFUSE))
    return join([floor, light(triangle, radiance)], eye=(0, -2, 1.5), fov_deg=50)


def _floor_points(scene: Scene, resolution: int) -> NDArray[np.float64]:
    """Return what the middles of pixels see of the floor, [resolution^2, 3]."""
    origin, directions = camera_rays(scene.c2w[0], float(scene.fov_deg[0]), resolution)
    points: NDArray[np.float64] = origin - directions * (origin[2] / directions[..., 2:])
    return points.reshape(-1, 3)


def test_a_lit_plane_is_as_bright_as_lamberts_formula_says() -> None:
    """Also the law of two-sided emission: either winding lights the floor equally."""
    scene = _lit_floor(LIGHT)
    expected = lambert_irradiance(_floor_points(scene, 512), np.array([0, 0, 1.0]), LIGHT, 5.0)
    radiance = (expected * DIFFUSE / np.pi).reshape(8, 64, 8, 64).mean(axis=(1, 3))
    # 64 x 64 midpoints of a block integrate so smooth a function to 1e-4.
    closed_form = exact(np.repeat(radiance[..., None], 3, axis=-1))
    for winding in (1, -1):
        shown = render_blocks(_lit_floor(LIGHT[::winding]), max_depth=2)
        assert_agree(shown, closed_form, slack=5e-4)


def test_unequal_lights_add_up_as_lamberts_formula_says() -> None:
    """Picked by power from 32 of them, of areas 1 : 100, brightness 1 : 1000, either way up.

    They lie side by side in one plane, so that none shades another.
    """
    count, rng = 32, np.random.default_rng(32)
    cells = rng.permutation([[x, y, 2.0] for x in range(-3, 3) for y in range(-2, 4)])[:count]
    shape = rng.uniform(-0.4, 0.4, (count, 3, 2)) * 10 ** rng.uniform(-1, 0, (count, 1, 1))
    lights = cells[:, None] + np.concatenate([shape, np.zeros((count, 3, 1))], axis=2)
    radiances = 10 ** rng.uniform(-1, 2, (count, 3))
    floor = quad(FLOOR, material(diffuse=DIFFUSE))
    parts = [light(*pair) for pair in zip(lights, radiances, strict=True)]
    scene = join([floor, *parts], eye=(0, -2, 1.5), fov_deg=50)
    points = _floor_points(scene, 128)
    up = np.array([0, 0, 1.0])
    expected = sum(
        lambert_irradiance(points, up, corners, 1.0)[:, None] * radiance
        for corners, radiance in zip(lights, radiances, strict=True)
    )
    blocks = (expected * DIFFUSE / np.pi).reshape(8, 16, 8, 16, 3).mean(axis=(1, 3))
    # As below, with coarser midpoints, and the stock emitters' twins stand 1e-4 off.
    estimate = render_blocks(scene, max_depth=2)
    assert_agree(estimate, exact(blocks), slack=2e-3)


def test_light_scales_exactly() -> None:
    """Twice the radiance is twice the picture, bit for bit: no clamp, no absolute threshold."""

    def room(strength: float) -> Scene:
        lamps = [light(LIGHT, 4 * strength), light(LIGHT + np.array([1, 0, 0.5]), strength)]
        return join([*furniture(), *lamps], eye=(0.5, -1.7, 0.6), fov_deg=45)

    once, twice = (_traced(room(factor)) for factor in (1.0, 2.0))
    assert once.max() > 0
    np.testing.assert_array_equal(twice, 2 * once)


def test_an_emitter_is_hidden_from_the_camera_but_seen_in_a_mirror() -> None:
    radiance = 3.0
    mirror = quad(FLOOR, material(specular=1.0, roughness=0.01))
    panel = [[-0.5, 1.0, 0.5], [0.5, 1.0, 0.5], [0.0, 1.0, 1.5]]
    scene = join([mirror, light(panel, radiance)], eye=(0, -2, 1), target=(0, 1, 0), fov_deg=70)
    tracer = load_tracer(scene, max_depth=3, rr_depth=5)
    camera = camera_of(scene, 64)
    picture = np.mean([tracer.radiance(camera, seed=k, spp=64) for k in range(4)], axis=0)

    def pixel(point: list[float]) -> tuple[int, int]:
        local = np.linalg.inv(scene.c2w[0].astype(np.float64)) @ [*point, 1.0]
        at = 32 + 32 / np.tan(np.radians(35)) * np.array([-local[1], local[0]]) / -local[2]
        return int(at[0]), int(at[1])

    direct, mirrored = pixel([0, 1, 0.9]), pixel([0, 1, -0.9])
    np.testing.assert_array_equal(picture[direct], 0)
    assert not tracer.hits(camera)[direct]
    np.testing.assert_array_equal(tracer.features(camera, spp=16).albedo[direct], 0)
    # A mirror of roughness 0.01 loses nothing and blurs by 1e-4: the panel shows as it is.
    np.testing.assert_allclose(picture[mirrored], radiance, rtol=5e-3)


@pytest.mark.parametrize(("albedo", "bounces", "rr_depth"), [(1, 1, 5), (1, 6, 5), (0.8, 59, 1)])
def test_a_bowl_fills_with_light_bounce_by_bounce(
    albedo: float, bounces: int, rr_depth: int
) -> None:
    """A half sphere sees half of itself from everywhere: radiance 1 - 0.5^n after n bounces.

    Every point of a sphere sees equal areas of it equally, so the form factor of the bowl to
    itself is 1 - aperture / area everywhere, and the light inside is uniform. With roulette from
    the first edge on, which takes and gives equally, it is as bright as its series says.
    """
    whole = sphere([0, 0, 0], 1.0, material(diffuse=albedo), rings=BOWL_RINGS)
    below = (whole.triangles[..., 2] < 1e-9).all(axis=1)
    corners = whole.triangles[below]
    bowl = dataclasses.replace(whole, triangles=corners, normals=whole.normals[below])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1).sum()
    aperture = BOWL_RINGS * np.sin(np.pi / BOWL_RINGS)  # the rim: a polygon of 2 * rings corners
    to_itself = 1 - aperture / area
    series = sum((albedo * to_itself) ** k for k in range(bounces))
    expected = albedo * (1 - to_itself) * series
    if albedo == 1:
        assert abs(expected - (1 - 0.5**bounces)) < 2e-3  # the mesh is a little off the sphere
    scene = join([bowl, furnace()], eye=(0, 0.01, 2.5), target=(0, 0, -1), fov_deg=16)
    depths = {"max_depth": bounces + 1, "rr_depth": rr_depth}
    estimate = render_blocks(scene, resolution=16, block=16, passes=16, **depths)
    assert (SIGMAS * estimate.error < 0.02 * estimate.mean).all()  # small enough to tell
    # The facets make the light uneven by some 1e-3.
    assert_agree(estimate, exact(np.full((1, 1, 3), expected)), slack=3e-3)


@pytest.mark.parametrize("shape", [sphere, box])
def test_white_and_convex_things_vanish_in_a_white_sky(shape: Any) -> None:
    """The furnace: radiance 1 from everywhere, and a Lambert surface of albedo 1 sends out 1."""
    thing = shape([0, 0, 0], 0.5, material(diffuse=1.0))
    scene = join([thing], eye=(0.4, -2, 0.7), fov_deg=30, sky=constant(1.0))
    loaded = load_tracer(scene, max_depth=6, rr_depth=5)
    camera = camera_of(scene, 16)
    covered = loaded.features(camera, spp=64).albedo
    inside = covered.min(axis=-1) > 0.999
    pictures = np.array([loaded.radiance(camera, seed=k, spp=64) for k in range(4)])
    found = pictures.mean(axis=0)[inside]
    error = pictures.std(axis=0, ddof=1)[inside] / 2
    assert inside.sum() > 20
    # Where shading normals lean over the facets of a ball, light is lost: measured 0.3 %.
    assert abs(found.mean() - 1) < 0.005
    assert (abs(found - 1) < 5 * error + 0.01).all()
    seen = dataclasses.replace(scene, environment=constant(1.0, is_seen=True))
    picture = load_tracer(seen, max_depth=6, rr_depth=5).radiance(camera, seed=9, spp=64)
    assert abs(picture.mean() - 1) < 0.005
    # Samples are jittered: some meet a rim that the even rays have missed.
    assert np.abs(picture[covered.max(axis=-1) == 0] - 1).max() < 0.05


def test_a_mirror_shows_each_pole_in_its_place() -> None:
    """A ball, seen along each axis from outside, shows in its middle what is behind the viewer."""
    rotation = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
    sky = six_poles(rotation=rotation)
    ball = sphere([0, 0, 0], 0.5, material(specular=1.0, roughness=0.01), rings=48)
    for name, pole in POLES.items():
        eye = 3 * (rotation @ np.array(pole, np.float64)) + np.array([1e-3, 2e-3, 3e-3])
        scene = join([ball], eye=eye, fov_deg=0.5, sky=sky)
        picture = _traced(scene, px=8, max_depth=3)
        # The albedo tables of energy compensation are right to 0.1 %, and 1024 samples find all.
        assert picture.mean(axis=(0, 1)) == pytest.approx(COLOURS[name], rel=0.01), name


def test_a_black_sky_is_none() -> None:
    """To the last bit: the kernel is the one without a sky."""
    without = _traced(open_scene(None))
    for black in (constant(0.0), constant(0.0, is_seen=True)):
        np.testing.assert_array_equal(_traced(open_scene(black)), without)


def test_a_seen_sky_stands_behind_everything() -> None:
    hidden, seen = (open_scene(smooth(64, is_seen=flag)) for flag in (False, True))
    camera = camera_of(hidden, 64)
    loaded = [load_tracer(scene, max_depth=3, rr_depth=5) for scene in (hidden, seen)]
    # where surfaces cover nothing of a pixel, nor of its neighbours
    covered = loaded[0].features(camera, spp=64).albedo.any(axis=-1)
    wide = np.pad(covered, 1)
    around = np.array([wide[i : i + 64, j : j + 64] for i in range(3) for j in range(3)])
    empty, inside = ~around.any(axis=0), around.all(axis=0)
    without, with_sky = (one.radiance(camera, seed=1, spp=64) for one in loaded)
    assert empty.sum() > 500 and (without[empty] == 0).all()
    _, rays = camera_rays(hidden.c2w[0], float(hidden.fov_deg[0]), 64)
    assert hidden.environment is not None
    expected = environment_values(hidden.environment, rays)
    # A pixel is 0.8 degrees wide, over which this sky changes by 1 % at most.
    assert np.abs(with_sky[empty] / expected[empty] - 1).max() < 0.01
    # The same samples of the same light; a few of these pixels have a silhouette through them.
    assert abs(with_sky[inside].mean() / without[inside].mean() - 1) < 0.02
    # The pass `coverage` is the alpha of the hidden picture, whoever sees the sky: the map below it
    # is the seen one. Silhouettes are met by 64 jittered rays here and by 64 even ones there.
    alpha, same = (
        view_passes(scene, ["coverage"], view=0, resolution=64, rays_a_side=8)["coverage"]
        for scene in (hidden, seen)
    )
    np.testing.assert_array_equal(alpha, same)
    below = without + (1 - alpha.reshape(64, 64, 1)) * expected
    assert np.abs(below - with_sky).mean() < 0.01 * with_sky.mean()
