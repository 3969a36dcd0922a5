"""Figures as people read them, and the pictures of curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infra.bench.trade.curves import Curve, JudgedPoint, Knob, judged
from infra.bench.trade.knobs import knob_named
from infra.bench.trade.labels import place_labels
from infra.bench.trade.saved import SavedCurve

if TYPE_CHECKING:
    from infra.bench.trade.run import Trade

FIGURES = "trade"
"""Folder, beside the results, of the figures of single knobs."""
_COLUMNS = 4
_WIDE, _HIGH = 4.6, 3.2
"""Inches of a panel."""
_DPI = 90


def shown(value: float) -> str:
    """Return a number with three digits or a little more, without powers of ten where it can."""
    size = abs(value)
    if value == 0 or size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def shown_error(knob: Knob, error: float | None) -> str:
    """Return an error: dB with one digit behind the point, others as `shown`."""
    if error is None:
        return "n/a"
    return f"{error:.1f}" if "dB" in knob.error else shown(error)


def plot(result: "Trade", path: Path) -> None:
    """Draw a panel for each knob of a run."""
    columns = min(_COLUMNS, max(1, len(result.curves)))
    _draw(result.curves, path, columns)


def write_figures(curves: Mapping[str, SavedCurve], folder: Path) -> None:
    """Draw the newest curve of every knob into NAME.png of a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, saved in curves.items():
        _draw({name: saved.curve}, folder / f"{name}.png", columns=1)


def _draw(curves: Mapping[str, Curve], path: Path, columns: int) -> None:
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    rows = -(-len(curves) // columns) or 1
    size = (_WIDE * columns, _HIGH * rows)
    figure, panels = plt.subplots(
        rows, columns, figsize=size, dpi=_DPI, layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(curves) :]:
        axes.set_axis_off()
    labelled = [
        (axes, _panel(axes, knob_named(name), curve))
        for axes, (name, curve) in zip(panels.flat, curves.items(), strict=False)
    ]
    figure.canvas.draw()  # places are known from here on
    for axes, names in labelled:
        place_labels(axes, names)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _panel(axes: Any, knob: Knob, curve: Curve) -> list[tuple[str, tuple[float, float]]]:
    """Draw error against cost ratio; return names and places, those that matter most first."""
    points = judged(knob, curve)
    errors = [one.point.error for one in points if one.point.error is not None]
    _scale(axes, [one.cost_ratio for one in points], errors)
    for one in points:
        if one.point.error is not None:
            _mark(axes, one, one.point.error, "x" if one.on_front is None else "o")
    front = sorted((one.cost_ratio, one.point.error) for one in points if one.on_front)
    if not knob.also_cost:  # with more costs than this axis shows a front is no line
        axes.plot(*zip(*front, strict=True) if front else ([], []), "-", color="C0", linewidth=1)
    lowest, highest = axes.get_ylim()
    for one in points:
        if one.point.error is None:  # its cost is known, and stands at the lower edge
            _mark(axes, one, lowest, "^")
    axes.set_ylim(lowest, highest)
    axes.set_title(f"{knob.title} ({knob.name})", fontsize=9)
    axes.set_xlabel(_short(f"cost, to that of the default: {knob.cost}", 70), fontsize=7)
    axes.set_ylabel(f"{_short(knob.error, 45)}\n{knob.better} is better", fontsize=7)
    first = sorted(points, key=lambda one: (not one.point.default, not one.on_front))
    heights = [lowest if one.point.error is None else one.point.error for one in first]
    return [
        (one.point.setting, (one.cost_ratio, height))
        for one, height in zip(first, heights, strict=True)
    ]


def _scale(axes: Any, ratios: Sequence[float], errors: Sequence[float]) -> None:
    """Choose logarithmic axes where figures are of several sizes."""
    from infra.bench.renders.log_axis import plain_log

    if max(ratios) > 3 * min(ratios):
        axes.set_xscale("log")
        plain_log(axes.xaxis, (1, 3))
    if errors and max(errors) > 30 * min(errors) > 0:
        axes.set_yscale("log")
    axes.margins(0.18)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=7)


def _mark(axes: Any, one: JudgedPoint, height: float, style: str) -> None:
    """Draw one point: coloured where it is on the front, ringed where it is the default."""
    colour = "C0" if one.on_front else "0.6"
    axes.plot(one.cost_ratio, height, style, color=colour, markersize=5, clip_on=False)
    if one.point.default:
        ring = {"color": "C3", "markersize": 10, "fillstyle": "none", "clip_on": False}
        axes.plot(one.cost_ratio, height, "o", **ring)


def _short(words: str, most: int) -> str:
    return words if len(words) <= most else f"{words[: most - 3]}..."
