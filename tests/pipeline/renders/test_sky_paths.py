"""Skies: our kernel against Mitsuba's `envmap` and other picks; its map against the definition."""

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest

from pipeline.renders import vector_tracer
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.sky_share import peaked_radiance, sky_share
from pipeline.renders.sky_table import SkyTable, alias_rows
from pipeline.renders.tracer import Tracer
from pipeline.renders.vector_tracer import VectorTracer
from scene_templates.rotations import uniform_rotation
from storage.records.environment import Environment
from storage.records.lookup import environment_values
from storage.records.scene import Scene
from storage.records.sky_texels import row_solid_angles, texel_means
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    assert_same_light,
    camera_of,
    render_blocks,
    render_passes,
)
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.pipeline.renders.test_twin_tracers import furniture
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth

pytestmark = pytest.mark.usefixtures("llvm")


_TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)

SKIES: dict[str, Callable[[], Environment]] = {
    "smooth": lambda: smooth(rotation=_TURN),
    "sun": lambda: one_sun(1e5),
    "night": night,
}


def open_scene(sky: Environment | None, num_lights: int = 2) -> Scene:
    parts = furniture()
    lamps = [[[0.2, -0.9, 0.9], [0.4, -0.9, 1.0], [0.2, -0.7, 0.8]],
             [[-0.9, -0.5, 0.6], [-0.9, -0.3, 0.6], [-0.8, -0.4, 0.8]]]  # fmt: skip
    parts += [light(lamp, [6.0, 8.0, 7.0], diffuse=1.0) for lamp in lamps[:num_lights]]
    return join(parts, eye=(0.5, -1.7, 0.6), fov_deg=45, sky=sky)


@pytest.mark.parametrize(
    ("name", "num_lights"),
    [("sun", 2), *(pytest.param(*case, marks=pytest.mark.slow("statistics"))
                   for case in (("smooth", 0), ("night", 2)))],
)  # fmt: skip
def test_both_integrators_agree_within_their_noise(
    name: str, num_lights: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Around one and the same BRDF, with lamps and without."""
    scene = open_scene(SKIES[name](), num_lights)
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    # The twins of an emitter stand 1e-4 off, which moves direct light by about as much.
    assert_agree(ours, theirs, slack=1e-3)
    # Wider than without a sky for the mean: channels and blocks share their luck with a few
    # small lamps, and 115 scores of the night are worth 45 independent ones. In ten repeats of 16
    # passes their mean had a standard deviation of 0.15 with lamps and 0.21 without, and no bias:
    # over 160 passes it was 0.07 and 0.05, and all light together differed by 0.08 and 0.09 %.
    assert_honest(ours, theirs, most=1.35, bias=0.5)


def test_no_share_of_picks_changes_what_is_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Camera paths, light paths and picks are weighed against each other by the share."""
    scene = open_scene(smooth())
    usual = render_passes(_tracer(scene), scene, passes=8)
    for share in (0.03, 0.97):
        monkeypatch.setattr(vector_tracer, "sky_share", lambda *_, share=share: share)
        other = render_passes(_tracer(scene), scene, first_seed=500, passes=8)
        assert_same_light(other, usual, name=f"share {share}")


def _tracer(scene: Scene) -> Tracer:
    return load_tracer(scene, max_depth=10, rr_depth=5)


def test_guided_paths_expect_the_same() -> None:
    """A mirror that throws a lamp's light and the sky's on a rough floor."""
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.8))
    mirror = quad(
        [[-1, 1, 0], [1, 1, 0], [1, 1, 1], [-1, 1, 1]], material(specular=1.0, roughness=0.05)
    )
    lamp = light([[0, -0.5, 1], [0.2, -0.5, 1], [0, -0.3, 1]], 10.0)
    scene = join([floor, mirror, lamp], eye=(0, -2, 1.5), sky=smooth())
    tracer = load_tracer(scene, max_depth=6, rr_depth=5)
    assert isinstance(tracer, VectorTracer)
    guided = tracer.with_guide()
    assert guided._scene.guide is not None and guided._scene.sky is not None
    plain = render_passes(tracer, scene, passes=8)
    assert_same_light(render_passes(guided, scene, first_seed=500, passes=8), plain)


