"""Laws of turning and scaling: numbers and errors survive what bytes cannot."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import GRID
from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.distance import Surface
from pipeline.assets.settings import AssetSettings
from storage.records.asset import Asset
from tests.pipeline.assets.meshes_by_hand import geometry, knot, mesh_of, moved, prepare, write_obj

BUDGETS = (1000, 500)
SETTINGS = AssetSettings(budgets=BUDGETS)
QUICK = settings(
    max_examples=2,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return prepare(write_obj(tmp_path_factory.mktemp("knot") / "a.obj", knot()), SETTINGS)


@QUICK
@given(
    scale=st.floats(1e-6, 1e6),
    offset=st.tuples(*[st.floats(-100, 100)] * 3),
    method=st.sampled_from(["pymeshlab_collapse", "meshoptimizer"]),
)
def test_any_scale_and_place_give_the_same_bytes(
    tmp_path: Path, scale: float, offset: tuple[float, float, float], method: str
) -> None:
    """Offsets are in extents: text keeps 17 digits, which leaves 1e-13 of the object here."""
    source = knot(segments=60)
    plain = prepare(write_obj(tmp_path / "a.obj", source), SETTINGS, method)
    elsewhere = moved(moved(source, 1.0, offset), scale)
    again = prepare(write_obj(tmp_path / "b.obj", elsewhere), SETTINGS, method)
    assert geometry(again) == geometry(plain)
    assert again.levels[0].record.quality == plain.levels[0].record.quality


def rotation(seed: int) -> NDArray[np.float64]:
    """A rotation from anywhere in SO(3), by the QR of a Gaussian matrix."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def placed(mesh: TriangleMesh, source: TriangleMesh) -> TriangleMesh:
    """A result back in the units of its source: the inverse of the unit box."""
    used = source.positions[np.unique(source.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    return moved(mesh, (high - low).max(), (low + high) / 2)


@pytest.mark.parametrize("seed", range(2))
def test_any_turn_keeps_budgets_and_surfaces(tmp_path: Path, straight: Asset, seed: int) -> None:
    """Turn, then prepare; or prepare, then turn: both are near the same source.

    Bytes cannot agree: the unit box and its grid have the axes of the file, and edges of equal
    cost collapse in an order that follows the coordinates.
    """
    turn = rotation(seed)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    turned_source = TriangleMesh(positions=knot().positions @ turn.T, faces=knot().faces)
    turned = prepare(write_obj(tmp_path / "a.obj", turned_source), SETTINGS)
    uniform = np.random.default_rng(seed).random((8192, 3))
    for here, there in zip(straight.levels, turned.levels, strict=True):
        assert there.record.budget - 1 <= len(there.faces) <= there.record.budget
        first = placed(mesh_of(here), knot())
        expected = TriangleMesh(positions=first.positions @ turn.T, faces=first.faces)
        actual = placed(mesh_of(there), turned_source)
        # Each accepted error is a share of its own source's diagonal, and both boxes add half a
        # cell of rounding in every coordinate.
        bound = here.record.quality.error_p99 * knot().diagonal
        bound += there.record.quality.error_p99 * turned_source.diagonal
        bound += 2 * np.sqrt(3) / GRID * turned_source.diagonal
        deviation = Surface(expected, uniform).deviation(actual)
        # By the triangle inequality, all but 1 % + 1 % of the points are within the sum.
        assert deviation.two_way(98) * expected.diagonal <= bound
