"""Parts of built-in objects, and those put together from them: furniture, trees, plants."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.solids import box, icosphere, lathe, tube
from tests.for_each import for_each
from tests.pipeline.objects.builtin.test_builtin import is_closed, made, parts_of, volume


def polygon(sides: int) -> float:
    """Area of a regular polygon in the unit circle."""
    return 0.5 * sides * float(np.sin(2 * np.pi / sides))


@for_each("frequency", [1, 2, 3, 7, 12])
def test_an_icosphere_is_an_even_ball(frequency: int) -> None:
    positions, faces = icosphere(frequency)
    assert len(faces) == 20 * frequency**2
    assert len(positions) == 10 * frequency**2 + 2
    assert is_closed((positions, faces))
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 1, rtol=1e-12)
    a, b, c = positions[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # Projection stretches the middle of a side most: less than 2.2 times for any frequency.
    assert area.max() < 2.2 * area.min()
    # An icosahedron lacks 0.395 of its ball, finer ones about 0.55 over the frequency's square.
    lack = 1 - volume((positions, faces)) / (4 / 3 * np.pi)
    assert 0.39 < lack * frequency**2 < 0.56


def test_a_lathed_outline_has_the_volume_of_its_frustums() -> None:
    outline = [(0.5, 0.0), (1.0, 0.3), (0.2, 1.0)]
    frustums = [
        (z1 - z0) / 3 * (r0 * r0 + r0 * r1 + r1 * r1) for (r0, z0), (r1, z1) in pairwise(outline)
    ]
    solid = lathe(outline, 12)
    # A ring is a dozen-sided polygon, whose frustums are exact.
    assert volume(solid) == pytest.approx(polygon(12) * sum(frustums), rel=1e-12)
    assert is_closed(solid)


def test_a_straight_tube_is_a_prism_in_any_direction() -> None:
    for end in np.array([[2.0, 0, 0], [0, 0, -3.0], [1, 2, 3]]):
        path = np.linspace(0, 1, 5)[:, None] * end
        bar = tube(path, np.full(5, 0.1), 7)
        expected = polygon(7) * 0.01 * np.linalg.norm(end)
        assert volume(bar) == pytest.approx(expected, rel=1e-9)
        assert is_closed(bar)


def test_a_box_is_cut_at_its_edges_only() -> None:
    half, cut = np.array([0.5, 0.3, 0.2]), 0.05
    positions, faces = box([1.0, 2.0, 3.0], half, cut)
    assert len(faces) == 44 and is_closed((positions, faces))
    np.testing.assert_allclose([positions.min(axis=0), positions.max(axis=0)],
                               [[0.5, 1.7, 2.8], [1.5, 2.3, 3.2]])  # fmt: skip
    # A bevel takes a prism of cut^2 / 2 from each of four edges per axis; at a corner two thirds
    # of the three prisms' last stretches overlap, which is at most cut^3 each.
    prisms = 4 * cut**2 / 2 * float((2 * half).sum())
    assert volume((positions, faces)) == pytest.approx(0.24 - prisms, abs=8 * cut**3)
    assert volume((positions, faces)) > 0.24 - prisms


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
