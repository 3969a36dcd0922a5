"""Renders obey physics: surfaces reflect what their ten numbers say, and motion changes nothing.

Energy, the furnace, two sides, mixed lobes. Seeing and rendering commute with rigid motion, with a
mirror and an exchange of channels. What networks are told of light is what the path tracer finds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from model.hits.view_inputs import Channel
from pipeline.renders import surface_table
from pipeline.renders.tracer import load_tracer
from pipeline.scenes.views import Visibility
from scene_templates.rotations import uniform_rotation
from storage.conventions import alpha_ggx
from storage.optics import MIN_ALPHA, bsdf_lobes, scattered_again
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import Scene
from storage.records.texture import Environment
from tests.model.hits.kit import corner, direct, traced
from tests.oracle.plugin_scene import scaled_albedos
from tests.pipeline.renders.sampling import (
    Estimate,
    assert_agree,
    blocks_of,
    camera_of,
    exact,
    lambert_irradiance,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import (
    bumpy_room,
    flat,
    furnace,
    join,
    light,
    material,
    open_scene,
    quad,
    sampled_like_scene,
    sphere,
)
from tests.scenes_by_hand import mirrored, moved
from tests.sky_maps import night, one_sun, smooth
from tests.storage.test_optics import slow_albedo


def _albedo(row: NDArray, cos_in: float) -> NDArray[np.float64]:
    """Directional albedo [3] by brute force and by the formula of storage.optics."""
    alpha = max(float(alpha_ggx(row[6])), MIN_ALPHA)
    single = slow_albedo(cos_in, alpha, "correlated")
    again = scattered_again(row[None, 3:6], np.array([alpha]), "correlated")[0]
    total: NDArray[np.float64] = row[0:3] + row[3:6] * (single + again * (1 - single))
    return total


def _furnace_plate(row: NDArray, cos_view: float) -> Scene:
    eye = 3 * np.array([0.0, -np.sqrt(1 - cos_view**2), cos_view])
    plate = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], row)
    return join([plate, furnace()], eye=eye, fov_deg=0.5)


@pytest.mark.parametrize(
    ("roughness", "cos_view"), [(0.01, 0.3), (0.1, 0.95), (0.4, 0.3), (1.0, 0.95), (1.0, 0.3)]
)
def test_a_plate_in_a_furnace_returns_directional_albedo(roughness: float, cos_view: float) -> None:
    """Each channel of a coloured mirror loses its own share at every further reflection."""
    row = material(diffuse=[0.2, 0, 0.1], specular=[0.75, 1.0, 0.1], roughness=roughness)
    expected = _albedo(row, cos_view)
    estimate = render_blocks(_furnace_plate(row, cos_view), resolution=8, block=8, max_depth=2)
    # The brute force is good to some 1e-4, the table to 2e-3 of E, which the colour damps.
    assert_agree(estimate, exact(expected[None, None]), slack=2e-3)


ENDS = {
    "diffuse only": material(diffuse=[0.9, 0.5, 0.0]),
    "mirror only": material(specular=[1.0, 0.6, 0.2], roughness=0.05),
    "black": material(),
    "nearly mirror": material(diffuse=1e-4, specular=0.9, roughness=0.05),
    "nearly diffuse": material(diffuse=0.9, specular=1e-4, roughness=0.05),
}


def test_the_ends_of_the_mixture_are_exact() -> None:
    for name, row in ENDS.items():
        scene = _furnace_plate(row, 0.8)
        estimate = render_blocks(scene, resolution=8, block=8, max_depth=2, passes=12)
        expected = exact(_albedo(row, 0.8)[None, None])
        assert_agree(estimate, expected, slack=1e-3, name=name)


def test_a_surface_shades_the_same_from_behind() -> None:
    """Turning all triangles and normals around changes no picture: nothing has a back."""
    row = material(diffuse=[0.3, 0.2, 0.5], specular=0.4, roughness=0.3)
    floor = quad([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], material(diffuse=0.5))
    lamp = light([[-0.5, 0, 2], [0.5, 0, 2], [0, 0.6, 1.8]], 6.0)
    ball = sphere([0, 0, 0.5], 0.5, row, rings=8)
    triangles, normals = ball.triangles[:, ::-1], -ball.normals[:, ::-1]
    turned = dataclasses.replace(ball, triangles=triangles, normals=normals)
    front, back = (
        render_blocks(join([floor, part, lamp], eye=(0, -2, 1)), first_seed=seed, passes=8)
        for seed, part in enumerate([ball, turned])
    )
    assert_agree(front, back)


FAR = np.array([[-20, 30, 40], [20, 30, 40], [0, 50, 60]])


def _tilted_plate(row: NDArray, tilt: float, eye: tuple[float, float, float]) -> Scene:
    """A small plate in z = 0 whose shading normals lean towards the far light at +y."""
    plate = flat([[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0, 0.3, 0]]], row)
    normal = np.array([0.0, np.sin(tilt), np.cos(tilt)])
    tilted = dataclasses.replace(plate, normals=np.broadcast_to(normal, (1, 3, 3)))
    return join([tilted, light(FAR, 1.0)], eye=eye, target=(0, 0.001, 0), fov_deg=1)


@pytest.mark.parametrize(
    ("tilt", "eye"),
    [(0.3, (0.0, 0.0, 2.0)), (1.2, (0.0, -1.88, 0.68))],
    ids=["seen from the front", "seen from behind its shading normal"],
)
def test_shading_normals_are_those_of_the_scene(
    llvm: None, tilt: float, eye: tuple[float, float, float]
) -> None:
    """A flat plate with tilted normals is as bright as a plate that is really tilted so, even for
    a viewer whom only the plate itself faces."""
    scene = _tilted_plate(material(diffuse=0.8), tilt, eye)
    picture = render_blocks(scene, resolution=8, block=8, max_depth=2)
    normal = np.array([0.0, np.sin(tilt), np.cos(tilt)])
    irradiance = lambert_irradiance(np.zeros((1, 3)), normal, FAR, 1.0)[0]
    # The view is 0.1 wide and the light 60 away: moving there changes the form factor by 0.2 %.
    expected = exact(np.full((1, 1, 3), 0.8 / np.pi * irradiance))
    assert_agree(picture, expected, slack=3e-3)


def test_a_mirror_shows_nothing_to_a_viewer_behind_its_shading_normal(llvm: None) -> None:
    """As in Cycles; nor does it reflect to below the plate, whatever its shading normal says."""
    row = material(specular=1.0, roughness=0.5)
    behind = _tilted_plate(row, 1.2, (0.0, -1.88, 0.68))
    picture = render_blocks(behind, resolution=8, block=8, max_depth=2)
    np.testing.assert_array_equal(picture.mean, 0)


def test_lobes_add_up_to_the_material_and_never_exceed_one() -> None:
    rng = np.random.default_rng(0)
    rows = np.zeros((500, 10), np.float32)
    split = rng.uniform(size=(500, 3))
    rows[:, 0:3], rows[:, 3:6] = split * 0.97, (1 - split) * 0.97
    rows[:, 6] = rng.uniform(size=500)
    rows[0, 0:6], rows[1, 0:3], rows[2, 3:6] = 0, 0, 0
    lobes = bsdf_lobes(rows)
    diffuse, specular = scaled_albedos(lobes)
    weight = lobes.weight[:, None]
    # float64 arithmetic on float32 rows: exact to 1e-12.
    np.testing.assert_allclose((1 - weight) * diffuse, rows[:, 0:3], atol=1e-12)
    np.testing.assert_allclose(weight * specular, rows[:, 3:6], atol=1e-12)
    bound = lobes.diffuse.max(1) + lobes.specular.max(1) + 1e-12
    assert (diffuse.max(1) <= bound).all() and (specular.max(1) <= bound).all()
    assert lobes.weight[0] == 0 and lobes.weight[1] == 1 and lobes.weight[2] == 0
    widths = np.maximum(rows[:, 6].astype(np.float64) ** 2, MIN_ALPHA)
    np.testing.assert_allclose(lobes.alpha, widths)


def _mean_radiance_of_a_ball() -> float:
    """Return the mean over what a rough white mirror of many facets covers of the picture.

    It is in a furnace, and its albedo is 1.
    """
    mirror = sphere([0, 0, 0], 0.5, material(specular=1.0, roughness=1.0), rings=48)
    scene = join([mirror, furnace()], eye=(0, -3, 0), fov_deg=20)
    tracer, camera = load_tracer(scene, max_depth=2, rr_depth=5), camera_of(scene, 32)
    pictures = [tracer.radiance(camera, seed=k, spp=64) for k in range(4)]
    covered = tracer.features(camera, spp=64).albedo.mean()
    return float(np.mean(pictures) / covered)


@pytest.mark.usefixtures("llvm")
def test_single_scattering_would_lose_most_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball returns all; without the scale a ball of roughness 1 shows Eavg of the table."""
    # The rims of facets reflect to below themselves: another 0.1 %.
    assert abs(_mean_radiance_of_a_ball() - 1) < 0.003

    def nothing(specular: NDArray, *_: Any) -> NDArray:
        return np.zeros_like(specular)

    monkeypatch.setattr(surface_table, "scattered_again", nothing)
    # 96 facets around are a little off the sphere.
    assert _mean_radiance_of_a_ball() == pytest.approx(0.409, abs=0.004)


