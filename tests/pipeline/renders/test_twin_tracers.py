"""Our path tracer against Mitsuba's stock plugins: the same integral, by unrelated code."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from storage.records.scene import Scene
from tests.conftest import ROOT
from tests.oracle.kernel_bsdf import exact_twin
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import Estimate, assert_agree, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere


def _room(num_lights: int) -> Scene:
    """A room whose noise has no long tail: nothing smoother than roughness 0.3."""
    rng = np.random.default_rng(num_lights)
    s = 0.5
    parts = [
        quad(
            [[-s, -s, -s], [s, -s, -s], [s, s, -s], [-s, s, -s]],
            material(diffuse=[0.2, 0.5, 0.4], specular=0.4, roughness=0.4),
        ),
        quad(
            [[-s, s, -s], [s, s, -s], [s, s, s], [-s, s, s]],
            material(diffuse=[0.7, 0.3, 0.3], specular=0.2, roughness=0.9),
        ),
        sphere([-0.15, 0.1, -0.2], 0.25, material(diffuse=0.1, specular=0.8, roughness=0.3), 8),
        box([0.25, -0.1, -0.3], 0.3, material(diffuse=[0.1, 0.2, 0.8], roughness=1.0), turn=0.4),
    ]
    for _ in range(num_lights):
        centre = np.array([0.2, -0.9, 0.9]) + rng.uniform(-0.4, 0.4, 3)
        triangle = centre + rng.normal(size=(3, 3)) * rng.uniform(0.1, 0.2)
        parts.append(light(triangle, rng.uniform(1, 20, 3), diffuse=1.0))
    return join(parts, eye=(0.5, -1.7, 0.6), fov_deg=45)


@pytest.mark.usefixtures("llvm")
def test_both_integrators_agree_within_their_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around one and the same BRDF, at every roughness, with white emitters."""
    scene = _room(5)
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    # The twins of an emitter stand 1e-4 off, which moves direct light by about as much.
    assert_agree(ours, theirs, slack=1e-3)
    score = _scores(ours, theirs)
    # Errors estimated from 16 passes each: the scores spread by 1.04 if both are unbiased, and
    # a bias of a third of the noise in every block would show in the mean of some 100 scores.
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.3
    assert len(score) > 90 and abs(score.mean()) < 0.35


@pytest.mark.slow("references")
@pytest.mark.usefixtures("llvm")
def test_the_oracle_agrees_within_noise_where_lobes_are_not_rough() -> None:
    """`roughconductor` has the separable Smith term; it differs from ours in rough lobes only."""
    scene = _room(5)
    plugins = PluginTracer(scene, max_depth=10, rr_depth=5)
    ours = render_blocks(scene)
    stock = render_blocks(scene, first_seed=500, tracer=plugins)
    score = _scores(ours, stock)
    # As above: what is rough here is mostly diffuse.
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.3
    assert len(score) > 90 and abs(score.mean()) < 0.35
    camera = camera_of(scene, 32)
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    features = tracer.features(camera, spp=16), plugins.features(camera, spp=16)
    # Both trace the same regular grid up to float32, and meet the same triangles but at edges.
    assert np.mean(np.abs(features[0].albedo - features[1].albedo) > 1e-4) < 0.01
    assert np.mean(np.abs(features[0].normal - features[1].normal) > 1e-4) < 0.01
    assert (tracer.hits(camera) != plugins.hits(camera)).sum() <= 1


@pytest.mark.slow("references")
@pytest.mark.usefixtures("llvm")
def test_how_far_the_oracles_rough_metal_is_off() -> None:
    """Measured: 4.5 % of the direct light, of which noise is 0.2 to 0.6 %."""
    row = material(diffuse=0.05, specular=0.9, roughness=1.0)
    floor = quad([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], row)
    wall = quad([[-3, 1, 0], [3, 1, 0], [3, 1, 3], [-3, 1, 3]], row)
    lamp = light([[-0.5, -1, 2], [0.5, -1, 2], [0, -0.5, 2.2]], 10.0)
    parts = [floor, wall, sphere([0, 0, 0.5], 0.5, row), lamp]
    scene = join(parts, eye=(0, -3, 1.2), target=(0, 0, 0.5), fov_deg=45)
    ours = render_blocks(scene, max_depth=2)
    plugins = PluginTracer(scene, max_depth=2, rr_depth=5)
    stock = render_blocks(scene, max_depth=2, first_seed=99, tracer=plugins)
    lit = stock.mean > 0.03 * stock.mean.max()
    assert np.sqrt(np.mean(np.square(ours.mean[lit] / stock.mean[lit] - 1))) < 0.07


def _scores(ours: Estimate, theirs: Estimate) -> NDArray[np.float64]:
    """Return the differences of what is lit, in standard errors."""
    lit = ours.mean > 0.01 * ours.mean.max()
    return (ours.mean - theirs.mean)[lit] / np.hypot(ours.error, theirs.error)[lit]


_IN_SCALAR = """
import json
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


@pytest.mark.usefixtures("llvm")
def test_the_oracle_agrees_where_nothing_is_compiled() -> None:
    """In `scalar_rgb` it shares neither LLVM nor a kernel with ours."""
    result = subprocess.run(
        [sys.executable, "-c", _IN_SCALAR],
        cwd=ROOT,
        env=dict(os.environ),
        capture_output=True,
        text=True,
        check=True,
    )
    means, num_hits = json.loads(result.stdout)
    scene = _room(5)
    ours = render_blocks(scene, resolution=16, block=16)
    error = np.hypot(np.std(means, axis=0, ddof=1) / np.sqrt(len(means)), ours.error[0, 0])
    # Five standard errors, of which one comes from eight values only.
    assert (np.abs(np.mean(means, axis=0) - ours.mean[0, 0]) < 5 * error).all()
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    assert abs(int(tracer.hits(camera_of(scene, 16)).sum()) - num_hits) <= 1
