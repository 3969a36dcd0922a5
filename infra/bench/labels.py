"""Names of points in a small figure: as many as there is room for."""

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
"""Offsets in printer's points, and how a name lies there; the first that is free is taken."""
_FONT = 7
_CLEAR_PX = 7
"""Around each point, so that no name covers it or its ring."""


def place_labels(axes: Any, names: Sequence[tuple[str, tuple[float, float]]]) -> None:
    """Write names beside their points, where they cover neither a point nor a name.

    Where it can be, a name stands clear of lines too. One for which there is no room is left out:
    the table beside the figure has it.

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
