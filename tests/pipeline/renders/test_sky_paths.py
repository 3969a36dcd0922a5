"""Pictures below a sky: our kernel against Mitsuba's `envmap`, and against other picks."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.renders import vector_tracer
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.tracer import Tracer
from pipeline.renders.vector_tracer import VectorTracer
from scene_templates.rotations import uniform_rotation
from storage.records.environment import Environment
from storage.records.scene import Scene
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_same_light,
    camera_of,
    render_blocks,
    render_passes,
)
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere
from tests.sky_maps import constant, night, one_sun, smooth

pytestmark = pytest.mark.usefixtures("llvm")

_TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)

SKIES: dict[str, Callable[[], Environment]] = {
    "smooth": lambda: smooth(rotation=_TURN),
    "sun": lambda: one_sun(1e5),
    "night": night,
}


def open_scene(sky: Environment | None, num_lights: int = 2) -> Scene:
    """Things on a floor, nothing smoother than roughness 0.3: the noise has no long tail."""
    s = 0.5
    floor = [[-s, -s, -s], [s, -s, -s], [s, s, -s], [-s, s, -s]]
    wall = [[-s, s, -s], [s, s, -s], [s, s, s], [-s, s, s]]
    parts = [
        quad(floor, material(diffuse=[0.2, 0.5, 0.4], specular=0.4, roughness=0.4)),
        quad(wall, material(diffuse=[0.7, 0.3, 0.3], specular=0.2, roughness=0.9)),
        sphere([-0.15, 0.1, -0.2], 0.25, material(diffuse=0.1, specular=0.8, roughness=0.3), 8),
        box([0.25, -0.1, -0.3], 0.3, material(diffuse=[0.1, 0.2, 0.8]), turn=0.4),
    ]
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
    lit = ours.mean > 0.01 * ours.mean.max()
    score = (ours.mean - theirs.mean)[lit] / np.hypot(ours.error, theirs.error)[lit]
    # As in test_twin_tracers, but for the mean: channels and blocks share their luck with a few
    # small lamps, and 115 scores of the night are worth 45 independent ones. In ten repeats of 16
    # passes their mean had a standard deviation of 0.15 with lamps and 0.21 without, and no bias:
    # over 160 passes it was 0.07 and 0.05, and all light together differed by 0.08 and 0.09 %.
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.35
    assert len(score) > 90 and abs(score.mean()) < 0.5


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
    guided = tracer.guided()
    assert guided._scene.guide is not None and guided._scene.sky is not None
    plain = render_passes(tracer, scene, passes=8)
    assert_same_light(render_passes(guided, scene, first_seed=500, passes=8), plain)


def test_parts_add_up_and_direct_light_is_that_of_one_bounce() -> None:
    scene = open_scene(smooth(is_seen=True))
    camera, found = camera_of(scene, 16), []
    for depth in (10, 2):
        tracer = load_tracer(scene, max_depth=depth, rr_depth=5)
        total = tracer.apart(bounces=True, lobes=True).pass_sum(camera)
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
