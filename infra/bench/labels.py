"""Names beside the points of a figure, and numbers beside a logarithmic axis."""

from collections.abc import Sequence
from typing import Any

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
FONT = 7
_CLEAR_PX = 7
"""Kept free around each point, so that no name covers it or its ring."""


def place_labels(
    axes: Any,
    names: Sequence[tuple[str, tuple[float, float]]],
    *,
    font: int = FONT,
    also_clear: Sequence[tuple[float, float]] = (),
) -> None:
    """Write names beside their points, where they cover neither a point nor a name.

    A name also stands clear of lines where possible, and is left out where there is no room.

    Args:
        axes: of matplotlib, drawn once, so that places are known.
        names: with the point of each, in the order in which they matter.
        font: size of the names, in printer's points.
        also_clear: other points that no name covers.
    """
    from matplotlib.transforms import Bbox

    lines = [axes.transData.transform_path(line.get_path()) for line in axes.lines]
    centres = [axes.transData.transform(at) for at in (*(at for _, at in names), *also_clear)]
    taken = [
        Bbox.from_extents(x - _CLEAR_PX, y - _CLEAR_PX, x + _CLEAR_PX, y + _CLEAR_PX)
        for x, y in centres
    ]
    for name, at in names:
        labels = [_label(axes, name, at, place, font) for place in _PLACES]
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


def _label(
    axes: Any,
    name: str,
    at: tuple[float, float],
    place: tuple[int, int, str, str],
    font: int,
) -> Any:
    right, up, across, along = place
    label = axes.annotate(
        name, at, xytext=(right, up), textcoords="offset points", fontsize=font,
        horizontalalignment=across, verticalalignment=along,
    )  # fmt: skip
    label.set_in_layout(False)  # else the axes would make room for it, and places would move
    return label


def _is_free(axes: Any, box: Any, taken: Sequence[Any]) -> bool:
    frame = axes.get_window_extent()
    inside = frame.x0 <= box.x0 and frame.y0 <= box.y0 and box.x1 <= frame.x1 and box.y1 <= frame.y1
    return inside and not any(box.overlaps(other) for other in taken)


def plain_log(axis: Any) -> None:
    """Label a logarithmic axis with 0.3, 20 and 5000 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 3)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
    axis.set_minor_formatter(NullFormatter())
