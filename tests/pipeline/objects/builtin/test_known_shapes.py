"""Built-in families of one surface, with volumes that are known on paper."""

import itertools

import numpy as np
import pytest

from pipeline.objects.builtin.gear import GearParams, gear
from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.lattice import LatticeParams, lattice
from pipeline.objects.builtin.rock import RockParams, rock
from pipeline.objects.builtin.shell import ShellParams, shell
from pipeline.objects.builtin.superquadric import SuperquadricParams, superquadric
from pipeline.objects.builtin.torus_knot import TorusKnotParams, torus_knot
from pipeline.objects.builtin.vase import VaseParams, vase
from tests.for_each import for_each
from tests.pipeline.objects.builtin.test_builtin import is_closed, parts_of, volume


def _superquadric(profile: float, plan: float, **changes: float) -> Mesh:
    shape = {"taper": 0.0, "twist_rad": 0.0} | changes
    return superquadric(
        SuperquadricParams(
            exponent_profile=profile,
            exponent_plan=plan,
            half_sizes=(1.0, 0.8, 0.5),
            rings=63,
            columns=64,
            **shape,
        )
    )


@pytest.mark.parametrize(
    ("profile", "plan", "share", "tolerance"),
    [
        # Shares of the box: pi / 6, 1 / 6 and 1; inscribed polyhedra of 64 x 64 miss about 0.3 %,
        # and an exponent of 0.01 is a box but for 2 % of its edges.
        (1.0, 1.0, np.pi / 6, 0.004),
        (2.0, 2.0, 1 / 6, 0.004),
        (0.01, 0.01, 1.0, 0.02),
    ],
)
def test_superquadrics_have_known_volumes(
    profile: float, plan: float, share: float, tolerance: float
) -> None:
    expected = share * 2.0 * 1.6 * 1.0
    assert volume(_superquadric(profile, plan)) == pytest.approx(expected, rel=tolerance)


def _ring(windings: tuple[int, int], **changes: int) -> TorusKnotParams:
    return TorusKnotParams(
        windings=windings,
        minor_radius=0.4,
        fill=0.95,
        ribs=0,
        rib_depth=0.3,
        rib_turns=0,
        flatten=1.0,
        **({"segments": 256, "sides": 48} | changes),
    )


def test_the_unknot_is_a_torus_of_known_volume() -> None:
    positions, faces = torus_knot(_ring((1, 0)))
    tube = (np.ptp(positions[:, 2])) / 2
    centre = 1.4
    # Pappus: area of the section times the way of its centre; 48-gons miss 0.3 %.
    expected = np.pi * tube**2 * 2 * np.pi * centre
    assert volume((positions, faces)) == pytest.approx(expected, rel=0.005)


@for_each("windings", [(2, 3), (3, 2), (2, 5), (3, 4), (1, 5), (4, 3), (5, 2)])
def test_strands_of_a_knot_do_not_meet(windings: tuple[int, int]) -> None:
    params = _ring(windings, segments=240, sides=8)
    positions, _ = torus_knot(params)
    rings = positions.reshape(240, 8, 3)
    centre = rings.mean(axis=1)
    tube = np.linalg.norm(rings - centre[:, None], axis=2).max()
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    apart = np.abs(np.arange(240)[:, None] - np.arange(240)[None])
    apart = np.minimum(apart, 240 - apart)
    step = np.linalg.norm(centre - np.roll(centre, 1, axis=0), axis=1).min()
    far_along = apart * step > np.pi * tube
    assert distance[far_along].min() > 2 * tube * 0.99


def _gear(**changes: float) -> Mesh:
    shape = {
        "teeth": 12, "tooth_depth": 0.2, "half_thickness": 0.2, "chamfer": 0.0, "bore": 0.2,
        "hub_width": 0.1, "hub_height": 1.0, "rim_width": 0.15, "web_height": 1.0,
        "helix_rad": 0.0, "cone": 0.0,
    }  # fmt: skip
    return gear(GearParams(**(shape | changes)))  # type: ignore[arg-type]


def test_a_plain_gear_is_its_outline_times_its_thickness() -> None:
    mesh = _gear()
    tip = mesh[0].reshape(72, -1, 3)[:, 0, :2]
    x, y = tip.T
    outline = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    # The bore is a regular polygon of 72 corners.
    bore = 0.5 * 72 * 0.2**2 * np.sin(2 * np.pi / 72)
    assert volume(mesh) == pytest.approx(0.4 * (outline - bore), rel=1e-9)


def test_the_wall_of_a_vase_is_even() -> None:
    params = VaseParams(
        height=1.0, radii=(0.3, 0.5, 0.2, 0.4), wall=0.05, flutes=0, flute_depth=0.0,
        swirl_rad=0.0, rings=200, columns=8,
    )  # fmt: skip
    rings = vase(params)[0][:-2].reshape(400, 8, 3)
    radius, height = np.linalg.norm(rings[:, 0, :2], axis=1), rings[:, 0, 2]
    inner = slice(399, 199, -1)
    outside = np.interp(height[inner], height[:200], radius[:200])
    # Linear interpolation between 200 rings of a curve of unit height: 1e-4.
    np.testing.assert_allclose(outside - radius[inner], 0.05, atol=1e-4)


def test_a_straight_vase_is_a_cup_of_known_volume() -> None:
    params = VaseParams(
        height=1.0,
        radii=(0.5, 0.5, 0.5, 0.5),
        wall=0.05,
        flutes=0,
        flute_depth=0.3,
        swirl_rad=0.4,
        rings=16,
        columns=96,
    )
    polygon = 0.5 * 96 * np.sin(2 * np.pi / 96)
    expected = polygon * (0.5**2 * 1.0 - 0.45**2 * 0.95)
    assert volume(vase(params)) == pytest.approx(expected, rel=1e-9)


