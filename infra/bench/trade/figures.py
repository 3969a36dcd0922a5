"""Figures as people read them, and the picture of all curves."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from infra.bench.trade.curves import JudgedPoint, Knob, judged
from infra.bench.trade.knobs import knob_named

if TYPE_CHECKING:
    from infra.bench.trade.run import Trade

_COLUMNS = 4
_LABEL: Any = {"fontsize": 6, "textcoords": "offset points", "xytext": (4, 3)}


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
    """Draw a panel for each knob: error against cost, the front as a line, the default ringed."""
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    names = list(result.curves)
    columns = min(_COLUMNS, max(1, len(names)))
    rows = -(-len(names) // columns) or 1
    figure, panels = plt.subplots(
        rows, columns, figsize=(4.4 * columns, 3.4 * rows), layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(names) :]:
        axes.set_axis_off()
    for axes, name in zip(panels.flat, names, strict=False):
        knob = knob_named(name)
        _panel(axes, knob, judged(knob, result.curves[name]))
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _panel(axes: Any, knob: Knob, points: list[JudgedPoint]) -> None:
    from infra.bench.renders.log_axis import plain_log

    known = [one for one in points if one.point.error is not None]
    for one in known:
        at = (one.point.cost, one.point.error)
        axes.plot(*at, "o", color="C0" if one.on_front else "0.7", markersize=5)
        if one.point.default:
            axes.plot(*at, "o", color="C3", markersize=10, fillstyle="none")
        axes.annotate(one.point.setting, at, **_LABEL)
    front = sorted((one.point.cost, one.point.error) for one in known if one.on_front)
    if not knob.also_cost:
        axes.plot(*zip(*front, strict=True) if front else ([], []), "-", color="C0", linewidth=1)
    costs = [one.point.cost for one in known]
    if costs and max(costs) > 3 * min(costs):
        axes.set_xscale("log")
        plain_log(axes.xaxis, (1, 3))
    axes.margins(0.15)
    axes.grid(alpha=0.3)
    axes.set_title(f"{knob.title} ({knob.name})", fontsize=9)
    axes.set_xlabel(_short(knob.cost), fontsize=7)
    axes.set_ylabel(f"{_short(knob.error)} ({knob.better} is better)", fontsize=7)
    axes.tick_params(labelsize=7)


def _short(words: str) -> str:
    return words if len(words) <= 45 else f"{words[:42]}..."