def test_parts_add_up_and_direct_light_is_that_of_one_bounce() -> None:
    scene = open_scene(smooth(is_seen=True))
    camera, found = camera_of(scene, 16), []
    for depth in (10, 2):
        tracer = load_tracer(scene, max_depth=depth, rr_depth=5)
        total = tracer.split_lights(bounces=True, lobes=True).pass_sum(camera)
        total.add(seed=1, spp=64)
        found.append(total.read() / 64)
        whole = tracer.radiance(camera, seed=1, spp=64)
        # Sums in another order: float32 roundings of some 64 samples.
        np.testing.assert_allclose(found[-1].sum(axis=0), whole, rtol=1e-4, atol=1e-5)
    direct, indirect = found[1][[0, 2]].sum(axis=0), found[1][[1, 3]].sum(axis=0)
    assert not indirect.any()
    np.testing.assert_allclose(found[0][[0, 2]].sum(axis=0), direct, rtol=1e-4, atol=1e-5)


def test_a_lamp_alone_has_no_sky() -> None:
    with_sky, without = (open_scene(sky) for sky in (constant(3.0), None))
    row = len(with_sky.objects) - 1
    camera = camera_of(without, 16)
    below_sky, alone = (
        load_tracer(scene, max_depth=5, rr_depth=5).only_light(row).radiance(camera, seed=2, spp=16)
        for scene in (with_sky, without)
    )
    np.testing.assert_array_equal(below_sky, alone)


def _turned(seed: int) -> np.ndarray:
    return uniform_rotation(np.random.default_rng(seed)).astype(np.float32)


MAPS = [
    smooth(rotation=_turned(1)),
    one_sun(rotation=_turned(2)),
    six_poles(rotation=_turned(3)),
    as_sky(np.random.default_rng(0).random((1, 2, 3))),
    as_sky(np.random.default_rng(1).random((3, 6, 3)) ** 8, rotation=_turned(4)),
]


@pytest.mark.parametrize("number", range(len(MAPS)))
def test_radiance_is_that_of_the_definition(number: int) -> None:
    sky, rng = MAPS[number], np.random.default_rng(number)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    level = sky.rotation.T[:2]  # the seam is among them; at the poles u is what rounding makes it
    directions = np.concatenate([directions, level, -level])
    found, _ = SkyTable(sky, 1.0).radiance_and_density(mi.Vector3f(directions.T), mi.Bool(True))
    expected = environment_values(sky, directions)
    # float32 angles are off by 3e-7 radians, which is 6e-6 texels of 128 across, of the greatest
    # difference between texels.
    error = np.abs(np.array(found).T - expected).max()
    assert error < 2e-5 * sky.radiance_rgb.max() + 1e-6


