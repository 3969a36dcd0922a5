"""Rocks, shells and lattices: what is known of them on paper."""

import itertools

import numpy as np
import pytest

from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.lattice import LatticeParams, lattice
from pipeline.objects.builtin.rock import RockParams, rock
from pipeline.objects.builtin.shell import ShellParams, shell
from tests.for_each import for_each
from tests.pipeline.objects.builtin.test_builtin import is_closed, parts_of, volume

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


def test_edges_are_rounder_where_less_sharp() -> None:
    sizes = [volume(_rock(sharpness=sharpness)) for sharpness in (6.0, 20.0, 60.0, 200.0)]
    assert sizes == sorted(sizes) and sizes[0] < 0.9 * sizes[-1]


def test_joints_between_layers_cut_back() -> None:
    plain, layered = _rock(), _rock(layers=3.0)
    before, after = (np.linalg.norm(mesh[0], axis=1) for mesh in (plain, layered))
    assert (after <= before).all() and (after > 0.89 * before).all()
    assert (after < 0.95 * before).any()
    # Three layers per radius meet at heights of 0 and a third, where x is 0; elsewhere they lean.
    side = (np.abs(plain[0][:, 1] - 0.5) < 0.01) & (np.abs(plain[0][:, 0]) < 0.05)
    height, cut = plain[0][side, 2], (after / before)[side]
    assert cut[np.abs(height) < 0.02].max() < 0.93 < 0.98 < cut[np.abs(height - 0.15) < 0.02].min()


def test_bumps_stay_within_their_height() -> None:
    waves = ((0.5, 0.2, 0.1, 0.0), (-0.3, 0.6, 0.2, 0.3))
    plain, bumpy = (np.linalg.norm(_rock(bumps=b)[0], axis=1) for b in ((), waves))
    ratio = bumpy / plain
    assert 0.8 <= ratio.min() < 0.95 and 1.05 < ratio.max() <= 1.2


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


def test_the_mouth_of_a_shell_is_open() -> None:
    positions = _shell(ribs=0)[0][:-2].reshape(-1, 16, 3)
    assert len(positions) == 60 + 10
    lip, inside = positions[59], positions[60]
    centre = lip.mean(axis=0)
    np.testing.assert_allclose(inside - centre, 0.9 * (lip - centre), atol=1e-12)
    assert volume(_shell(ribs=0)) < volume(_shell(ribs=0, wall=0.5))


def test_a_leaning_shell_is_the_same_shell() -> None:
    upright, lying = _shell(), _shell(lean_rad=np.pi / 2)
    np.testing.assert_allclose(
        np.ptp(lying[0], axis=0), np.ptp(upright[0], axis=0)[[0, 2, 1]], rtol=1e-12
    )
    assert volume(lying) == pytest.approx(volume(upright), rel=1e-9)


def test_ribs_cords_and_spines_add_to_the_outside() -> None:
    plain = volume(_shell(ribs=0))
    ribbed, spiny = volume(_shell(ribs=5, spines=0.0)), volume(_shell(ribs=5, spines=2.0))
    assert plain < ribbed < spiny
    assert plain < volume(_shell(ribs=0, cords=4))


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


def test_a_round_lattice_lies_in_its_ball() -> None:
    mesh = _lattice((4, 4, 4), roundness=1.0, hollow=True)
    radius = np.linalg.norm(mesh[0] / [1.0, 0.8, 0.6], axis=1)
    assert radius.max() == pytest.approx(1.0, rel=1e-12)
    assert radius.min() == pytest.approx(1 - 2 * 0.25 / 4.25, rel=1e-12)


def test_a_bent_grille_lies_between_two_cylinders() -> None:
    mesh = _lattice((6, 0, 4), half_sizes=(1.0, 0.05, 0.7), bend_rad=2.0, splits=2)
    radius = np.hypot(mesh[0][:, 0], mesh[0][:, 1] - 1.0)
    assert set(np.round(radius, 12)) == {0.95, 1.05}
    assert np.ptp(mesh[0][:, 0]) == pytest.approx(2 * 1.05 * np.sin(1.0), rel=1e-12)


@pytest.mark.parametrize("warp", [{"taper": -0.4}, {"twist_rad": 0.5}])
def test_warps_keep_the_surface_outward(warp: dict[str, float]) -> None:
    plain, warped = _lattice((2, 2, 3), splits=2), _lattice((2, 2, 3), splits=2, **warp)
    assert np.array_equal(plain[1], warped[1])
    # A taper's square averages to 1 + taper^2 / 3 and more on bars outside; a twist keeps volume.
    assert volume(warped) == pytest.approx(volume(plain), rel=0.12)
