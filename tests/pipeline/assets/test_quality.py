"""Every measure against a known answer, or against a slow and obvious twin."""

import math
from collections import Counter

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.distance import Surface
from pipeline.assets.quality.measure import MeasuredSource
from pipeline.assets.quality.parts import Parts, label_parts
from pipeline.assets.quality.silhouette import intersection_over_union, silhouette
from pipeline.assets.quality.triangles import area_variation, count_edges, smallest_angles_deg
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import cleaned, cube, joined, knot, moved, sphere
from tests.pipeline.assets.quality.test_gate import sheet

UNIFORM = np.random.default_rng(0).random((8192, 3))

FAN = TriangleMesh(
    positions=np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 2, 0], [-3, 0, 0.5]], float),
    faces=np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]),
)
"""Three pages on one edge."""

MESHES = {"knot": knot(20, 6), "cube": cube(2), "fan": FAN, "sheet": sheet(30.0, cells=6)}


def angles_of(corners: list[list[float]]) -> list[float]:
    angles = []
    for k in range(3):
        here, left, right = (corners[(k + step) % 3] for step in range(3))
        a = [p - q for p, q in zip(left, here, strict=True)]
        b = [p - q for p, q in zip(right, here, strict=True)]
        cosine = sum(p * q for p, q in zip(a, b, strict=True)) / math.hypot(*a) / math.hypot(*b)
        angles.append(math.degrees(math.acos(cosine)))
    return angles


@for_each("name", MESHES)
def test_smallest_angles(name: str) -> None:
    mesh = MESHES[name]
    slow = [min(angles_of(corners)) for corners in mesh.corners.tolist()]
    np.testing.assert_allclose(smallest_angles_deg(mesh), slow, rtol=1e-9)  # double precision


def test_angles_of_known_triangles() -> None:
    equilateral = np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    sliver = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0]])
    mesh = TriangleMesh(
        positions=np.concatenate([equilateral, sliver]), faces=np.arange(6).reshape(2, 3)
    )
    # The cosine of the second angle is 1 - 2e-12: the difference is known to 1e-4 of itself.
    expected = [60.0, np.degrees(2e-6)]
    np.testing.assert_allclose(smallest_angles_deg(mesh), expected, rtol=1e-3)


@for_each("name", MESHES)
def test_area_variation(name: str) -> None:
    areas = []
    for a, b, c in MESHES[name].corners.tolist():
        sides = [math.dist(a, b), math.dist(b, c), math.dist(c, a)]
        half = sum(sides) / 2
        areas.append(math.sqrt(half * math.prod(half - side for side in sides)))
    mean = sum(areas) / len(areas)
    expected = math.sqrt(sum((area - mean) ** 2 for area in areas) / len(areas)) / mean
    # Heron's formula loses half of the digits on flat triangles.
    assert area_variation(MESHES[name]) == pytest.approx(expected, rel=1e-6, abs=1e-7)


@for_each(
    ("name", "expected"),
    [
        ("knot", (0, 0, 2)),
        ("cube", (48, 0, 2)),
        ("fan", (6, 1, 3)),
        ("sheet", (24, 0, 2)),
    ],
)
def test_edges(name: str, expected: tuple[int, int, int]) -> None:
    mesh = MESHES[name]
    shared = Counter(
        frozenset(pair) for a, b, c in mesh.faces.tolist() for pair in ((a, b), (b, c), (c, a))
    )
    slow = (
        sum(count == 1 for count in shared.values()),
        sum(count > 2 for count in shared.values()),
        max(shared.values()),
    )
    edges = count_edges(mesh)
    assert (edges.open, edges.nonmanifold, edges.most_faces) == slow == expected


def test_a_welded_cube_is_closed() -> None:
    edges = count_edges(cleaned(cube(2)))
    assert (edges.open, edges.nonmanifold, edges.most_faces) == (0, 0, 2)


def test_the_outline_of_a_half_is_half_an_outline() -> None:
    whole = sheet(0.0)
    half = TriangleMesh(positions=whole.positions, faces=whole.faces[: len(whole.faces) // 2])
    agreement = intersection_over_union(silhouette(whole), silhouette(half))
    # 8 bundles of rays 2.8 % apart: the cut goes between rows of about 35, on either side of it.
    assert agreement == pytest.approx(0.5, abs=0.02)
    assert intersection_over_union(silhouette(half), silhouette(whole)) == agreement
    assert intersection_over_union(silhouette(whole), silhouette(whole)) == 1


def test_the_outline_agrees_with_a_disc_counted_by_hand() -> None:
    ball = moved(sphere(61, 96), [0.5, 0.5 / 0.8, 0.5 / 0.6])
    hits = silhouette(ball).mean()
    # A disc of radius 0.5 in a bundle 1.8 wide; 64 x 64 rays count it to about one row in 35.
    assert hits == pytest.approx(np.pi * 0.25 / 1.8**2, rel=0.03)


def with_grain(share: float) -> tuple[TriangleMesh, TriangleMesh]:
    """A ball, and the same with a cube beside it that holds a share of its area."""
    ball = cleaned(moved(sphere(31, 48), [1, 1 / 0.8, 1 / 0.6]))
    area = 0.5 * float(np.linalg.norm(ball.double_area_vectors, axis=1).sum())
    side = np.sqrt(share * area / 6)
    return ball, joined(ball, moved(cube(), side, [0.7, 0, 0]))


def test_a_small_part_that_vanishes_is_missed_by_the_distance_and_not_by_its_name() -> None:
    ball, both = with_grain(0.005)
    quality = MeasuredSource(both).quality(ball)
    assert quality.error_p99 < 1e-6
    assert quality.error_max > 0.1
    # One point in 8192 more or less: the sample is stratified by area.
    assert quality.lost_area == pytest.approx(0.005 / 1.005, abs=3 / 8192)
    assert MeasuredSource(both).quality(both).lost_area == 0


def test_a_part_that_is_merely_coarser_is_not_lost() -> None:
    ball, both = with_grain(0.02)
    box = joined(ball, moved(cube(), 0.095, [0.705, 0, 0]))
    assert 0 < MeasuredSource(both).quality(box).error_max
    assert MeasuredSource(both).quality(box).lost_area == 0


def test_parts_hang_together_over_edges() -> None:
    three = cleaned(joined(knot(20, 6), moved(cube(), 1, 5), moved(cube(), 1, -5)))
    assert len(np.unique(label_parts(three))) == 3
    assert Parts(Surface(three, UNIFORM)).count == 3


@pytest.mark.parametrize("slope_deg", [10.0, 30.0, 45.0])
def test_normals_of_a_corrugated_sheet_are_off_by_its_slope(slope_deg: float) -> None:
    quality = MeasuredSource(sheet(slope_deg)).quality(sheet(0.0))
    # Every face has the slope exactly; tan and arccos in double precision, stored with six digits.
    assert quality.normal_error_deg == pytest.approx(slope_deg, rel=1e-5)
    assert quality.area_ratio == pytest.approx(np.cos(np.radians(slope_deg)), rel=1e-5)


def test_concentric_spheres_are_as_far_apart_as_their_radii() -> None:
    ball = moved(sphere(61, 96), [0.5, 0.5 / 0.8, 0.5 / 0.6])
    deviation = Surface(ball, UNIFORM).deviation(moved(ball, 1.04))
    # Facets of 2 pi / 96 sag by 1 - cos(pi / 96) = 0.05 % of the radius, against 4 %.
    for way in (deviation.there, deviation.back):
        np.testing.assert_allclose(way * ball.diagonal, 0.02, rtol=0.05)
    assert deviation.two_way(99) >= deviation.two_way(50)
