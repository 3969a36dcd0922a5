"""Draws figures in one style, without a display and without the user's matplotlib settings.

Equal data give equal bytes: a figure holds no time and no version. Axes have fixed places, since
matplotlib's layout engines draw everything twice.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib.style
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from storage.palette import FAINT, INK, LIMIT, PATH_TRACER, SERIES

_PANEL_INCHES = (2.9, 1.95)
_DPI = 180
_MOST_BINS = 30
_LONGEST_LABEL = 26
_MOST_WHOLE_NUMBERS = 24
_LETTER_INCHES = 0.066

_STYLE: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#999999",
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.labelcolor": INK,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "text.parse_math": False,  # untrusted names may hold dollar signs
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """Histogram, or rose of directions, of the finite ones of some values."""

    values: ArrayLike
    """[N] values; degrees for a rose."""
    label: str
    """Label below the histogram, or above the rose."""
    unit: str = ""
    """Label of the vertical axis: the things that are counted."""
    marks: Mapping[str, float] = field(default_factory=dict)
    """Vertical lines at values, by name."""
    bounds: tuple[float, float] | None = None
    """Range of the bins; None for the range of the values."""
    is_log: bool = False
    """True: logarithms to base 10 are drawn."""
    is_rose: bool = False
    """True: directions around the vertical."""


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Apply the common style to all figures that are drawn within the block."""
    style = matplotlib.style.context(["default", _STYLE], after_reset=True)
    with style, warnings.catch_warnings():
        # an untrusted name may need a script that the font lacks: it shows boxes
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def draw_panels(panels: Sequence[Panel], *, columns: int = 2) -> bytes:
    """Return a PNG file of panels, row by row."""
    rows = -(-len(panels) // columns)
    width, height = _PANEL_INCHES
    with drawing():
        figure = Figure(figsize=(columns * width, rows * height))
        for number, panel in enumerate(panels):
            row, column = divmod(number, columns)
            place = (column * width, (rows - 1 - row) * height)
            if panel.is_rose:
                box = (place[0] + 0.6, place[1] + 0.3, width - 1.2, height - 0.8)
                _draw_rose(_add_axes(figure, box, projection="polar"), panel)
            else:
                below = 0.3 + 0.14 * (1 + panel.label.count("\n"))
                box = (place[0] + 0.55, place[1] + below, width - 0.7, height - below - 0.2)
                draw_histogram(_add_axes(figure, box), panel)
        return _encode(figure)


def draw_bars(bars: Sequence[str], parts: Mapping[str, ArrayLike], *, label: str) -> bytes:
    """Return a PNG file of horizontal stacked bars, the first on top.

    Args:
        bars: the name of each bar.
        parts: the lengths [bars] of each segment, by its name.
        label: label of the lengths.
    """
    names = [short_label(name) for name in bars]
    width = 2 * _PANEL_INCHES[0]
    height = max(_PANEL_INCHES[1], 0.8 + 0.21 * len(bars))
    with drawing():
        figure = Figure(figsize=(width, height))
        margin = 0.15 + _LETTER_INCHES * max(map(len, names), default=0)
        axes = _add_axes(figure, (margin, 0.45, width - margin - 0.15, height - 0.7))
        offset = np.zeros(len(bars))
        rows = np.arange(len(bars))
        for number, (name, lengths) in enumerate(parts.items()):
            color = SERIES[number % len(SERIES)]
            axes.barh(rows, lengths, left=offset, height=0.68, color=color, label=short_label(name))
            offset += np.asarray(lengths)
        axes.set_yticks(rows, names)
        axes.set_ylim(len(bars) - 0.4, -0.6)
        axes.set_xlabel(label)
        axes.grid(axis="y", visible=False)
        axes.grid(axis="x", visible=True)
        axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
        if len(parts) > 1:
            axes.legend(
                loc="lower left", bbox_to_anchor=(0, 1), ncols=min(len(parts), 6), borderaxespad=0
            )
        return _encode(figure)


def draw_histogram(axes: Axes, panel: Panel) -> None:
    """Draw a histogram: one bar for each whole number, else up to thirty bins."""
    finite = _finite_values(panel.values)
    if panel.is_log:
        finite = np.log10(np.maximum(finite, 1e-3))
    axes.set_xlabel(f"log10 of {panel.label}" if panel.is_log else panel.label)
    axes.set_ylabel(panel.unit)
    if finite.size:
        edges = _edges(finite, panel.bounds)
        counts, _ = np.histogram(finite, edges)
        gap = 0.88 if _whole_numbers(finite) else 0.96
        middles = (edges[1:] + edges[:-1]) / 2
        axes.bar(middles, counts, width=gap * np.diff(edges), color=PATH_TRACER, linewidth=0)
        if _whole_numbers(finite):
            low = int(finite.min())
            high = int(finite.max())
            axes.set_xticks(range(low, high + 1, 1 + (high - low) // 9))
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4, integer=True))
    axes.yaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))  # 300k fits
    for name, value in panel.marks.items():
        if math.isfinite(value):
            axes.axvline(value, color=LIMIT, linewidth=1.2, label=name)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), borderaxespad=0)


def _draw_rose(axes: Axes, panel: Panel) -> None:
    """Draw 24 petals whose areas are the counts."""
    full = 2 * np.pi
    counts, edges = np.histogram(np.radians(_finite_values(panel.values)) % full, 24, (0, full))
    width = float(edges[1])
    axes.bar(edges[:-1] + width / 2, np.sqrt(counts), width=0.94 * width, color=PATH_TRACER)
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["+X", "+Y", "-X", "-Y"])
    axes.set_yticklabels([])
    axes.grid(color=FAINT)
    axes.set_title(f"{panel.label}: area of a petal = {panel.unit}", fontsize=8, color=INK, pad=8)


def short_label(text: str) -> str:
    """Return an untrusted name as a label: one printable line of limited length."""
    visible = "".join(letter if letter.isprintable() else " " for letter in str(text))
    line = " ".join(visible.split())
    return line if len(line) <= _LONGEST_LABEL else line[: _LONGEST_LABEL - 1] + "…"


def _add_axes(
    figure: Figure, box: tuple[float, float, float, float], projection: str | None = None
) -> Axes:
    """Add axes at left, bottom, width and height in inches."""
    width, height = figure.get_size_inches()
    rect = (box[0] / width, box[1] / height, box[2] / width, box[3] / height)
    return figure.add_axes(rect, projection=projection)


def _encode(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


def _finite_values(values: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64).ravel()
    return array[np.isfinite(array)]


def _whole_numbers(values: NDArray[np.float64]) -> bool:
    span = values.max() - values.min()
    return bool(span <= _MOST_WHOLE_NUMBERS and (values == np.round(values)).all())


def _edges(values: NDArray[np.float64], bounds: tuple[float, float] | None) -> NDArray[np.float64]:
    if _whole_numbers(values) and bounds is None:
        return np.arange(values.min() - 0.5, values.max() + 1)
    bins = int(np.clip(np.sqrt(values.size) * 2, 8, _MOST_BINS))
    return np.histogram_bin_edges(values, bins, bounds)
