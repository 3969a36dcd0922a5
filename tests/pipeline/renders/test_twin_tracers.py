"""Our path tracer against Mitsuba's stock plugins and closed forms; emitters and their picks."""

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pipeline.renders.tracer import load_tracer
from scene_templates.rotations import uniform_rotation
from storage.conventions import camera_rays
from storage.records.retextured import NO_TEXTURES
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.oracle.kernel_bsdf import exact_twin
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    camera_of,
    exact,
    lambert_irradiance,
    printed_by,
    render_blocks,
    scores,
)
from tests.pipeline.renders.scene_kit import (
    SKY_LAMP,
    Part,
    bumpy_room,
    flat,
    furniture,
    join,
    light,
    mapped,
    material,
    noise_map,
    open_scene,
    quad,
    sphere,
    textured,
    textured_floor,
)
from tests.sky_maps import night, one_sun, smooth
from tests.textured_by_hand import bumps

pytestmark = pytest.mark.usefixtures("llvm")


def _room(num_lights: int) -> Scene:
    rng = np.random.default_rng(num_lights)
    parts = furniture()
    for _ in range(num_lights):
        centre = np.array([0.2, -0.9, 0.9]) + rng.uniform(-0.4, 0.4, 3)
        triangle = centre + rng.normal(size=(3, 3)) * rng.uniform(0.1, 0.2)
        parts.append(light(triangle, rng.uniform(1, 20, 3), diffuse=1.0))
    return join(parts, eye=(0.5, -1.7, 0.6), fov_deg=45)


def _textured_room(texture: Texture, index: list[int], **columns: float) -> Callable[[], Scene]:
    """Return what makes a ball on a textured floor, with light paths and bounces."""

    def made() -> Scene:
        row = material(diffuse=0.2, specular=0.7, roughness=0.3)
        ball = sphere([0.2, 0.1, 0.4], 0.4, row, 8)
        parts = [textured_floor(material(**columns)), ball, SKY_LAMP]
        return textured(parts, (texture,), index, scale=2.0)

    return made


def _bumpy_caustics() -> Scene:
    """A bumpy, smooth mirror that throws the light of a small lamp on a floor: light paths land."""
    panel = [[-0.9, 0.5, 0.02], [0.9, 0.5, 0.02], [0.9, 0.7, 1.2], [-0.9, 0.7, 1.2]]
    mirror = quad(panel, material(specular=0.9, roughness=0.25))
    lamp = light([[-0.2, -0.9, 0.8], [0.2, -0.9, 0.8], [0, -0.9, 1.1]], 40.0)
    return mapped([mirror, textured_floor(material(diffuse=0.8)), lamp], bumps(2, 0.8))


TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)
QUICK: dict[str, Callable[[], Scene]] = {
    "lamps": lambda: _room(5),
    "sun": lambda: open_scene(one_sun(1e5)),
    "bumps": bumpy_room,  # many normals turn away from the viewer or the lamp
    "bumpy caustics": _bumpy_caustics,
}
SLOW: dict[str, Callable[[], Scene]] = {
    "smooth": lambda: open_scene(smooth(rotation=TURN), 0),
    "night": lambda: open_scene(night()),
    "diffuse": _textured_room(noise_map(3, 3, 0, 0.95), [0, -1, -1], specular=0.05, roughness=0.5),
    "roughness": _textured_room(noise_map(4, 1, 0.2, 1), [-1, -1, 0], diffuse=0.1, specular=0.8),
    "specular": _textured_room(noise_map(5, 3, 0, 0.9), [-1, 0, -1], diffuse=0.1, roughness=0.4),
}


