"""Sets of one price as a picture: held-out error of each recipe against what its set cost."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from infra.bench.equal_set_recipes import RECIPES
from infra.bench.training_plot import seed_bars


def plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw a line for each recipe: means over seeds, bars from the best to the worst."""
    figure = matplotlib.figure.Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(RECIPES):
        own = [row for row in rows if row["recipe"] == name]
        prices = sorted({row["price_core_s"] for row in own})
        errors = [
            [row["scores"]["log_l1"] for row in own if row["price_core_s"] == price]
            for price in prices
        ]
        if not own:
            continue
        seed_bars(axes, prices, errors, label=name, place=place)
    median = np.mean([row["median_scores"]["log_l1"] for row in rows])
    axes.axhline(median, color="grey", linestyle=":", label="median picture")
    axes.set(xscale="log", xlabel="core-seconds that the set took", ylabel="held-out log L1")
    prices = sorted({row["price_core_s"] for row in rows})
    axes.set_xticks(prices, [f"{price:.0f}" for price in prices])
    axes.minorticks_off()
    axes.legend(fontsize="small", ncols=2)
    figure.savefig(path, dpi=110)
