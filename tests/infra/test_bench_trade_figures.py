"""Figures of single knobs: there for whatever was saved, small, and no name covers another."""

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

from infra.bench.trade import run
from infra.bench.trade.curves import Curve, Point
from infra.bench.trade.figures import write_figures
from infra.bench.trade.labels import place_labels
from infra.bench.trade.saved import saved_curves
from tests.conftest import ROOT

matplotlib.use("Agg")


def _curve(*points: tuple[str, float, float | None]) -> Curve:
    made = [
        Point(setting=name, cost=cost, error=error, default=name == "b")
        for name, cost, error in points
    ]
    return Curve(points=tuple(made), measured_on="points by hand")


def test_saved_curves_have_small_figures(tmp_path: Path) -> None:
    saved = saved_curves(ROOT / "docs" / "bench")
    by_points = sorted(saved, key=lambda name: len(saved[name].curve.points))
    curves = {name: saved[name] for name in (by_points[0], by_points[-1])}
    write_figures(curves, tmp_path / "trade")
    written = {path.stem: path.stat().st_size for path in (tmp_path / "trade").iterdir()}
    assert set(written) == set(curves)
    # an empty panel has 5 kB; all knobs together are to stay below a megabyte
    assert all(8_000 < size < 40_000 for size in written.values())


def test_every_measured_knob_has_its_figure_on_the_page() -> None:
    """`trilight bench trade --write-docs` was run after the last benchmark."""
    there = {path.stem for path in (ROOT / "docs" / "bench" / "trade").glob("*.png")}
    assert there == set(saved_curves(ROOT / "docs" / "bench"))


def test_a_run_is_drawn_whole(tmp_path: Path) -> None:
    curves = {"guides": _curve(("a", 1, 30), ("b", 2, 40)), "depth": _curve(("b", 1, None))}
    result = run.Trade(name="trade", curves=curves, skipped={}, seconds={})
    run.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.parametrize("apart", [0.0, 0.001, 0.02])
def test_no_name_covers_a_name_or_leaves_the_figure(apart: float) -> None:
    names = [(f"setting {n}", (1 + apart * n, 1 + apart * n)) for n in range(12)]
    figure, axes = plt.subplots(figsize=(4, 3))
    axes.plot([0, 3], [0, 3], "o")
    figure.canvas.draw()
    place_labels(axes, names)
    boxes = [label.get_window_extent() for label in axes.texts]
    frame = axes.get_window_extent()
    plt.close(figure)
    assert 0 < len(boxes) <= len(names)
    assert axes.texts[0].get_text() == "setting 0"  # what matters most comes first
    for row, box in enumerate(boxes):
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1
        assert not any(box.overlaps(other) for other in boxes[row + 1 :])
