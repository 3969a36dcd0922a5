"""Our path tracer against Mitsuba's stock plugins and closed forms; emitters and their picks."""

import json
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.renders.emitter_table import EmitterTable, alias_table
from pipeline.renders.load_tracer import load_tracer
from storage.conventions import camera_rays
from storage.records.scene import Scene
from tests.oracle.kernel_bsdf import exact_twin
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.closed_forms import lambert_irradiance
from tests.pipeline.renders.sampling import (
    assert_agree,
    assert_honest,
    camera_of,
    exact,
    printed_by,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import Part, box, flat, join, light, material, quad, sphere


def furniture() -> list[Part]:
    """Return things on a floor, nothing smoother than roughness 0.3: the noise has no long tail."""
    s = 0.5
    return [
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


def _room(num_lights: int) -> Scene:
    rng = np.random.default_rng(num_lights)
    parts = furniture()
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
    assert_honest(ours, theirs)


@pytest.mark.slow("references")
@pytest.mark.usefixtures("llvm")
def test_the_oracle_agrees_within_noise_where_lobes_are_not_rough() -> None:
    """`roughconductor` has the separable Smith term; it differs from ours in rough lobes only."""
    scene = _room(5)
    plugins = PluginTracer(scene, max_depth=10, rr_depth=5)
    ours = render_blocks(scene)
    stock = render_blocks(scene, first_seed=500, tracer=plugins)
    assert_honest(ours, stock)  # what is rough here is mostly diffuse
    camera = camera_of(scene, 32)
    tracer = load_tracer(scene, max_depth=10, rr_depth=5)
    features = tracer.features(camera, spp=16), plugins.features(camera, spp=16)
    # Both trace the same regular grid up to float32, and meet the same triangles but at edges.
    assert np.mean(np.abs(features[0].albedo - features[1].albedo) > 1e-4) < 0.01
    assert np.mean(np.abs(features[0].normal - features[1].normal) > 1e-4) < 0.01
    assert (tracer.hits(camera) != plugins.hits(camera)).sum() <= 1


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
    said = printed_by(_IN_SCALAR)
    means, num_hits = json.loads(said)
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


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40).filter(lambda values: sum(values) > 0))
def test_the_alias_table_gives_each_row_its_share(power: list[float]) -> None:
    share = np.array(power) / sum(power)
    keep, alias = alias_table(share)
    assert ((keep >= 0) & (keep <= 1)).all()
    picked = keep / len(share)
    np.add.at(picked, alias, (1 - keep) / len(share))
    # Each of up to 40 subtractions rounds to 1e-16 of a value of at most 40.
    np.testing.assert_allclose(picked, share, atol=1e-13)


@pytest.mark.usefixtures("llvm")
def test_sampled_points_lie_on_their_triangle_and_come_by_power() -> None:
    triangles = np.random.default_rng(1).normal(size=(3, 3, 3))
    strengths = [1.0, 30.0, 5.0]
    floor = quad([[-1, -1, -9], [1, -1, -9], [1, 1, -9], [-1, 1, -9]], material(diffuse=0.5))
    scene = join([floor, *(light(t, s) for t, s in zip(triangles, strengths, strict=True))])
    rows = np.flatnonzero(scene.triangle_emits)
    table = EmitterTable(scene, rows)
    side = 800
    grid = (np.arange(side) + 0.5) / side
    u = mi.Point2f(mi.Float(np.repeat(grid, side)), mi.Float(np.tile(grid, side)))
    point = table.sample(u, mi.Bool(True))
    dr.eval(point.position, point.radiance, point.area_pdf)
    radiance = np.array(point.radiance)[0]
    position = np.array(point.position).T.astype(np.float64)
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(edge1, edge2)
    area = np.linalg.norm(normal, axis=1) / 2
    share = area * strengths / (area * strengths).sum()
    for row, strength in enumerate(strengths):
        mine = radiance == np.float32(strength)
        # A row's part of the picking variable has at most four ends, each within a stratum.
        assert abs(mine.mean() - share[row]) < 4 / side
        edges = np.stack([edge1[row], edge2[row]])
        offset = position[mine] - triangles[row, 0]
        weights = np.linalg.lstsq(edges.T, offset.T, rcond=None)[0]
        back = triangles[row, 0] + weights.T @ edges
        # Float32 positions of size about 3.
        np.testing.assert_allclose(back, position[mine], atol=2e-6)
        assert (weights > -1e-5).all() and (weights.sum(0) < 1 + 1e-5).all()
        np.testing.assert_allclose(
            np.array(point.area_pdf)[mine], share[row] / area[row], rtol=1e-5
        )
        # Uniform on the triangle: the mean point is the centroid, as far as the row's strata tell.
        np.testing.assert_allclose(weights.mean(1), 1 / 3, atol=1 / (side * share[row]))