COMPOSED = sampled_like_scene(np.random.default_rng(0), num_views=1)


@pytest.mark.parametrize(
    "made",
    [lambda: COMPOSED, lambda: open_scene(one_sun(3e3)), bumpy_room],
    ids=["composed", "sky", "normal map"],
)
def test_rendering_commutes_with_motion(made: Callable[[], Scene]) -> None:
    scene = made()
    there = moved(scene, uniform_rotation(np.random.default_rng(0)), [0.3, -0.2, 0.1])
    # Frames around normals turn differently, so that the same seed means other samples.
    here = render_blocks(scene, first_seed=99, passes=8)
    assert_agree(render_blocks(there, passes=8), here, slack=1e-3)


def test_rendering_commutes_with_a_mirror_and_with_an_exchange_of_channels() -> None:
    scene, order = COMPOSED, np.array([2, 0, 1])
    recoloured = scene.materials.copy()
    for part in (DIFFUSE, SPECULAR, EMISSION):
        recoloured[:, part] = recoloured[:, part][:, order]
    here = render_blocks(scene, first_seed=99, passes=8)
    for other, seen in (
        (mirrored(scene), np.s_[:, ::-1]),
        (dataclasses.replace(scene, materials=recoloured), np.s_[..., np.argsort(order)]),
    ):
        other.check()
        there = render_blocks(other, passes=8)
        back = dataclasses.replace(there, mean=there.mean[seen], error=there.error[seen])
        assert_agree(back, here)
        with pytest.raises(AssertionError, match="of what is allowed"):
            assert_agree(there, here)


