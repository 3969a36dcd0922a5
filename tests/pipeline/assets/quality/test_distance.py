"""Distances against known answers, and against a slow twin."""

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.distance import Surface, sample_surface
from tests.pipeline.assets.meshes_by_hand import knot, sphere

UNIFORM = np.random.default_rng(0).random((4000, 3))


def p99(mesh: TriangleMesh, other: TriangleMesh) -> float:
    return Surface(mesh, UNIFORM).deviation(other).two_way(99)


def square(height: float = 0.0, size: float = 1.0) -> TriangleMesh:
    outline = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    corners = np.column_stack([outline, np.full(4, height)])
    return TriangleMesh(positions=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]))


def slow_distance(point: np.ndarray, mesh: TriangleMesh, steps: int = 60) -> float:
    """The nearest of many points on every triangle: never too small, and off by a step at most."""
    grid = [(i / steps, j / steps) for i in range(steps + 1) for j in range(steps + 1 - i)]
    weights = np.array([(1 - a - b, a, b) for a, b in grid])
    places = np.einsum("gk,fkc->fgc", weights, mesh.corners).reshape(-1, 3)
    return float(np.linalg.norm(places - point, axis=1).min())


def test_a_surface_is_at_no_distance_from_itself() -> None:
    # Points are interpolated in double precision: 1e-12 of a unit-sized mesh is far above rounding.
    assert p99(knot(), knot()) < 1e-12


@pytest.mark.parametrize("height", [0.01, 0.25])
def test_parallel_squares_are_as_far_as_they_are(height: float) -> None:
    expected = height / np.sqrt(2)
    assert p99(square(), square(height)) == pytest.approx(expected, rel=1e-9)


def test_what_only_one_of_them_has_counts_both_ways() -> None:
    small, large = square(), square(size=1.5)
    # From the large square, the farthest one percent lies near the corner sqrt(0.5) away.
    from_small = p99(small, large) * np.sqrt(2)
    from_large = p99(large, small) * np.sqrt(4.5)
    assert 0.5 < from_small < np.sqrt(0.5)
    assert from_large == pytest.approx(from_small, rel=1e-9)


def test_scale_does_not_matter() -> None:
    mesh, other = knot(), knot(segments=40)
    error = p99(mesh, other)
    grown = [TriangleMesh(positions=m.positions * 8, faces=m.faces) for m in (mesh, other)]
    assert p99(*grown) == pytest.approx(error, rel=1e-12)


def test_it_agrees_with_the_slow_twin() -> None:
    mesh, other = sphere(rings=5, columns=8), knot(segments=12, sides=4)
    fast = Surface(mesh, UNIFORM[:40]).deviation(other).there
    points = sample_surface(mesh, UNIFORM[:40]).positions
    slow = np.array([slow_distance(point, other) for point in points]) / mesh.diagonal
    assert (fast <= slow + 1e-12).all()
    # The twin's points are up to a sixtieth of an edge apart; edges are below half a diagonal.
    np.testing.assert_allclose(fast, slow, atol=0.5 / 60)


def test_samples_fall_on_faces_by_area() -> None:
    mesh = knot()
    shares = np.linalg.norm(mesh.double_area_vectors, axis=1)
    upper = mesh.corners[:, :, 2].mean(axis=1) > 0
    points = sample_surface(mesh, UNIFORM).positions
    expected = shares[upper].sum() / shares.sum()
    # Stratified by area: the share is exact to the faces that the plane cuts, about one in fifty.
    assert (points[:, 2] > 0).mean() == pytest.approx(expected, abs=0.02)


def test_samples_fill_a_face_evenly() -> None:
    triangle = TriangleMesh(positions=np.diag([1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2]]))
    weights = sample_surface(triangle, UNIFORM).positions / [1, 2, 3]
    # Barycentric coordinates of even points: mean 1/3, variance 1/18, covariance -1/36. Of 4000
    # points the mean is known to 0.004 and the variance to about 2 % (one sigma); 4 sigma allowed.
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3, atol=0.015)
    np.testing.assert_allclose(np.cov(weights.T), (np.eye(3) / 12 - 1 / 36), atol=0.08 / 18)
