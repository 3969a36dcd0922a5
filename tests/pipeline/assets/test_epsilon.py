"""Epsilon: the finest level is the smallest one that is near enough."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.settings import AssetSettings, GateSettings
from storage.errors import Rejected
from storage.records.asset import Level
from tests.pipeline.assets.meshes_by_hand import cube, grid_faces, knot, moved, prepare, write_obj

BUDGET = 1400


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_obj(tmp_path_factory.mktemp("knot") / "knot.obj", knot())


@cache
def finest(path: Path, epsilon: float | None, budgets: tuple[int, ...] = (BUDGET,)) -> Level:
    return prepare(path, AssetSettings(budgets=budgets, epsilon=epsilon)).levels[0]


def rung_below(faces: int) -> int:
    """The largest of the budgets that the search knows below a number of faces."""
    rungs = [round(BUDGET / 2 ** (k / 8)) for k in range(80)]
    return max(rung for rung in rungs if rung < faces)


def test_the_bound_is_kept_and_the_next_smaller_budget_breaks_it(path: Path) -> None:
    for epsilon in (0.003, 0.01):
        level = finest(path, epsilon)
        assert level.record.budget == BUDGET
        assert level.record.quality.error_p99 <= epsilon
        smaller = finest(path, None, (rung_below(len(level.faces)),))
        assert len(smaller.faces) < len(level.faces)
        assert smaller.record.quality.error_p99 > epsilon


def test_a_looser_bound_takes_no_more_faces(path: Path) -> None:
    sizes = [len(finest(path, epsilon).faces) for epsilon in (0.001, 0.003, 0.01, 0.03)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.2 * sizes[0]


def test_what_cannot_be_met_takes_the_whole_budget(path: Path) -> None:
    level = finest(path, 1e-5)
    # Edges take two faces each: the collapse stops at most one short.
    assert BUDGET - 1 <= len(level.faces) <= BUDGET
    assert level.record.quality.error_p99 > 1e-5


def test_epsilon_is_about_the_finest_level_only(path: Path) -> None:
    """Coarser levels keep their budgets, and one that the finest already meets is left out."""
    levels = prepare(path, AssetSettings(epsilon=0.01)).levels
    assert [level.record.budget for level in levels] == [1400, 340, 240]
    assert 340 < len(levels[0].faces) <= 500
    assert levels[0].record.quality.error_p99 <= 0.01


def test_the_gate_holds_whatever_epsilon_allows(path: Path) -> None:
    """Normals decide here: with and without their limit, the distance allows the same."""
    strict = GateSettings(max_normal_error_deg=11.0)
    loose = finest(path, 0.01)
    tight = prepare(path, AssetSettings(budgets=(BUDGET,), epsilon=0.01, gate=strict)).levels[0]
    assert loose.record.quality.normal_error_deg > 11.0 >= tight.record.quality.normal_error_deg
    assert len(tight.faces) > len(loose.faces)
    none = GateSettings(max_normal_error_deg=0.1)
    with pytest.raises(Rejected, match="normals_changed"):
        prepare(path, AssetSettings(budgets=(BUDGET,), epsilon=0.01, gate=none))


def subdivided_plane(cells: int) -> TriangleMesh:
    axis = np.linspace(0, 1, cells + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    return TriangleMesh(
        positions=np.column_stack([x, y, np.zeros(len(x))]), faces=grid_faces(cells, cells)
    )


@pytest.mark.parametrize(
    ("mesh", "most"),
    [(moved(cube(8), [1, 0.7, 0.4]), 24), (subdivided_plane(20), 16)],
    ids=["cuboid", "plane"],
)
def test_flat_parts_cost_next_to_nothing(tmp_path: Path, mesh: TriangleMesh, most: int) -> None:
    """Also of an object that is within the budget as it is."""
    assert len(mesh.faces) < BUDGET
    path = write_obj(tmp_path / "flat.obj", mesh)
    level = finest(path, 0.005)
    assert len(level.faces) <= most
    assert level.record.quality.error_p99 <= 0.005
    assert finest(path, None).record.method == "source"
