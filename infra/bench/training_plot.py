"""The table of small trainings as a picture: error against scenes, one line for each change."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from infra.bench.training_jobs import BASELINE
from infra.bench.training_report import of_newest_data


def plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw a panel for each network: means over seeds, bars from the best to the worst."""
    rows = of_newest_data(rows)
    kinds = sorted(
        {(row["plan"], row["size"], row["num_parameters"]) for row in rows}, key=_weights
    )
    figure = matplotlib.figure.Figure(figsize=(4.5 * len(kinds), 3.6), layout="constrained")
    for axes, kind in zip(
        np.ravel(figure.subplots(1, len(kinds), sharey=True)), kinds, strict=True
    ):
        of_kind = [row for row in rows if (row["plan"], row["size"], row["num_parameters"]) == kind]
        _panel(axes, of_kind)
        axes.set_title(f"{kind[0]} {kind[1]}: {kind[2] / 1e6:.2f} M parameters")
    figure.savefig(path, dpi=120)


def _weights(kind: tuple[str, str, int]) -> int:
    return kind[2]


def _panel(axes: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    changes = sorted({row["change"] for row in rows}, key=lambda name: (name != BASELINE, name))
    for index, change in enumerate(changes):
        own = [row for row in rows if row["change"] == change]
        counts = sorted({row["scenes"] for row in own})
        errors = [
            [row["scores"]["log_l1"] for row in own if row["scenes"] == count] for count in counts
        ]
        seed_bars(axes, counts, errors, label=change, place=index)
    median = np.mean([row["median_scores"]["log_l1"] for row in rows])
    axes.axhline(median, color="grey", linestyle=":", label="median picture")
    axes.set(xscale="log", xlabel="training scenes", ylabel="held-out log L1")
    axes.legend(fontsize="small")


def seed_bars(
    axes: Any, x: Sequence[float], errors: Sequence[Sequence[float]], *, label: str, place: int
) -> None:
    """Draw means over seeds with bars from the best to the worst, beside those of other places."""
    means = np.array([np.mean(found) for found in errors])
    ends = [means - [min(found) for found in errors], [max(found) for found in errors] - means]
    beside = np.array(x) * 1.03**place  # so that bars do not hide each other
    axes.errorbar(beside, means, yerr=ends, marker="o", capsize=3, label=label)