def test_what_a_camera_sees_commutes_with_motion() -> None:
    scene = COMPOSED
    there = moved(scene, uniform_rotation(np.random.default_rng(5)), [1.0, 2.0, -3.0])
    before, after = (Visibility(s).facts(s.c2w[0], float(s.fov_deg[0]), 64) for s in (scene, there))
    # 4096 rays: a few graze an edge and fall on the other side after rounding.
    for name in ("coverage", "shell_back", "lit"):
        assert abs(getattr(before, name) - getattr(after, name)) < 0.005, name


SKIES = {"smooth": smooth(), "sun": one_sun(1e5), "night": night()}


def _traced_blocks(scene: Scene, passes: int) -> Estimate:
    """Return the means of 4 x 4 pixels over several noises, with their standard errors."""
    pictures = [direct(traced(scene, 32, seed=seed)) for seed in range(passes)]
    return blocks_of(np.array(pictures), 4)


def _require_alike(ours: Estimate, theirs: Estimate, of_mean: float) -> None:
    """Pixels are sampled on a grid of 2 x 2 and not all over: at rims, 3 % of a block of 16."""
    at_rims = 0.03 * theirs.mean.max()
    assert_agree(Estimate(mean=ours.mean, error=np.hypot(ours.error, at_rims)), theirs)
    both = np.hypot(ours.error, theirs.error)
    error = float(np.sqrt(np.square(both).sum()) / both.size)
    apart = abs(float(ours.mean.mean() - theirs.mean.mean()))
    assert apart < 5 * error + of_mean * float(theirs.mean.mean())


@pytest.mark.parametrize("roughness", [0.15, 1.0])
def test_direct_light_is_that_of_paths_of_two_edges(llvm: None, roughness: float) -> None:
    scene = corner(roughness=roughness)
    ours = _traced_blocks(scene, passes=12)
    theirs = render_blocks(scene, max_depth=2, passes=8)
    _require_alike(ours, theirs, of_mean=0.005)


@pytest.mark.slow("statistics")
@pytest.mark.parametrize("sky", SKIES.values(), ids=SKIES.keys())
@pytest.mark.parametrize("num_lights", [0, 2])
def test_direct_light_of_a_sky_is_that_of_paths_of_two_edges(
    llvm: None, sky: Environment, num_lights: int
) -> None:
    """With lamps beside it, and without any."""
    scene = open_scene(sky, num_lights)
    ours = _traced_blocks(scene, passes=24)
    theirs = render_blocks(scene, max_depth=2, passes=8)
    _require_alike(ours, theirs, of_mean=0.01)


def test_diffuse_light_of_other_surfaces_is_that_of_longer_paths(llvm: None) -> None:
    """Without gloss nothing is simplified: gathered light times albedo is all indirect light.

    But for what is mixed between anchors: so there is one for each pixel, and means are compared.
    """
    scene = corner()
    materials = scene.materials.copy()
    materials[:, 3:6] = 0
    scene = dataclasses.replace(scene, materials=materials)
    found = [traced(scene, 32, anchors_a_side=32, gather_rays=32, seed=k) for k in range(3)]
    pixels = np.array([x.pixels for x in found])
    gathered = np.array([x.gathered.reshape(32, 32, 3) for x in found])
    ours = np.mean(pixels[..., Channel.COVERAGE] * pixels[..., Channel.DIFFUSE] * gathered)
    whole = render_blocks(scene, max_depth=10, passes=6).mean
    short = render_blocks(scene, max_depth=2, passes=6).mean
    # radiosity of triangles as large as the floor for the light of the third edge on: 4 %
    assert ours == pytest.approx((whole - short).mean(), rel=0.04)
