"""The gate: a spoilt result is refused by the name of what is wrong, a good one is measured."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.gate import check_level
from pipeline.assets.quality.measure import MeasuredSource
from pipeline.assets.settings import GateSettings
from storage.errors import Rejected
from storage.records.asset import LevelQuality
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    cleaned,
    cube,
    grid_faces,
    joined,
    knot,
    moved,
    sphere,
)

Spoil = Callable[[TriangleMesh], TriangleMesh]


def gate(
    source: TriangleMesh, result: TriangleMesh, **limits: float
) -> tuple[TriangleMesh, LevelQuality]:
    settings = GateSettings(**limits)  # type: ignore[arg-type]
    faces = len(result.faces)
    return check_level(result, MeasuredSource(source), faces, settings, settings.max_error_p99)


def with_vertex(mesh: TriangleMesh, place: list[float]) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[7] = place
    return TriangleMesh(positions=positions, faces=mesh.faces)


def some_faces(mesh: TriangleMesh, count: int) -> TriangleMesh:
    return TriangleMesh(positions=mesh.positions, faces=mesh.faces[:count])


def sheet(slope_deg: float, cells: int = 60) -> TriangleMesh:
    """A unit square, corrugated: rows go up and down by the slope, in folds a cell wide."""
    axis = np.linspace(-0.5, 0.5, cells + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    z = np.tan(np.radians(slope_deg)) / cells * (np.arange(len(x)) // (cells + 1) % 2)
    return TriangleMesh(positions=np.column_stack([x, y, z]), faces=grid_faces(cells, cells))


def rod() -> TriangleMesh:
    """As long as the box and a fortieth as thick."""
    return cleaned(moved(sphere(rings=31, columns=24), [1.0, 0.025 / 0.8, 0.025 / 0.6]))


def specked_ball() -> TriangleMesh:
    """A ball with sixteen dust grains that are 2 % of its area, a hundredth away from it."""
    ball = cleaned(moved(sphere(rings=31, columns=48), [1, 1 / 0.8, 1 / 0.6]))
    turn = np.arange(16) * np.pi / 8
    places = 0.52 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(16)])
    return joined(ball, *(moved(cube(), 0.026, place) for place in places))


BALL = cleaned(sphere())

SPOILT: dict[str, tuple[str, TriangleMesh, Spoil]] = {
    "nothing left": ("budget_missed", BALL, lambda mesh: some_faces(mesh, 0)),
    "not a number": ("nonfinite_result", BALL, lambda mesh: with_vertex(mesh, [0, np.nan, 0])),
    "flung": ("bbox_escaped", BALL, lambda mesh: with_vertex(mesh, [0, 0, 18])),
    "half": ("area_changed", BALL, lambda mesh: some_faces(mesh, len(mesh.faces) // 2)),
    "doubled": ("area_changed", BALL, lambda mesh: joined(mesh, moved(mesh, 0.999))),
    "shrunk": ("error_over_bound", BALL, lambda mesh: moved(mesh, 0.89)),
    "folded": ("normals_changed", sheet(0), lambda mesh: sheet(36.5)),
    "beside": ("silhouette_changed", rod(), lambda mesh: moved(mesh, 1.0, [0, 0.009, 0])),
    "dusted": ("parts_lost", specked_ball(), lambda mesh: some_faces(mesh, 2976)),
}


@for_each("name", SPOILT)
def test_the_gate_names_what_is_wrong(name: str) -> None:
    reason, source, spoil = SPOILT[name]
    with pytest.raises(Rejected) as caught:
        gate(source, spoil(source))
    assert caught.value.reason == reason
    assert caught.value.message.isprintable()


@pytest.mark.parametrize("name", ["folded", "beside", "dusted"])
def test_each_limit_alone_decides(name: str) -> None:
    """What is refused passes as soon as its own limit is lifted: no other one caught it."""
    reason, source, spoil = SPOILT[name]
    lifted = {
        "normals_changed": {"max_normal_error_deg": 90.0},
        "silhouette_changed": {"min_silhouette_iou": 0.01},
        "parts_lost": {"max_lost_area": 1.0},
    }[reason]
    gate(source, spoil(source), **lifted)


@for_each(("side", "axis"), itertools.product([-1, 1], [0, 1, 2]))
def test_a_vertex_may_leave_the_box_by_one_percent(side: int, axis: int) -> None:
    """Of the diagonal: rounded shapes bulge a little when their vertices are placed freely."""
    ball = BALL.positions
    end = int(np.argmax(side * ball[:, axis]))

    def pulled(share: float) -> TriangleMesh:
        positions = ball.copy()
        positions[end, axis] += side * share * BALL.diagonal
        return TriangleMesh(positions=positions, faces=BALL.faces)

    gate(BALL, pulled(0.009))
    with pytest.raises(Rejected, match="bbox_escaped"):
        gate(BALL, pulled(0.011))


def test_the_gate_counts_faces() -> None:
    settings = GateSettings()
    with pytest.raises(Rejected, match=f"budget_missed: {len(BALL.faces)} faces"):
        check_level(BALL, MeasuredSource(BALL), len(BALL.faces) - 1, settings, 0.03)


def test_faces_that_collapse_on_the_grid_do_not_count() -> None:
    """The result is cleaned before it is counted: a needle is no triangle."""
    needle = np.array([[0, 0, 1], [5, 5, 5]])
    dirty = TriangleMesh(positions=BALL.positions, faces=np.concatenate([BALL.faces, needle]))
    mesh, _ = check_level(dirty, MeasuredSource(BALL), len(BALL.faces), GateSettings(), 0.03)
    assert len(mesh.faces) == len(BALL.faces)


def test_a_level_that_is_its_source_has_nothing_to_regret() -> None:
    mesh, quality = gate(cleaned(knot()), cleaned(knot()))
    assert len(mesh.faces) == len(knot().faces)
    # Distances of a point to the face it lies on, and areas added in the same order.
    assert quality.error_max < 1e-14
    assert (quality.area_ratio, quality.silhouette_iou, quality.lost_area) == (1, 1, 0)
    # The arc cosine turns a rounding of 1e-16 next to 1 into 1e-8 radians.
    assert quality.normal_error_deg < 1e-4
    assert quality.open_edges == 0
