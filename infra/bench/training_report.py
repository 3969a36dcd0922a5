"""What the table of small trainings says: means over seeds, changes against ours, power laws."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student

from infra.bench.power_law import CONFIDENCE, fit_power_law
from infra.bench.training_jobs import BASELINE

PAPER = "paper-schedule"

Rows = Sequence[Mapping[str, Any]]


def report_lines(rows: Rows) -> list[str]:
    """Return the report as Markdown lines; a change that does not help is there like any other."""
    if not rows:
        return ["No result yet."]
    rows = of_newest_data(rows)
    lines = ["Held-out log L1, mean over seeds (half the range), and its ratio to `ours`.", ""]
    scenes = sorted({row["scenes"] for row in rows})
    lines += [
        f"| network | change | {' | '.join(f'{count} scenes' for count in scenes)} | exponent |",
        f"|{'---|' * (len(scenes) + 3)}",
    ]
    for plan, size, change in _kinds(rows):
        own = [_errors(rows, plan, size, change, count) for count in scenes]
        base = [_errors(rows, plan, size, BASELINE, count) for count in scenes]
        cells = [_cell(mine, ours) for mine, ours in zip(own, base, strict=True)]
        law = law_text(scenes, own)
        lines.append(f"| {plan} {size} | {change} | {' | '.join(cells)} | {law} |")
    rivals = {
        (row["data_digest"][:8], row["scenes"], row["median_scores"]["log_l1"]) for row in rows
    }
    lines += ["", "The median picture of the training views scores, by its training set:"]
    lines += [
        f"- data {digest}, {count} scenes: {score:.4f}" for digest, count, score in sorted(rivals)
    ]
    return lines + _against_paper(rows)


def of_newest_data(rows: Rows) -> Rows:
    """Return the rows of each plan that learned from the set that was used last: others differ."""
    newest = {row["plan"]: row["data_digest"] for row in rows}
    return [row for row in rows if row["data_digest"] == newest[row["plan"]]]


def _against_paper(rows: Rows) -> list[str]:
    """Return what each change makes of the paper's schedule: same network, scenes and seed."""
    ends = {_place(row): row for row in rows if row["change"] == PAPER}
    lines = []
    for change in sorted({row["change"] for row in rows} - {PAPER}):
        pairs = [
            (row, ends[_place(row)])
            for row in rows
            if row["change"] == change and _place(row) in ends
        ]
        if pairs:
            lines.append(f"| {change} | {' | '.join(_cells_against_paper(pairs))} |")
    head = [
        "",
        f"Against `{PAPER}` with the same network, scenes and seed, at the end of both; and the",
        "share of its steps after which the change was as good as it is at its end, in the median,",
        "read off every tenth of a run whose own schedule goes on.",
        "",
        "| change | pairs | steps | error, ratio (95 %) | as good after |",
        "|---|---|---|---|---|",
    ]
    return [*head, *lines] if lines else []


def _cells_against_paper(pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> list[str]:
    ratios = [row["scores"]["log_l1"] / paper["scores"]["log_l1"] for row, paper in pairs]
    steps = {row["num_steps"] / paper["num_steps"] for row, paper in pairs}
    shares = [
        reached(row["curve"], paper["scores"]["log_l1"]) / paper["num_steps"]
        for row, paper in pairs
    ]
    ratio, low, high = mean_ratio(ratios)
    interval = "no interval" if math.isnan(low) else f"{low:.3f} to {high:.3f}"
    return [
        str(len(pairs)),
        " or ".join(f"{share:.0%}" for share in sorted(steps)),
        f"{ratio:.3f} ({interval})",
        f"{_share(float(np.median(shares)))} ({_share(min(shares))} to {_share(max(shares))})",
    ]


def _share(of_steps: float) -> str:
    return "never" if math.isinf(of_steps) else f"{of_steps:.0%}"


def mean_ratio(ratios: Sequence[float]) -> tuple[float, float, float]:
    """Return the geometric mean and its 95 % interval (Student's t); nan with one."""
    logs = np.log(np.asarray(ratios, float))
    half = math.nan
    if len(logs) > 1:
        deviation = float(logs.std(ddof=1)) / math.sqrt(len(logs))
        half = float(student.ppf(0.5 + CONFIDENCE / 2, len(logs) - 1)) * deviation
    return math.exp(logs.mean()), math.exp(logs.mean() - half), math.exp(logs.mean() + half)


def _place(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["plan"], row["size"], row["scenes"], row["seed"]


def reached(curve: Sequence[Sequence[float]], error: float) -> float:
    """Return the first step of [(step, error), ...] with at most this error, or infinity."""
    return next((step for step, found in curve if found <= error), math.inf)


def law_text(scenes: Sequence[int], errors: Sequence[Sequence[float]]) -> str:
    """Return the exponent of error = a N^-b with its 95 % interval, where it can be fitted."""
    pairs = [(count, error) for count, found in zip(scenes, errors, strict=True) for error in found]
    if len({count for count, _ in pairs}) < 2:
        return "n/a"
    law = fit_power_law([count for count, _ in pairs], [error for _, error in pairs])
    if math.isnan(law.exponent_low):
        return f"{law.exponent:.3f} (no interval)"
    return f"{law.exponent:.3f} ({law.exponent_low:.3f} to {law.exponent_high:.3f})"


def _kinds(rows: Rows) -> list[tuple[str, str, str]]:
    """Return every (plan, network, change) once, `ours` first."""
    kinds = {(row["plan"], row["size"], row["change"]) for row in rows}
    return sorted(kinds, key=lambda kind: (kind[0], kind[1], kind[2] != BASELINE, kind[2]))


def _errors(rows: Rows, plan: str, size: str, change: str, scenes: int) -> list[float]:
    return [
        row["scores"]["log_l1"]
        for row in rows
        if (row["plan"], row["size"], row["change"], row["scenes"]) == (plan, size, change, scenes)
    ]


def _cell(own: Sequence[float], base: Sequence[float]) -> str:
    if not own:
        return ""
    text = f"{np.mean(own):.4f}"
    if len(own) > 1:
        text += f" ({np.ptp(own) / 2:.4f})"
    if base and list(base) != list(own):
        text += f", x{np.mean(own) / np.mean(base):.3f}"
    return text