@pytest.mark.parametrize(
    "made",
    [
        *QUICK.values(),
        *(pytest.param(each, marks=pytest.mark.slow("statistics")) for each in SLOW.values()),
    ],
    ids=[*QUICK, *SLOW],
)
def test_both_integrators_agree_within_their_noise(
    made: Callable[[], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Around one and the same BRDF, at every roughness, with white emitters and normal maps."""
    scene = made()
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    # The twins of an emitter stand 1e-4 off, which moves direct light by about as much.
    assert_agree(ours, theirs, slack=1e-3)
    # Wider than without a sky for the mean: channels and blocks share their luck with a few
    # small lamps, and 115 scores of the night are worth 45 independent ones. In ten repeats of 16
    # passes their mean had a standard deviation of 0.15 with lamps and 0.21 without, and no bias:
    # over 160 passes it was 0.07 and 0.05, and all light together differed by 0.08 and 0.09 %.
    wider = {"most": 1.35, "bias": 0.5} if scene.environment else {}
    assert_honest(ours, theirs, **wider)
    if scene.textures:
        plain = render_blocks(dataclasses.replace(scene, **NO_TEXTURES), passes=4)
        assert np.abs(scores(ours, plain)).max() > 20  # the test sees textures


_IN_SCALAR = """
import json
import pipeline.renders  # which loads what the system may lack
import mitsuba
mitsuba.set_variant("scalar_rgb")
import drjit
drjit.set_thread_count(1)  # reflections call Python, where threads queue for its lock
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.test_twin_tracers import _room
scene = _room(5)
tracer = PluginTracer(scene, max_depth=10, rr_depth=5)
camera = camera_of(scene, 16)
means = [tracer.radiance(camera, seed=k, spp=16).mean(axis=(0, 1)).tolist() for k in range(8)]
print(json.dumps([means, int(tracer.hits(camera).sum())]))
"""


def test_the_oracle_agrees_where_nothing_is_compiled() -> None:
    """In `scalar_rgb` it shares neither LLVM nor a kernel with ours."""
    means, num_hits = json.loads(printed_by(_IN_SCALAR))
    scene = _room(5)
    ours = render_blocks(scene, resolution=16, block=16)
    error = np.hypot(np.std(means, axis=0, ddof=1) / np.sqrt(len(means)), ours.error[0, 0])
    # Five standard errors, of which one comes from eight values only.
    assert (np.abs(np.mean(means, axis=0) - ours.mean[0, 0]) < 5 * error).all()
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    assert abs(int(tracer.hits(camera_of(scene, 16)).sum()) - num_hits) <= 1


DIM = 0.125


PANEL = np.array([[-0.5, 1.0, 0.5], [0.5, 1.0, 0.5], [0.0, 1.0, 1.5]])


BRIGHT = np.array([[-0.5, 0.0, 2.5], [0.5, 0.0, 2.5], [0.0, 0.4, 2.5]])


RADIANCE = 20.0


def _panel_in_a_mirror(panel: Part) -> Scene:
    """Emitters are hidden from the camera, so that their surface shows in a mirror only."""
    floor = [[-12, -12, 0], [12, -12, 0], [12, 12, 0], [-12, 12, 0]]
    mirror = quad(floor, material(specular=1.0, roughness=0.01))
    bright = light(BRIGHT, RADIANCE)
    return join([mirror, panel, bright], eye=(0, -2, 1), target=(0, 1, -0.9), fov_deg=4)


def _reflected(scene: Scene, albedo: float) -> Any:
    """Return what the panel shows of the bright light by Lambert's formula, [8, 8, 3]."""
    origin, directions = camera_rays(scene.c2w[0], float(scene.fov_deg[0]), 64)
    origin, directions = origin * [1, 1, -1], directions * [1, 1, -1]
    points = origin + directions * ((1 - origin[1]) / directions[..., 1:2])
    normal = np.array([0.0, -1.0, 0.0])
    irradiance = lambert_irradiance(points.reshape(-1, 3), normal, BRIGHT, RADIANCE)
    blocks = (irradiance * albedo / np.pi).reshape(8, 8, 8, 8).mean(axis=(1, 3))
    return np.repeat(blocks[..., None], 3, axis=-1)


@pytest.mark.parametrize(
    ("tracer", "diffuse"),
    [(load_tracer, 0.0), (load_tracer, 1.0),
     pytest.param(PluginTracer, 0.4, marks=pytest.mark.slow("statistics"))],
)  # fmt: skip
def test_a_panel_shows_its_emission_and_what_it_reflects(tracer: Any, diffuse: float) -> None:
    scene = _panel_in_a_mirror(light(PANEL, DIM, diffuse))
    traced = tracer(scene, max_depth=3, rr_depth=9)
    estimate = render_blocks(scene, block=4, passes=16, tracer=traced)
    # The mirror blurs by 1e-4 and returns all light; twins of emitters stand 1e-4 off.
    assert_agree(estimate, exact(DIM + _reflected(scene, diffuse)), slack=2e-3)


def test_a_faint_emitter_is_a_surface() -> None:
    """At all depths a panel that hardly emits looks, in the mirror, as one that does not emit."""
    row = material(diffuse=[0.2, 0.5, 0.3], specular=0.4, roughness=0.5)
    faint = row + material(roughness=0, emission=1e-6)
    scenes = [_panel_in_a_mirror(flat(PANEL, *kind)) for kind in ((row,), (faint, "emitter"))]
    surface, emitter = (
        render_blocks(scene, passes=8, first_seed=seed) for seed, scene in enumerate(scenes)
    )
    assert surface.mean.max() > 0.01
    assert_agree(emitter, surface, slack=2e-3)  # as above
