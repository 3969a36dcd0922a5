"""The benchmark of the mesh stage runs as a whole, small, and says what it found."""

from pathlib import Path

import pytest

from infra.bench import assets, assets_report, remeshing
from infra.bench.harness import Options


@pytest.mark.slow
def test_a_small_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(assets, "BUDGETS", (200,))
    monkeypatch.setattr(assets, "CURVE", (100, 200))
    tiny = assets.Effort(most_objects=1, sizes=(1000,), repeats=1)
    monkeypatch.setattr(assets, "QUICK", tiny)
    options = Options(quick=True, objects=("builtin:2",), allowed_licences=("CC0-1.0",))
    rounds: list[None] = []
    result = assets.run(options, lambda: rounds.append(None))
    assert len(rounds) == assets.num_rounds(options)
    reference = result.sides[f"{remeshing.REFERENCE} at 200"]
    ours = result.sides["faithful at 200"]
    assert reference["objects"].median == ours["objects"].median == 1
    # The recipe remeshes at half a percent first, whatever the source; ours only collapses.
    assert reference["cpu_s"].median > 3 * ours["cpu_s"].median
    lines = dict(assets_report.rows(result))
    assert "reference / this" in lines["faithful at 200"]
    assert "fewer than 4096" in lines["epsilon 0.5%"]
    assets_report.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
