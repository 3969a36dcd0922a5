"""The benchmark of exchange on a small scene: every side runs, and the report is whole."""

from pathlib import Path

import pytest

from infra.bench import exchange
from infra.bench.harness import Options
from infra.bench.renders.cost_scene import cost_scene


def test_a_small_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(exchange, "TRIANGLES", 300)
    monkeypatch.setattr(exchange, "MANY", (20,))
    options = Options(quick=True, objects=("builtin:",), allowed_licences=())
    rounds: list[None] = []
    result = exchange.run(options, lambda: rounds.append(None))
    assert len(rounds) == exchange.num_rounds(options)
    lines = dict(exchange.rows(result))
    assert set(lines) == {"numpy", *exchange.FORMS, "usdc, 20 materials"}
    assert all("export" in line and "import" in line for line in lines.values())
    exchange.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_many_materials_keep_the_laws() -> None:
    scene = cost_scene(300, 2)
    many = exchange.with_materials(scene, 50)
    many.check()
    assert len(many.materials) == 50 + len(scene.materials)
    assert (many.triangle_emits == scene.triangle_emits).all()
    assert len(set(many.material_index[~many.triangle_emits])) == 50
