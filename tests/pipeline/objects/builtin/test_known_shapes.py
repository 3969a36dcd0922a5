"""Built-in families and their parts, with volumes that are known on paper."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.lattice import LatticeParams, lattice
from pipeline.objects.builtin.shell import ShellParams, shell
from pipeline.objects.builtin.superquadric import SuperquadricParams, superquadric
from pipeline.objects.builtin.torus_knot import TorusKnotParams, torus_knot
from tests.for_each import for_each
from tests.pipeline.objects.builtin.test_builtin import is_closed, made, parts_of, volume


def _overlap(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    """Whether two triangles [3, 2] share area: no edge of either separates them."""
    for one, other in ((first, second), (second, first)):
        edge = np.roll(one, -1, axis=0) - one
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        inner, outer = one @ normal.T, other @ normal.T
        gap = np.maximum(
            outer.min(axis=0) - inner.max(axis=0), inner.min(axis=0) - outer.max(axis=0)
        )
        # A hundredth of a millimetre of furniture: rounding is far below.
        if (gap > -1e-5).any():
            return False
    return True


def _shared_planes(mesh: Mesh) -> int:
    """Pairs of faces of different parts that look the same way from the same place."""
    parts = parts_of(mesh)
    corners = np.concatenate([positions[faces] for positions, faces in parts])
    owner = np.repeat(np.arange(len(parts)), [len(faces) for _, faces in parts])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = np.einsum("ij,ij->i", normal, corners[:, 0])
    _, plane = np.unique(
        np.rint(np.column_stack([normal, offset]) * 1e5), axis=0, return_inverse=True
    )
    count = 0
    for number in np.flatnonzero(np.bincount(plane.reshape(-1)) > 1):
        members = np.flatnonzero(plane.reshape(-1) == number)
        axes = np.delete(np.arange(3), np.abs(normal[members[0]]).argmax())
        flat = corners[members][..., axes]
        count += sum(
            _overlap(flat[i], flat[j])
            for i in range(len(members))
            for j in range(i)
            if owner[members[i]] != owner[members[j]]
        )
    return count


def test_no_two_boards_share_a_plane_where_they_meet() -> None:
    for number in range(16):
        assert _shared_planes(made("furniture", number)) == 0, number


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