@pytest.mark.parametrize("number", range(len(MAPS)))
def test_directions_come_with_the_density_that_is_stated(number: int) -> None:
    """The mean of L / density over drawn directions is the flux of the map, and so by octants."""
    sky, count = MAPS[number], 1 << 15
    table, rng = SkyTable(sky, 0.7), np.random.default_rng(5)
    drawn = table.sample(mi.Point2f(rng.random((2, count)).astype(np.float32)), mi.Bool(True))
    directions = np.array(drawn.direction).T
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-6
    again = table.radiance_and_density(drawn.direction, mi.Bool(True))[1]
    np.testing.assert_array_equal(np.array(again), np.array(drawn.pdf))
    weighed = np.array(drawn.radiance).T / (np.array(drawn.pdf)[:, None] / np.float32(0.7))
    octant = (directions > 0) @ np.array([1, 2, 4])
    uniform = rng.normal(size=(1 << 16, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    flux = environment_values(sky, uniform) * 4 * np.pi
    place = (uniform > 0) @ np.array([1, 2, 4])
    for part in range(8):
        ours, theirs = weighed * (octant == part)[:, None], flux * (place == part)[:, None]
        error = np.hypot(*(v.std(axis=0) / np.sqrt(len(v)) for v in (ours, theirs)))
        # Five standard errors of both; octants without light agree exactly but for roundings.
        assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 5 * error + 1e-6).all(), part


def test_a_sun_of_one_texel_is_drawn_by_what_its_neighbours_have_of_it() -> None:
    """Estimates of its flux by one draw differ by the slope within texels, not by 10,000 times."""
    sky = one_sun()
    table, rng = SkyTable(sky, 1.0), np.random.default_rng(6)
    drawn = table.sample(mi.Point2f(rng.random((2, 1 << 16)).astype(np.float32)), mi.Bool(True))
    weighed = np.array(drawn.radiance)[0] / np.array(drawn.pdf)
    # A tent that is drawn by its means over texels: measured 1.05.
    assert weighed.std() < 1.2 * weighed.mean()


def test_alias_tables_have_the_shares_of_their_weights() -> None:
    rng = np.random.default_rng(7)
    weights = np.concatenate([rng.random((5, 37)) ** 6, np.ones((1, 37)), np.zeros((1, 37))])
    weights[0, 3:] = 0
    weights[1, 5] = 1e6
    keep, alias = alias_rows(weights)
    share = keep.copy()
    for row in range(len(weights)):
        np.add.at(share[row], alias[row], 1 - keep[row])
    expected = np.ones_like(weights)
    expected[:-1] = 37 * weights[:-1] / weights[:-1].sum(axis=1, keepdims=True)
    # Sums of 37 numbers in double precision.
    np.testing.assert_allclose(share, expected, atol=1e-12)
    assert ((keep >= 0) & (keep <= 1)).all()


def test_texel_means_are_means_over_texels() -> None:
    values = np.random.default_rng(8).random((4, 8))
    sky = as_sky(np.repeat(values[..., None], 3, axis=-1))
    table, fine = texel_means(sky.radiance_rgb[..., 0].astype(np.float64)), 50
    v = (np.arange(4 * fine) + 0.5) / (4 * fine)
    u = (np.arange(8 * fine) + 0.5) / (8 * fine)
    theta, azimuth = np.pi * v[:, None], (0.5 - u[None]) * 2 * np.pi
    flat = np.sin(theta)
    where = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(theta) + 0 * azimuth], axis=-1
    )
    found = environment_values(sky, where)[..., 0].reshape(4, fine, 8, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(table, found, rtol=1e-3)  # midpoints of 50 steps at the knots


def test_the_share_goes_by_peaks_and_is_a_lamps_at_least() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamps = [
        light([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]], 20.0),
        light([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 2.0, 2.0]], 1.0),
    ]
    scene = join([floor, *lamps])
    power = 0.005 * 20 + 0.5 * 1.0
    for flat in (constant(0.05), constant(30.0)):
        assert sky_share(scene, flat) == pytest.approx(1 / 3)  # one of three
    sun = one_sun()
    assert row_solid_angles(64).sum() * 128 == pytest.approx(4 * np.pi)
    excess = row_solid_angles(64)[16] / (4 * np.pi) * (1e5 * (1 + 0.9 + 0.7) / 3 - 0.2)
    assert peaked_radiance(sun) == pytest.approx(excess, rel=1e-6)
    weight = 2 * np.pi * 2.0 * excess  # half of the floor's diagonal is the root of 2
    assert sky_share(scene, sun) == pytest.approx(weight / (weight + power), rel=1e-6)
    assert sky_share(join([floor], sky=sun), sun) == 1
    assert peaked_radiance(night()) > 0
