"""Profile `uniform`: triangles of even size and shape, more of them where there are too few."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.settings import AssetSettings
from storage.asset import LevelQuality
from tests.assets.meshes_by_hand import cube, knot, moved, prepare, sphere, write_obj

UNIFORM = "pymeshlab_uniform"


def stretched_sphere() -> TriangleMesh:
    """Rings crowd at the poles: far from even as it is."""
    return moved(sphere(rings=61, columns=80), [1.0, 1.0, 0.5])


def quality(path: Path, method: str, budget: int = 1000) -> LevelQuality:
    profile = "uniform" if method == UNIFORM else "faithful"
    settings = AssetSettings(profile=profile, budgets=(budget,))  # type: ignore[arg-type]
    (level,) = prepare(path, settings, method).levels
    assert level.record.method == method
    assert len(level.faces) <= budget
    return level.record.quality


def test_smooth_objects_get_even_triangles(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", stretched_sphere())
    even, faithful = quality(path, UNIFORM), quality(path, "pymeshlab_collapse")
    # Measured 0.19 against 0.32, and 39 degrees against 24.
    assert even.area_variation < 0.75 * faithful.area_variation
    assert even.min_angle_p5_deg > 1.25 * faithful.min_angle_p5_deg


@pytest.mark.xfail(
    strict=True, reason="feature edges of 30 degrees keep remeshing from the target length"
)
def test_ribbed_objects_get_even_triangles(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", knot())
    even, faithful = quality(path, UNIFORM), quality(path, "pymeshlab_collapse")
    assert even.area_variation < 0.75 * faithful.area_variation
    assert even.min_angle_p5_deg > 1.25 * faithful.min_angle_p5_deg


def test_evenness_is_paid_for_with_error(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", knot())
    even, faithful = quality(path, UNIFORM), quality(path, "pymeshlab_collapse")
    assert faithful.error_p99 < even.error_p99 <= 0.03


def test_a_coarse_box_gains_triangles(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", moved(cube(), [1, 0.7, 0.4]))
    settings = AssetSettings(profile="uniform", budgets=(1000, 240))
    levels = prepare(path, settings, UNIFORM).levels
    assert [level.record.method for level in levels] == [UNIFORM, UNIFORM]
    for level in levels:
        # Remeshing aims at 85 % of the budget, and meets the edge length only roughly.
        assert 0.5 * level.record.budget < len(level.faces) <= level.record.budget
        # A plane stays a plane: distances are double precision, of points on the 2^-20 grid.
        assert level.record.quality.error_p99 < 2**-20
        assert level.record.quality.area_variation < 0.4
        assert level.record.quality.min_angle_p5_deg > 25


@pytest.mark.parametrize("budget", [240, 500, 2000, 6000])
@pytest.mark.parametrize("mesh", [knot(), cube(), stretched_sphere()], ids=["knot", "box", "ball"])
def test_budgets_hold(tmp_path: Path, mesh: TriangleMesh, budget: int) -> None:
    path = write_obj(tmp_path / "a.obj", mesh)
    settings = AssetSettings(profile="uniform", budgets=(budget,))
    (level,) = prepare(path, settings, UNIFORM).levels
    assert len(level.faces) <= budget
    assert np.abs(level.positions).max() <= 0.5 + 0.01 * np.sqrt(3)  # as the gate allows
