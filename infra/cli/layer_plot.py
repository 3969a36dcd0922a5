"""The errors of a network's layers as a picture, one line for each precision."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from model.layer_errors import LayerError


def plot_layer_errors(errors: "Mapping[str, Sequence[LayerError]]", title: str, path: Path) -> None:
    """Draw relative error and largest activation against the layers, in their order."""
    import matplotlib.figure

    figure = matplotlib.figure.Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for precision, rows in errors.items():
        left.plot([row.layer for row in rows], [row.relative_error for row in rows], ".-")
        left.lines[-1].set_label(precision)
    layers = next(iter(errors.values()))
    right.plot([row.layer for row in layers], [row.peak for row in layers], ".-", label="float64")
    right.axhline(65504, color="grey", linestyle=":", label="where float16 ends")
    for axes, label in ((left, "relative error to float64"), (right, "largest activation")):
        axes.set(yscale="log", ylabel=label)
        axes.tick_params(axis="x", labelrotation=90, labelsize=7)
        axes.legend(fontsize="small")
    figure.suptitle(title, fontsize="medium")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