CUBE = tuple(
    (*(float(sign * (axis == other)) for other in range(3)), 0.5)
    for axis in range(3)
    for sign in (-1, 1)
)


def _rock(**changes: object) -> Mesh:
    shape = {
        "cuts": CUBE, "sharpness": 200.0, "bumps": (), "bump_height": 0.2, "layers": 0.0,
        "layer_depth": 0.1, "half_sizes": (1.0, 1.0, 1.0), "frequency": 24,
    }  # fmt: skip
    return rock(RockParams(**(shape | changes)))  # type: ignore[arg-type]


def test_six_cuts_make_a_cube() -> None:
    mesh = _rock()
    # Faces of a 24th of a side cut across edges, and these are rounded by a two hundredth.
    assert volume(mesh) == pytest.approx(1.0, rel=0.03)
    np.testing.assert_allclose(np.ptp(mesh[0], axis=0), 1.0, rtol=0.01)


def _shell(**changes: float) -> Mesh:
    shape = {
        "turns": 3.0, "growth": 2.0, "drop": 1.0, "tube": 0.6, "stretch": 1.2, "ribs": 8,
        "rib_height": 0.1, "cords": 0, "cord_height": 0.1, "spines": 1.0, "wall": 0.1,
        "lean_rad": 0.0, "rings_per_turn": 20, "columns": 16,
    }  # fmt: skip
    return shell(ShellParams(**(shape | changes)))  # type: ignore[arg-type]


def test_a_shell_is_a_larger_copy_of_itself_some_rings_before() -> None:
    outer = _shell(ribs=0, cords=4)[0][:-2].reshape(-1, 16, 3)[:60]
    # 60 rings from the tip to the mouth are 59 steps of three turns.
    turns = 20 * 3.0 / 59
    cosine, sine = np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)
    turned = outer[:-20] @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    np.testing.assert_allclose(turned * 2.0**turns, outer[20:], atol=1e-12)


def _lattice(cells: tuple[int, int, int], **changes: object) -> Mesh:
    shape = {
        "half_sizes": (1.0, 0.8, 0.6), "bar": 0.25, "hollow": False, "crate": False, "splits": 1,
        "roundness": 0.0, "taper": 0.0, "twist_rad": 0.0, "bend_rad": 0.0,
    }  # fmt: skip
    return lattice(LatticeParams(cells=cells, **(shape | changes)))  # type: ignore[arg-type]


def _graph(x: int, y: int, z: int) -> tuple[int, int]:
    """Crossings and bars of a lattice."""
    bars = x * (y + 1) * (z + 1) + y * (x + 1) * (z + 1) + z * (x + 1) * (y + 1)
    return (x + 1) * (y + 1) * (z + 1), bars


@for_each(
    "cells, splits",
    itertools.product([(1, 1, 1), (2, 1, 3), (3, 3, 2), (4, 0, 3), (1, 0, 1)], [1, 3]),
)
def test_a_lattice_has_the_genus_of_its_graph(cells: tuple[int, int, int], splits: int) -> None:
    mesh = _lattice(cells, splits=splits)
    crossings, bars = _graph(*cells)
    assert is_closed(mesh) and len(parts_of(mesh)) == 1
    assert len(mesh[0]) - len(mesh[1]) // 2 == 2 * (crossings - bars)
    # Every side of every piece of a bar is a quad, and so is every side of a crossing without bar.
    assert len(mesh[1]) == 2 * (4 * bars * splits + 6 * crossings - 2 * bars)


def test_a_lattice_has_the_volume_of_its_bars() -> None:
    mesh = _lattice((2, 1, 3))
    crossings, _ = _graph(2, 1, 3)
    count = np.array([2, 1, 3])
    step = 2 * np.array([1.0, 0.8, 0.6]) / (count + 0.25)
    cube = np.prod(0.25 * step)
    # A bar is three times as long as a crossing, along its axis.
    expected = cube * (crossings + 3 * _graph(2, 1, 3)[1])
    assert volume(mesh) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(np.ptp(mesh[0], axis=0), [2.0, 1.6, 1.2])


def test_a_hollow_lattice_and_a_crate_have_nothing_inside() -> None:
    full, hollow = _lattice((3, 3, 3)), _lattice((3, 3, 3), hollow=True)
    # Inside are 8 crossings, 4 bars along each axis between them, and 24 that lead to them.
    lost = (8 + 3 * (12 + 24)) * np.prod(0.25 * 2 * np.array([1.0, 0.8, 0.6]) / 3.25)
    assert volume(full) - volume(hollow) == pytest.approx(lost, rel=1e-9)
    crate = _lattice((3, 3, 3), hollow=True, crate=True)
    assert is_closed(crate)
    inside = (np.abs(crate[0][:, :2] / [1.0, 0.8]) < 0.7).all(axis=1)
    assert inside.any() and crate[0][inside, 2].max() < -0.4
    assert np.isclose(crate[0].max(axis=0), [1.0, 0.8, 0.6]).all()
    # Its rim has no bars across, but all its crossings: two triangles for each cell looking up.
    a, b, c = crate[0][crate[1]].transpose(1, 0, 2)
    up = (np.cross(b - a, c - a)[:, 2] > 0) & (a[:, 2] > 0.59)
    assert up.sum() == 2 * 4 * (3 + 3)
