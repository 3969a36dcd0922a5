"""Sums of parts inside kernels: the same samples, each counted in the part that it belongs to."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.tracer import Tracer
from storage.records.parts import part_names
from storage.records.scene import Scene
from tests.pipeline.renders.guided_scenes import lit_by_a_mirror, mirrors
from tests.pipeline.renders.sampling import (
    Estimate,
    assert_agree,
    camera_of,
    exact,
    render_blocks,
)
from tests.pipeline.renders.scene_kit import box, furnace, join, light, material, quad

pytestmark = pytest.mark.usefixtures("llvm")

KINDS = [(True, False), (False, True), (True, True)]
FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
LAMP = [[-0.3, -1.5, 2], [0.3, -1.5, 2], [0, -1, 2.2]]


def _tracer(scene: Scene, *, bounces: bool, lobes: bool, max_depth: int = 10) -> Tracer:
    tracer = load_tracer(scene, max_depth=max_depth, rr_depth=2)
    return tracer.apart(bounces=bounces, lobes=lobes)


def _passes(
    scene: Scene,
    tracer: Tracer,
    *,
    bounces: bool,
    lobes: bool,
    seeds: int = 1,
    resolution: int = 32,
) -> dict[str, NDArray[np.float64]]:
    """Return independent passes of 64 samples by part, [seeds, R, R, 3]."""
    found = []
    for seed in range(seeds):
        total = tracer.pass_sum(camera_of(scene, resolution))
        total.add(seed=seed, spp=64)
        found.append(total.read() / 64)
    return dict(zip(part_names(bounces=bounces, lobes=lobes), np.stack(found, axis=1), strict=True))


def _blocks(passes: NDArray[np.float64]) -> Estimate:
    """Return the means of 4 x 4 pixels with their errors, from the passes."""
    count, width = len(passes), passes.shape[1] // 4
    blocks = passes.reshape(count, width, 4, width, 4, 3).mean(axis=(2, 4))
    return Estimate(mean=blocks.mean(axis=0), error=blocks.std(axis=0, ddof=1) / np.sqrt(count))


@pytest.mark.parametrize(
    ("bounces", "lobes", "guided"),
    [(True, False, False), (False, True, False), (True, True, True)],
)
def test_the_parts_add_up_to_the_picture_of_the_same_samples(
    bounces: bool, lobes: bool, guided: bool
) -> None:
    """But for roundings: a light path counts in whole units, everything else is float32."""
    scene = mirrors()
    chosen = np.random.default_rng(0).random((32, 32)) < 0.7
    sums = []
    for kind in ({"bounces": bounces, "lobes": lobes}, {"bounces": False, "lobes": False}):
        total = _tracer(scene, **kind).pass_sum(camera_of(scene, 32))
        if guided:
            total.guide()
        total.add(seed=3, spp=64, chosen=chosen)
        sums.append((total.read(), total.read_squares()))
    (parts, squares), (whole, squares_of_whole) = sums
    assert len(parts) == (4 if bounces and lobes else 2) and len(whole) == 1
    assert parts.min() >= 0 and parts.mean(axis=(1, 2, 3)).min() > 0
    np.testing.assert_allclose(parts.sum(axis=0), whole[0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(squares, squares_of_whole, rtol=1e-5, atol=1e-8)


def test_direct_light_is_what_paths_of_two_edges_find() -> None:
    """The first bounce has the same random numbers, whatever comes after it."""
    scene = mirrors()
    kind = {"bounces": True, "lobes": False}
    parts = _passes(scene, _tracer(scene, **kind), **kind)
    short = load_tracer(scene, max_depth=2, rr_depth=2)
    whole = short.radiance(camera_of(scene, 32), seed=0, spp=64)
    # a mean of 64 samples in float32
    np.testing.assert_allclose(parts["direct"][0], whole, rtol=1e-5, atol=1e-7)
    none = _passes(scene, _tracer(scene, max_depth=2, **kind), **kind)
    np.testing.assert_array_equal(none["indirect"], 0)
    assert parts["indirect"].mean() > 0.1 * parts["direct"].mean()


@pytest.mark.slow("statistics")
def test_mitsuba_finds_the_same_direct_and_indirect_light() -> None:
    """Its stock integrator with two edges, and with all less that; rough, so that both agree."""
    from tests.oracle.plugin_tracer import PluginTracer

    grey, rough = material(diffuse=0.6), material(diffuse=0.3, specular=0.4, roughness=0.6)
    wall = quad([[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]], material(diffuse=[0.7, 0.2, 0.1]))
    parts = [quad(FLOOR, grey), wall, box([0.2, 0, 0.3], 0.5, rough, 0.3), light(LAMP, 20.0)]
    scene = join(parts, eye=(0.5, -3, 1.5), target=(0, 0, 0.5))
    kind = {"bounces": True, "lobes": False}
    ours = _passes(scene, _tracer(scene, **kind), **kind, seeds=16, resolution=16)
    short, long = (
        render_blocks(
            scene,
            resolution=16,
            first_seed=50,
            tracer=PluginTracer(scene, max_depth=depth, rr_depth=5),
        )
        for depth in (2, 10)
    )
    # the Smith term of rough lobes differs by up to 2 % of what the specular one reflects
    assert_agree(_blocks(ours["direct"]), short, slack=0.01)
    rest = Estimate(mean=long.mean - short.mean, error=np.hypot(long.error, short.error))
    assert_agree(_blocks(ours["indirect"]), rest, slack=0.01)


def test_in_a_furnace_each_lobe_shows_its_albedo_by_direct_light_alone() -> None:
    """A convex body in an even glow: no light reaches it by way of another surface."""
    diffuse, specular = [0.5, 0.3, 0.1], [0.2, 0.4, 0.6]
    body = box([0, 0, 0], 0.8, material(diffuse=diffuse, specular=specular, roughness=0.1), 0.5)
    scene = join([body, furnace()], eye=(0, -1.5, 0.8), fov_deg=15)
    kind = {"bounces": True, "lobes": True}
    found = _passes(scene, _tracer(scene, **kind), **kind, seeds=16, resolution=8)
    for name in ("diffuse_indirect", "specular_indirect"):
        np.testing.assert_array_equal(found[name], 0)
    for name, albedo in (("diffuse_direct", diffuse), ("specular_direct", specular)):
        # so smooth a lobe loses 0.2 % to its own shadows, of which colour keeps a part
        assert_agree(_blocks(found[name]), exact(np.broadcast_to(albedo, (2, 2, 3))), slack=0.005)


def test_a_surface_without_a_lobe_has_none_of_its_light() -> None:
    """A matt and a metal half of the floor, which light each other by way of a wall."""
    left = quad([[-1, -1, 0], [0, -1, 0], [0, 1, 0], [-1, 1, 0]], material(diffuse=0.7))
    metal = material(specular=[0.9, 0.7, 0.4], roughness=0.3)
    right = quad([[0, -1, 0], [1, -1, 0], [1, 1, 0], [0, 1, 0]], metal)
    wall = quad([[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]], material(diffuse=0.5, specular=0.4))
    scene = join([left, right, wall, light(LAMP, 20.0)], eye=(0, -0.5, 3), fov_deg=24)
    kind = {"bounces": True, "lobes": True}
    found = {name: part[0] for name, part in _passes(scene, _tracer(scene, **kind), **kind).items()}
    matt, shiny = np.s_[:, :15], np.s_[:, 17:]  # the seam is in the middle of the picture
    for bounce in ("direct", "indirect"):
        np.testing.assert_array_equal(found[f"specular_{bounce}"][matt], 0)
        np.testing.assert_array_equal(found[f"diffuse_{bounce}"][shiny], 0)
        assert found[f"diffuse_{bounce}"][matt].mean() > 1e-3
        assert found[f"specular_{bounce}"][shiny].mean() > 1e-3


def test_where_no_lamp_is_in_sight_all_light_is_indirect() -> None:
    scene = lit_by_a_mirror(0.1)
    kind = {"bounces": True, "lobes": False}
    found = _passes(scene, _tracer(scene, **kind), **kind)
    in_sight = found["direct"][0].max(axis=-1) > 0
    assert in_sight.mean() < 0.2  # the mirror alone sees the lamp in its box
    assert found["indirect"][0][~in_sight].mean() > 1e-3


def test_a_lone_floor_has_direct_light_alone() -> None:
    scene = join([quad(FLOOR, material(diffuse=0.5)), light(LAMP, 20.0)], eye=(0, -2, 2))
    for bounces, lobes in KINDS:
        kind = {"bounces": bounces, "lobes": lobes}
        found = _passes(scene, _tracer(scene, **kind), **kind)
        for name, part in found.items():
            if "indirect" in name or "specular" in name:
                np.testing.assert_array_equal(part, 0)
            else:
                assert part.mean() > 0.01


def test_kernels_of_other_parts_are_apart() -> None:
    """One process may trace all kinds of one scene, in any order."""
    scene = mirrors()
    kinds = [(False, False), *KINDS]
    wholes: dict[tuple[bool, bool], NDArray[np.float32]] = {}
    for bounces, lobes in itertools.chain(kinds, reversed(kinds)):
        tracer = _tracer(scene, bounces=bounces, lobes=lobes)
        picture = tracer.radiance(camera_of(scene, 16), seed=1, spp=16)
        np.testing.assert_array_equal(picture, wholes.setdefault((bounces, lobes), picture))
        np.testing.assert_allclose(picture, wholes[False, False], rtol=1e-5, atol=1e-6)
