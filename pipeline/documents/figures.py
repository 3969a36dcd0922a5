"""Draws figures in one style, without a display and without the user's matplotlib settings.

Equal data give equal bytes: a figure holds no time and no version.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib
import matplotlib.style
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from pipeline.documents.html import Markup, data_uri, image

BLUE = "#3b6ea5"
RED = "#c8443f"
INK = "#333333"
FAINT = "#dddddd"
SERIES = ("#3b6ea5", "#e0a03b", "#5f9e6e", "#a56cb4", "#8c8c8c", "#c8443f", "#4bb0b8", "#6b5b4b")
"""Colors of the segments of stacked bars."""

_PANEL_INCHES = (2.9, 1.95)
_DPI = 180
_MOST_BINS = 30
_LONGEST_LABEL = 26
_MOST_WHOLE_NUMBERS = 24

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


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Apply the common style to all figures that are drawn within the block."""
    style = matplotlib.style.context(["default", _STYLE], after_reset=True)
    with style, warnings.catch_warnings():
        # an untrusted name may need a script that the font lacks: it shows boxes
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def panels(count: int, *, columns: int = 2, polar: Sequence[int] = ()) -> tuple[Figure, list[Axes]]:
    """Return a figure of `count` panels; those in `polar` have polar axes."""
    rows = -(-count // columns)
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(columns * width, rows * height), dpi=_DPI)
    figure.set_layout_engine("constrained", w_pad=0.07, h_pad=0.06, wspace=0.04)
    axes = [
        figure.add_subplot(rows, columns, k + 1, projection="polar" if k in polar else None)
        for k in range(count)
    ]
    return figure, axes


def encode_figure(figure: Figure, alt: str) -> Markup:
    """Return the figure as a picture for a page."""
    stream = io.BytesIO()
    # by its canvas: `savefig` draws all once more for the layout, and a report has seven figures
    FigureCanvasAgg(figure).print_png(stream, metadata={"Software": None})
    return image(data_uri(stream.getvalue()), alt, class_="wide")


def histogram(
    axes: Axes,
    values: ArrayLike,
    xlabel: str,
    *,
    ylabel: str = "",
    marks: Mapping[str, float | None] | None = None,
    bounds: tuple[float, float] | None = None,
) -> None:
    """Draw a histogram: one bar for each whole number, else up to thirty bins.

    Args:
        axes: axes to draw on.
        values: [N] values; those that are not finite are left out.
        xlabel, ylabel: labels of the axes.
        marks: vertical lines at values, by name; None draws nothing.
        bounds: range of the bins; None for the range of the values.
    """
    finite = finite_values(values)
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    if finite.size:
        edges = _edges(finite, bounds)
        counts, _ = np.histogram(finite, edges)
        gap = 0.88 if _whole_numbers(finite) else 0.96
        axes.bar(
            (edges[1:] + edges[:-1]) / 2,
            counts,
            width=gap * np.diff(edges),
            color=BLUE,
            linewidth=0,
        )
        if _whole_numbers(finite):
            low = int(finite.min())
            high = int(finite.max())
            axes.set_xticks(range(low, high + 1, 1 + (high - low) // 9))
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4, integer=True))
    for name, value in (marks or {}).items():
        if value is not None and math.isfinite(value):
            axes.axvline(value, color=RED, linewidth=1.2, label=name)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), borderaxespad=0)


def rose(axes: Axes, degrees: ArrayLike, title: str) -> None:
    """Draw directions around the vertical as a rose of 24 petals whose areas are the counts."""
    counts, edges = np.histogram(
        np.radians(finite_values(degrees)) % (2 * np.pi), 24, (0, 2 * np.pi)
    )
    width = float(edges[1])
    axes.bar(edges[:-1] + width / 2, np.sqrt(counts), width=0.94 * width, color=BLUE)
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["+X", "+Y", "-X", "-Y"])
    axes.set_yticklabels([])
    axes.grid(color=FAINT)
    axes.set_title(title, fontsize=8, color=INK, pad=8)


def stacked_bars(
    bars: Sequence[str], parts: Mapping[str, ArrayLike], *, xlabel: str
) -> tuple[Figure, Axes]:
    """Return a figure of horizontal stacked bars, the first on top.

    Args:
        bars: the name of each bar.
        parts: the lengths [bars] of each segment, by its name.
        xlabel: label of the lengths.
    """
    width, height = _PANEL_INCHES
    size = (2 * width, max(height, 0.8 + 0.21 * len(bars)))
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    offset = np.zeros(len(bars))
    rows = np.arange(len(bars))
    for number, (name, lengths) in enumerate(parts.items()):
        colour = SERIES[number % len(SERIES)]
        axes.barh(rows, lengths, left=offset, height=0.68, color=colour, label=short_label(name))
        offset += np.asarray(lengths)
    axes.set_yticks(rows, [short_label(name) for name in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlabel(xlabel)
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x", visible=True)
    axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
    if len(parts) > 1:
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), ncols=min(len(parts), 6), borderaxespad=0
        )
    return figure, axes


def short_label(text: str) -> str:
    """Return an untrusted name as a label: one printable line of limited length."""
    visible = "".join(letter if letter.isprintable() else " " for letter in str(text))
    line = " ".join(visible.split())
    return line if len(line) <= _LONGEST_LABEL else line[: _LONGEST_LABEL - 1] + "…"


def finite_values(values: ArrayLike) -> NDArray[np.float64]:
    """Return the values that are finite, [M] float64."""
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
