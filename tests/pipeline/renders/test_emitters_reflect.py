"""An emitter reflects what its material row says, in both tracers: black, white, or anything."""

from typing import Any

import numpy as np
import pytest

from pipeline.renders.load_tracer import load_tracer
from storage.conventions import camera_rays
from storage.records.scene import Scene
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.closed_forms import lambert_irradiance
from tests.pipeline.renders.sampling import assert_agree, exact, render_blocks
from tests.pipeline.renders.scene_kit import Part, flat, join, light, material, quad

DIM = 0.125
PANEL = np.array([[-0.5, 1.0, 0.5], [0.5, 1.0, 0.5], [0.0, 1.0, 1.5]])
BRIGHT = np.array([[-0.5, 0.0, 2.5], [0.5, 0.0, 2.5], [0.0, 0.4, 2.5]])
RADIANCE = 20.0
TRACERS = [load_tracer, pytest.param(PluginTracer, marks=pytest.mark.slow("statistics"))]


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


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("tracer", "diffuse"),
    [(load_tracer, 0.0), (load_tracer, 1.0),
     pytest.param(PluginTracer, 0.4, marks=pytest.mark.slow("statistics"))],
)  # fmt: skip
def test_a_panel_shows_its_emission_and_what_it_reflects(tracer: Any, diffuse: float) -> None:
    scene = _panel_in_a_mirror(light(PANEL, DIM, diffuse))
    estimate = render_blocks(
        scene, block=4, passes=16, tracer=tracer(scene, max_depth=3, rr_depth=9)
    )
    # The mirror blurs by 1e-4 and returns all light; twins of emitters stand 1e-4 off.
    assert_agree(estimate, exact(DIM + _reflected(scene, diffuse)), slack=2e-3)


@pytest.mark.usefixtures("llvm")
def test_a_black_panel_is_as_dim_with_a_bright_light_as_without() -> None:
    scene = _panel_in_a_mirror(light(PANEL, DIM))
    estimate = render_blocks(scene, passes=16)
    # The tail of the mirror's lobe is the only way to the bright light.
    assert_agree(estimate, exact(np.full((8, 8, 3), DIM)), slack=2e-3)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("tracer", TRACERS)
def test_a_faint_emitter_is_a_surface(tracer: Any) -> None:
    """At all depths a panel that hardly emits looks, in the mirror, as one that does not emit."""
    row = material(diffuse=[0.2, 0.5, 0.3], specular=0.4, roughness=0.5)
    surface = _panel_in_a_mirror(flat(PANEL, row))
    row[7:10] = 1e-6
    emitter = _panel_in_a_mirror(flat(PANEL, row, "emitter"))
    shown = [
        render_blocks(
            scene, passes=8, first_seed=seed, tracer=tracer(scene, max_depth=10, rr_depth=5)
        )
        for seed, scene in enumerate([surface, emitter])
    ]
    assert shown[0].mean.max() > 0.01
    # As above, and twins add their offset.
    assert_agree(shown[1], shown[0], slack=2e-3)
