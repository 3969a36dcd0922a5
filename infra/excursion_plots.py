"""How a network's score falls off beyond the usual range, one plot for each axis."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
import numpy as np

if TYPE_CHECKING:
    from train.evaluation.judged_view import JudgedView

COLUMNS = 3


def plot_excursions(path: Path, views: "Sequence[JudgedView]") -> int:
    """Draw psnr_log_db against the value of every axis; return how many axes there are.

    A dot is a view, the line the median of its value, the dashed line that of the noise floors.
    Nothing is written where no view leaves the usual range.
    """
    from train.evaluation.judged_view import NETWORK

    axes: dict[str, list[JudgedView]] = {}
    for view in views:
        if view.excursion is not None:
            axes.setdefault(view.excursion[0], []).append(view)
    if not axes:
        return 0
    rows = -(-len(axes) // COLUMNS)
    figure, grid = plt.subplots(
        rows, COLUMNS, figsize=(4.2 * COLUMNS, 3.2 * rows), squeeze=False, layout="constrained"
    )
    for place, (axis, members) in zip(grid.flat, sorted(axes.items()), strict=False):
        at = np.array([view.excursion[1] for view in members if view.excursion is not None])
        scores = np.array([view.scores[NETWORK]["psnr_log_db"] for view in members], float)
        floors = np.array([view.floors["psnr_log_db"] for view in members])
        values = np.unique(at)
        place.plot(at, scores, ".", color="tab:blue", alpha=0.4)
        medians = [np.median(scores[at == value]) for value in values]
        place.plot(values, medians, "-o", color="tab:blue", label="network")
        noise = [np.median(floors[at == value]) for value in values]
        place.plot(values, noise, "--", color="grey", label="noise floor")
        place.set(title=axis.replace("_", " "), xlabel="value", ylabel="psnr_log_db")
        if values[0] > 0 and values[-1] / values[0] > 8:
            place.set_xscale("log")
    grid.flat[0].legend()
    for place in grid.flat[len(axes) :]:
        place.axis("off")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return len(axes)
