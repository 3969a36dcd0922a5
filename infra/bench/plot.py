"""The one figure of an experiment: error against cost, or costs alone as bars.

Points are named where there is room: the table beside the figure has all names.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from infra.bench.curve import Row, rows
from infra.bench.experiment import Experiment
from infra.bench.store import Run

_WIDE, _HIGH, _DPI = 6.0, 4.0, 90
"""Inches of the figure, and its resolution."""


def plot(experiment: Experiment, run: Run, path: Path) -> None:
    """Draw a run into a PNG file."""
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    points = rows(experiment, run)
    high = _HIGH if experiment.error else 1.2 + 0.28 * len(points)
    figure, axes = plt.subplots(figsize=(_WIDE, high), dpi=_DPI, layout="constrained")
    axes.set_title(f"{experiment.title} ({experiment.name})", fontsize=9)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=7)
    if experiment.error is None:
        _bars(axes, experiment, points)
    else:
        names = _points(axes, experiment, points)
        figure.canvas.draw()  # places are known from here on
        place_labels(axes, names)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _bars(axes: Any, experiment: Experiment, points: Sequence[Row]) -> None:
    costs = [one.values[experiment.cost.name] for one in points]
    spreads = [
        (cost - one.cost_spread.low, one.cost_spread.high - cost) if one.cost_spread else (0, 0)
        for one, cost in zip(points, costs, strict=True)
    ]
    bars = [[max(0.0, side) for side in sides] for sides in zip(*spreads, strict=True)]
    axes.barh([one.point.name for one in points], costs, xerr=bars, ecolor="grey")
    axes.invert_yaxis()
    axes.set_xlabel(experiment.cost.name, fontsize=7)
    if max(costs) > 30 * min(costs):
        axes.set_xscale("log")
        _plain_log(axes.xaxis)


def _points(
    axes: Any, experiment: Experiment, points: Sequence[Row]
) -> list[tuple[str, tuple[float, float]]]:
    """Draw error against cost ratio; return names and places, those that matter most first."""
    assert experiment.error is not None
    name = experiment.error.name
    errors = [one.values[name] for one in points if name in one.values]
    _scale(axes, [one.cost_ratio for one in points], errors)
    for one in points:
        if name in one.values:
            _mark(axes, one, one.values[name], "x" if one.on_front is None else "o")
    front = sorted((one.cost_ratio, one.values[name]) for one in points if one.on_front)
    if front and not experiment.also_cost:  # with more costs than this axis a front is no line
        axes.plot(*zip(*front, strict=True), "-", color="C0", linewidth=1)
    lowest, highest = axes.get_ylim()
    for one in points:
        if name not in one.values:  # its cost is known, and stands at the lower edge
            _mark(axes, one, lowest, "^")
    axes.set_ylim(lowest, highest)
    base = "that of the default" if any(one.point.default for one in points) else "the first"
    axes.set_xlabel(f"{experiment.cost.name}, divided by {base}", fontsize=7)
    axes.set_ylabel(f"{name}\n{experiment.better} is better", fontsize=7)
    first = sorted(points, key=lambda one: (not one.point.default, not one.on_front))
    return [(one.point.name, (one.cost_ratio, one.values.get(name, lowest))) for one in first]


def _scale(axes: Any, ratios: Sequence[float], errors: Sequence[float]) -> None:
    """Choose logarithmic axes where figures are of several sizes."""
    if max(ratios) > 3 * min(ratios):
        axes.set_xscale("log")
        _plain_log(axes.xaxis)
    if errors and max(errors) > 30 * min(errors) > 0:
        axes.set_yscale("log")
    axes.margins(0.18)


def _plain_log(axis: Any) -> None:
    """Label a logarithmic axis with 0.3, 20 and 5000 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 3)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
    axis.set_minor_formatter(NullFormatter())


def _mark(axes: Any, one: Row, height: float, style: str) -> None:
    """Draw one point: coloured where it is on the front, ringed where it is the default."""
    colour = "C0" if one.on_front else "0.6"
    axes.plot(one.cost_ratio, height, style, color=colour, markersize=5, clip_on=False)
    if one.point.default:
        ring = {"color": "C3", "markersize": 10, "fillstyle": "none", "clip_on": False}
        axes.plot(one.cost_ratio, height, "o", **ring)


_PLACES = (
    (8, 5, "left", "bottom"),
    (8, -5, "left", "top"),
    (-8, 5, "right", "bottom"),
    (-8, -5, "right", "top"),
    (0, 9, "center", "bottom"),
    (0, -9, "center", "top"),
    (9, 0, "left", "center"),
    (-9, 0, "right", "center"),
    (0, 9, "left", "bottom"),
    (0, -9, "left", "top"),
)
"""Offsets in printer's points, with the alignment of the name; the first free one is taken."""
_FONT = 7
_CLEAR_PX = 7
"""Kept free around each point, so that no name covers it or its ring."""


def place_labels(axes: Any, names: Sequence[tuple[str, tuple[float, float]]]) -> None:
    """Write names beside their points, where they cover neither a point nor a name.

    A name also stands clear of lines where possible, and is left out where there is no room.

    Args:
        axes: of matplotlib, drawn once, so that places are known.
        names: with the point of each, in the order in which they matter.
    """
    from matplotlib.transforms import Bbox

    lines = [axes.transData.transform_path(line.get_path()) for line in axes.lines]
    centres = [axes.transData.transform(at) for _, at in names]
    taken = [
        Bbox.from_extents(x - _CLEAR_PX, y - _CLEAR_PX, x + _CLEAR_PX, y + _CLEAR_PX)
        for x, y in centres
    ]
    for name, at in names:
        labels = [_label(axes, name, at, place) for place in _PLACES]
        boxes = [label.get_window_extent().padded(2) for label in labels]
        free = [row for row, box in enumerate(boxes) if _is_free(axes, box, taken)]
        clear = [
            row
            for row in free
            if not any(line.intersects_bbox(boxes[row], filled=False) for line in lines)
        ]
        chosen = next(iter([*clear, *free]), None)
        for row, label in enumerate(labels):
            if row == chosen:
                taken.append(boxes[row])
            else:
                label.remove()


def _label(axes: Any, name: str, at: tuple[float, float], place: tuple[int, int, str, str]) -> Any:
    right, up, across, along = place
    label = axes.annotate(
        name, at, xytext=(right, up), textcoords="offset points", fontsize=_FONT,
        horizontalalignment=across, verticalalignment=along,
    )  # fmt: skip
    label.set_in_layout(False)  # else the axes would make room for it, and places would move
    return label


def _is_free(axes: Any, box: Any, taken: Sequence[Any]) -> bool:
    frame = axes.get_window_extent()
    inside = frame.x0 <= box.x0 and frame.y0 <= box.y0 and box.x1 <= frame.x1 and box.y1 <= frame.y1
    return inside and not any(box.overlaps(other) for other in taken)
