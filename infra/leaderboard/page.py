"""Leaderboard as Markdown for people and as two CSV tables for programs."""

import csv
import io
from collections.abc import Mapping, Sequence

from infra.cost_tables import number_text
from infra.leaderboard.contest import NOISE
from infra.leaderboard.standings import Standing, WidthStandings
from pipeline.documents.attribution import inert
from pipeline.documents.markdown import table, text
from train.evaluation.metrics import METRICS
from train.evaluation.pairs import METRIC, PairedLead
from train.evaluation.published import PUBLISHED, PUBLISHED_ROWS, PUBLISHED_WHERE

_NONE = "n/a"
_PAPER_PX = 256


def page(
    about: Mapping[str, str], widths: Sequence[WidthStandings], notes: Sequence[str], rival: str
) -> str:
    """Return leaderboard.md.

    Args:
        about: facts of the dataset by name.
        widths: table of each width.
        notes: notes for the reader.
        rival: name of the row that all others are compared with.
    """
    lines = ["# Leaderboard", "", *(f"- {name}: {text(value)}" for name, value in about.items())]
    lines += [
        "",
        "Medians over views, in brackets the worse 5 %; sorted by psnr_log_db. Core-seconds are "
        "medians over the timed scenes, one thread of a processor, everything warm: a scene's "
        "first view with its loading, and a further one. A row is on the front where no other one "
        f"is as good at its price. The first row, {NOISE}, is what the targets leave open: rows "
        "near or above it cannot be ranked by these references.",
        "",
        "![Core-seconds and error](leaderboard.png)",
    ]
    for one in widths:
        lines += ["", f"## {one.width} x {one.width} pixels", ""]
        lines += [f"{one.num_views} views of {one.num_scenes} scenes.", "", _scores_of(one)]
        if any(each.lead is not None for each in one.standings):
            lines += ["", f"Mean difference from {text(rival)}, view by view, dB of {METRIC}:", ""]
            lines += [_pairs_of(one)]
    lines += ["", *_paper(widths), "", "## Notes", "", *(f"- {text(each)}." for each in notes)]
    lines += ["", "## What the figures are", ""]
    lines += [f"- `{name}`: {text(metric.meaning)}" for name, metric in METRICS.items()]
    return "\n".join(lines) + "\n"


def _scores_of(one: WidthStandings) -> str:
    head = ["", "first view, core-s", "further view", *METRICS, "front"]
    rows = [
        [
            text(standing.name),
            *(_seconds(each) for each in (standing.first_s, standing.further_s)),
            *(_with_tail(name, standing) for name in METRICS),
            {True: "yes", False: "no", None: ""}[standing.on_front],
        ]
        for standing in one.standings
    ]
    return table(head, rows, numbers=len(head) - 1)


def _seconds(value: float | None) -> str:
    return "" if value is None else number_text(value)


def _with_tail(name: str, standing: Standing) -> str:
    figures = standing.scores[name]
    if figures["median"] is None:
        return _NONE
    digits = METRICS[name].decimals
    return f"{figures['median']:.{digits}f} ({figures['worse_5_percent']:.{digits}f})"


def _pairs_of(one: WidthStandings) -> str:
    rows = [
        [text(each.name), *_pair_cells(each.lead)]
        for each in one.standings
        if each.lead is not None
    ]
    return table(["", "more, dB", "95 % interval by scene", "better in"], rows, numbers=3)


def _pair_cells(lead: PairedLead) -> list[str]:
    return [f"{lead.mean:+.2f}", interval(lead, 2) or _NONE, f"{lead.share_better:.0%}"]


def interval(lead: PairedLead, decimals: int) -> str:
    """Return the ends of an interval as text; empty if there is no interval."""
    if lead.low is None or lead.high is None:
        return ""
    return f"{lead.low:+.{decimals}f} to {lead.high:+.{decimals}f}"


def _paper(widths: Sequence[WidthStandings]) -> list[str]:
    """Return RenderFormer's table, with the means at its width below it."""
    rows = [
        [name, *(f"{figures[metric]:g}" for metric in PUBLISHED)]
        for name, figures in PUBLISHED_ROWS.items()
    ]
    ours = [one for one in widths if one.width == _PAPER_PX]
    for one in ours:
        rows += [
            [f"here: {text(each.name)}", *(_mean(metric, each) for metric in PUBLISHED)]
            for each in one.standings
        ]
    ours_text = f" Below it our means at {_PAPER_PX} pixels." if ours else ""
    return [
        "## Beside the paper",
        "",
        f"{PUBLISHED_WHERE} Means, as there.{ours_text}",
        "",
        table(["", *PUBLISHED], rows, numbers=len(PUBLISHED)),
    ]


def _mean(metric: str, standing: Standing) -> str:
    value = standing.scores[metric]["mean"]
    return _NONE if value is None else f"{value:.{METRICS[metric].decimals}f}"


_PARTS = ("median", "worse_5_percent", "mean", "median_worse_than_noise")


def standings_csv(widths: Sequence[WidthStandings], machine: str) -> bytes:
    """Return leaderboard.csv: a row for each width and contestant, a column for each figure.

    Each row names the machine of its times, since tables of several machines may be merged.
    """
    columns = [f"{metric}_{part}" for metric in METRICS for part in _PARTS]
    head = [
        "width",
        "name",
        "kind",
        "scenes",
        "views",
        "first_core_s",
        "further_core_s",
        "processor",
    ]
    lead = ["lead_mean_db", "lead_low_db", "lead_high_db", "lead_share_better", "on_front"]
    rows = [
        [
            one.width, inert(each.name), each.kind, one.num_scenes, one.num_views,
            each.first_s, each.further_s, None if each.first_s is None else inert(machine),
            *(each.scores[metric][part] for metric in METRICS for part in _PARTS),
            *_lead_cells(each.lead), each.on_front,
        ]
        for one in widths for each in one.standings
    ]  # fmt: skip
    return _csv([*head, *columns, *lead], rows)


def pairs_csv(widths: Sequence[WidthStandings]) -> bytes:
    """Return pairs.csv: the difference of every contestant from every other one."""
    head = ["width", "name", "than", "mean_db", "low_db", "high_db", "share_better"]
    rows = [
        [one.width, inert(first), inert(second), *_lead_cells(lead)]
        for one in widths
        for (first, second), lead in one.pairs.items()
    ]
    return _csv(head, rows)


def _lead_cells(lead: PairedLead | None) -> list[float | None]:
    return [None] * 4 if lead is None else [lead.mean, lead.low, lead.high, lead.share_better]


def _csv(head: Sequence[str], rows: Sequence[Sequence[object]]) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)  # None is an empty cell
    return stream.getvalue().encode(errors="replace")
