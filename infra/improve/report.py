"""The report of a closed loop: a table of weights and losses a round, and a picture of both."""

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from infra.improve.state import Lessons, Rounds
from storage.atomic import atomic_writer, write_atomically

_HIGH, _WIDE, _DPI = 3.4, 9.0, 110
"""Inches of the picture, and its resolution."""


def rows_of(rounds: Rounds, found: Sequence[Lessons]) -> list[dict[str, str]]:
    """Return a row for each stratum of each round: what was drawn and what it taught."""
    rows = []
    for number, lessons in enumerate(found, 1):
        drawn = rounds.drawn(number)
        assert drawn is not None  # it is written before anything is learnt
        for name, weight in drawn.weights.items():
            lesson = lessons.strata.get(name)
            taught = ["", "", ""]
            if lesson is not None:
                fall = lesson.loss_before - lesson.loss
                taught = [f"{lesson.loss:.4f}", f"{fall:+.4f}", f"{lesson.core_s:.2f}"]
            cells = dict(zip(("log L1", "fell by", "core-s a scene"), taught, strict=True))
            rows.append({"round": str(number), "stratum": name, "share": f"{weight:.1%}", **cells})
    return rows


def summary_of(found: Sequence[Lessons]) -> list[tuple[str, str]]:
    """Return what the rounds took and what they taught, as names and values."""
    first, last = (fmean(one.losses.values()) for one in (found[0], found[-1]))
    return [
        ("rounds", str(len(found))),
        ("training scenes", ", ".join(str(one.scenes) for one in found)),
        ("core-seconds of making", f"{sum(one.making_core_s for one in found):.0f}"),
        ("core-seconds of training", f"{sum(one.training_core_s for one in found):.0f}"),
        (
            "log L1 of held-out scenes",
            f"{first:.4f} after round 1, {last:.4f} at the end",
        ),
    ]


def write_report(rounds: Rounds, found: Sequence[Lessons]) -> None:
    """Write improve.md and improve.png into the folder of a loop.

    Raises:
        TrilightError: the folder cannot be written.
    """
    rows = rows_of(rounds, found)
    head = list(rows[0])
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    lines += [f"| {' | '.join(row.values())} |" for row in rows]
    spent = [
        f"Round {number}: {one.scenes} training scenes made in {one.making_core_s:.0f} "
        f"core-seconds, trained in {one.training_core_s:.0f}; dataset {one.digest[:12]}."
        for number, one in enumerate(found, 1)
    ]
    text = "\n".join(["# Closed loop", "", *spent, "", *lines, "", "![](improve.png)", ""])
    write_atomically(rounds.order.root / "improve.md", text.encode())
    _draw(rounds, found, picture_of(rounds))


def picture_of(rounds: Rounds) -> Path:
    """Return where the picture is."""
    return rounds.order.root / "improve.png"


def _draw(rounds: Rounds, found: Sequence[Lessons], path: Path) -> None:
    """Draw share and loss of each stratum over the rounds."""
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    numbers = list(range(1, len(found) + 1))
    drawn = rounds.history(len(found) + 1)
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(_WIDE, _HIGH), dpi=_DPI, layout="constrained"
    )
    for row, name in enumerate(drawn[0].weights):
        style: dict[str, Any] = {"color": f"C{row % 10}", "marker": "o", "markersize": 3}
        left.plot(numbers, [one.weights[name] for one in drawn], label=name, **style)
        known = [
            (k, one.strata[name].loss)
            for k, one in zip(numbers, found, strict=True)
            if name in one.strata
        ]
        if known:
            right.plot(*zip(*known, strict=True), **style)
    left.set(title="share of the scenes drawn", xlabel="round", ylim=(0, None))
    right.set(title="log L1 of held-out scenes", xlabel="round", ylim=(0, None))
    for axes in (left, right):
        axes.set_xticks(numbers)
        axes.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=7, frameon=False)
    with atomic_writer(path) as stream:
        figure.savefig(stream, format="png", metadata={"Software": None})
    plt.close(figure)
