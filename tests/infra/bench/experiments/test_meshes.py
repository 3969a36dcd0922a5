"""More triangles are nearer to the source, in distance and in the picture."""

from pathlib import Path

import pytest

from infra.bench.experiments.meshes import BUDGET_GROUP, CURVE, METHOD_GROUP
from tests.infra.bench.bench_kit import measured_rows


@pytest.mark.slow("benchmarks")
def test_a_larger_budget_is_nearer(tmp_path: Path) -> None:
    found = measured_rows("meshes", tmp_path)
    distance = "distance to the source, p99, % of the diagonal"
    few, most = (found[f"{BUDGET_GROUP}, {budget}"].values for budget in (CURVE[0], CURVE[-1]))
    assert most[distance] < few[distance]
    assert most["picture, psnr_log_db"] > few["picture, psnr_log_db"]
    default = [name for name, row in found.items() if row.point.default]
    assert default == [f"{METHOD_GROUP}, faithful"]
