"""Evaluation and leaderboard as JSON values, as Markdown for people, and as CSV for programs."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from storage.markdown import inert, table, text
from train.evaluation.cost_charts import number_text
from train.evaluation.evaluate import TRACER, sentences
from train.evaluation.leaderboard import NOISE, WidthStandings
from train.evaluation.metrics import (
    GROUPED,
    METRIC,
    METRICS,
    NEAR_DB,
    NETWORK,
    JudgedView,
    PairedLead,
    by_group,
    interval_text,
    summarize_views,
)

BENCHMARK = "benchmark-v1"
"""Name of our public test set (pipeline.presets.frozen_v1)."""

PUBLISHED_METRICS = ("psnr_linear_db", "ssim", "lpips", "hdr_flip")

PUBLISHED_ROWS = {
    "RenderFormer, 12 + 6 layers, 205 M (the paper's)": (29.77, 0.9526, 0.0551, 0.1751),
    "9 + 9 layers": (30.11, 0.9554, 0.0512, 0.1735),
    "6 + 12 layers": (30.38, 0.9560, 0.0504, 0.1685),
    "view stage in world space": (28.98, 0.9420, 0.0631, 0.1904),
    "without DPT": (29.75, 0.9476, 0.0552, 0.1806),
    "without self-attention of rays": (29.70, 0.9503, 0.0570, 0.1766),
    "without either": (29.15, 0.9396, 0.0641, 0.1836),
}

"""Zeng et al. 2025, Table 1: PUBLISHED_METRICS as means over 400 scenes of four views each, 256 x
256. The weights of the first row were published."""

PUBLISHED_WHERE = (
    "The paper's figures (Zeng et al. 2025, Table 1) are of 400 scenes of its own with four views "
    "each at 256 x 256, which were never released, and it does not say how it tone-mapped: same "
    "kind of set, not the same set."
)


def record(
    views: Sequence[JudgedView],
    about: Mapping[str, Any],
    traced: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return all measurements of an evaluation as JSON values.

    Args:
        about: network, data, split and resolution, as the report shows them.
        traced: comparison at equal time (evaluation.evaluate); None if it was not measured.
    """
    ours = summarize_views(views)
    both = [view for view in views if GROUPED in view.scores]  # one pass, and groups of lights
    theirs = zip(PUBLISHED_METRICS, next(iter(PUBLISHED_ROWS.values())), strict=True)
    published = {
        metric: {"published": figure, "ours": ours[metric]["mean"]} for metric, figure in theirs
    }
    return {
        "about": dict(about),
        "metrics": {name: metric.meaning for name, metric in METRICS.items()},
        "contestants": {
            name: summarize_views(views, name)
            for name in views[0].scores
            if all(name in view.scores for view in views)
        },
        "path tracer": traced,
        "swapped scenes": loss_by_swapping(views),
        "light passes": {
            "one pass": summarize_views(both, NETWORK),
            "groups": summarize_views(both, GROUPED),
        }
        if both
        else None,
        "published": published if about.get("build") == BENCHMARK else None,
        "groups": by_group(views),
        "views": [asdict(view) for view in views],
    }


def loss_by_swapping(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return the loss of psnr_log_db with another scene's triangles; None for a single scene."""
    losses_db = [
        own_db - view.swapped_psnr_log_db
        for view in views
        if view.swapped_psnr_log_db is not None
        and (own_db := view.scores[NETWORK]["psnr_log_db"]) is not None
    ]
    if not losses_db:
        return None
    return {
        "views": len(losses_db),
        "median_db": float(np.median(losses_db)),
        "mean_db": float(np.mean(losses_db)),
        "share_lost": float(np.mean(np.array(losses_db) > 0)),
    }


_NONE = "n/a"
_PAPER_PX = 256
_PARTS = ("median", "worse_5_percent", "mean", "median_worse_than_noise")


def evaluation_page(report: Mapping[str, Any]) -> str:
    """Return evaluation.md of a report (train.evaluation.report_pages.record)."""
    contestants = report["contestants"]
    network = contestants[NETWORK]
    lines = ["# Evaluation", "", *_facts(report["about"])]
    lines += [
        "",
        "Median over all views; in brackets the worse 5 %.",
        "",
        scores_table(contestants),
    ]
    gaps = [_score(name, network[name]["median_worse_than_noise"]) for name in METRICS]
    drawn = ", ".join(name for name, metric in METRICS.items() if metric.floor is None)
    lines += [
        "",
        "Median of how much worse the network's picture is than the noise of its own target. The "
        "noise of the PSNRs was measured, at the resolution of the data; log_l1 stands against an "
        f"upper bound of it, and against independent noise of that size stand {drawn}:",
        "",
        table(["", *METRICS], [["worse than noise", *gaps]], numbers=len(gaps)),
        "",
        f"{network['near_floor']:.1%} of {network['views']} views are within {NEAR_DB:g} dB of "
        "their floor.",
    ]
    if traced := report["path tracer"]:
        lines += ["", "## Beside the path tracer, in the network's own time", ""]
        lines += [text(" ".join(sentences(traced)))]
        if "tracer" in traced:
            both = {NETWORK: traced["network"], TRACER: traced["tracer"]}
            lines += ["", scores_table(both)]
    if loss := report["swapped scenes"]:
        lines += ["", swapped_text(loss)]
    if report["published"]:
        lines += ["", *_paper({NETWORK: network})]
    if passes := report["light passes"]:
        lines += ["", "## Many lights: one pass, or groups added up", "", _medians_table(passes)]
    for split, parts in report["groups"].items():
        lines += ["", f"## By {split}", "", _medians_table(parts)]
    return "\n".join([*lines, "", *_meanings(report["metrics"])]) + "\n"


def leaderboard_page(
    about: Mapping[str, str], widths: Sequence[WidthStandings], notes: Sequence[str], rival: str
) -> str:
    """Return leaderboard.md.

    Args:
        rival: name of the row that all others are compared with.
    """
    lines = ["# Leaderboard", "", *_facts(about)]
    lines += [
        "",
        "Medians over views, in brackets the worse 5 %; sorted by psnr_log_db. CPU seconds are "
        "medians over the timed scenes, one thread of a processor, everything warm: a scene's "
        "first view with its loading, and a further one. A row is on the front where no other one "
        f"is as good at its price. The first row, {NOISE}, is what the targets leave open: rows "
        "near or above it cannot be ranked by these references.",
        "",
        "![CPU seconds and error](leaderboard.png)",
    ]
    for one in widths:
        lines += ["", f"## {one.width} x {one.width} pixels", ""]
        lines += [f"{one.num_views} views of {one.num_scenes} scenes.", "", _standings_table(one)]
        if any(each.lead is not None for each in one.standings):
            lines += ["", f"Mean difference from {text(rival)}, view by view, dB of {METRIC}:", ""]
            lines += [_pairs_table(one)]
    ours = [one for one in widths if one.width == _PAPER_PX]
    means = {each.name: each.scores for one in ours for each in one.standings}
    lines += ["", *_paper(means), "", "## Notes", "", *(f"- {text(each)}." for each in notes)]
    meanings = {name: metric.meaning for name, metric in METRICS.items()}
    return "\n".join([*lines, "", *_meanings(meanings)]) + "\n"


def scores_table(contestants: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table of summaries (metrics.summarize_views) by method."""
    metrics = [name for name in METRICS if all(name in each for each in contestants.values())]
    rows = [
        [text(who), *(_with_tail(name, scores) for name in metrics)]
        for who, scores in contestants.items()
    ]
    return table(["", *metrics], rows, numbers=len(metrics))


def swapped_text(loss: Mapping[str, Any]) -> str:
    """Return a sentence on what the network loses with another scene's triangles."""
    return (
        f"With the triangles of another scene the network loses {loss['median_db']:.2f} dB of "
        f"psnr_log_db in the median and {loss['mean_db']:.2f} dB on average, and is worse in "
        f"{loss['share_lost']:.1%} of {loss['views']} views. What looks at no scene loses nothing."
    )


def _facts(about: Mapping[str, object]) -> list[str]:
    return [f"- {name}: {text(value)}" for name, value in about.items()]


def _meanings(meanings: Mapping[str, str]) -> list[str]:
    better = {name: "higher" if METRICS[name].higher_is_better else "lower" for name in meanings}
    return [
        "## What the figures are",
        "",
        *(f"- `{name}` ({better[name]} is better): {text(meanings[name])}" for name in meanings),
    ]


def _medians_table(parts: Mapping[str, Any]) -> str:
    rows = [
        [
            text(name),
            part["views"],
            *(_score(metric, part[metric]["median"]) for metric in METRICS),
            _score(METRIC, part[METRIC]["median_worse_than_noise"]),
        ]
        for name, part in parts.items()
    ]
    head = ["part", "views", *METRICS, "dB below stated error"]
    return table(head, rows, numbers=len(head) - 1)


def _standings_table(one: WidthStandings) -> str:
    head = ["", "first view, CPU s", "further view", *METRICS, "front"]
    rows = [
        [
            text(standing.name),
            *("" if s is None else number_text(s) for s in (standing.first_s, standing.further_s)),
            *(_with_tail(name, standing.scores) for name in METRICS),
            {True: "yes", False: "no", None: ""}[standing.on_front],
        ]
        for standing in one.standings
    ]
    return table(head, rows, numbers=len(head) - 1)


def _pairs_table(one: WidthStandings) -> str:
    rows = [
        [
            text(each.name),
            f"{each.lead.mean:+.2f}",
            interval_text(each.lead.low, each.lead.high) or _NONE,
            f"{each.lead.share_better:.0%}",
        ]
        for each in one.standings
        if each.lead is not None
    ]
    return table(["", "more, dB", "95 % interval by scene", "better in"], rows, numbers=3)


def _paper(ours: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return RenderFormer's table, with means of methods below it."""
    rows = [[name, *(f"{each:g}" for each in figures)] for name, figures in PUBLISHED_ROWS.items()]
    for name, scores in ours.items():
        means = [_score(metric, scores[metric]["mean"]) for metric in PUBLISHED_METRICS]
        rows.append([f"here: {text(name)}", *means])
    return [
        "## Beside the paper",
        "",
        f"{PUBLISHED_WHERE} Means, as there{', ours below it' if ours else ''}.",
        "",
        table(["", *PUBLISHED_METRICS], rows, numbers=len(PUBLISHED_METRICS)),
    ]


def _with_tail(name: str, scores: Mapping[str, Any]) -> str:
    figures = scores[name]
    if figures["median"] is None:
        return _NONE
    return f"{_score(name, figures['median'])} ({_score(name, figures['worse_5_percent'])})"


def _score(metric: str, value: float | None) -> str:
    return _NONE if value is None else f"{value:.{METRICS[metric].decimals}f}"


def standings_csv(widths: Sequence[WidthStandings], machine: str) -> bytes:
    """Return leaderboard.csv: a row for each width and method, a column for each figure.

    Each row names the machine of its times, since tables of several machines may be merged.
    """
    return _csv(
        {
            "width": one.width,
            "name": inert(each.name),
            "kind": each.kind,
            "scenes": one.num_scenes,
            "views": one.num_views,
            "first_core_s": each.first_s,
            "further_core_s": each.further_s,
            "processor": None if each.first_s is None else inert(machine),
            **{f"{name}_{part}": each.scores[name][part] for name in METRICS for part in _PARTS},
            **{f"lead_{name}": value for name, value in _lead_cells(each.lead).items()},
            "on_front": each.on_front,
        }
        for one in widths
        for each in one.standings
    )


def pairs_csv(widths: Sequence[WidthStandings]) -> bytes:
    """Return pairs.csv: the difference of every method from every other one."""
    return _csv(
        {"width": one.width, "name": inert(first), "than": inert(second), **_lead_cells(lead)}
        for one in widths
        for (first, second), lead in one.pairs.items()
    )


def _lead_cells(lead: PairedLead | None) -> dict[str, float | None]:
    names = {"mean": "mean_db", "low": "low_db", "high": "high_db", "share_better": "share_better"}
    return {column: getattr(lead, name, None) for name, column in names.items()}


def _csv(rows: Iterable[Mapping[str, object]]) -> bytes:
    """Return rows with the same columns as CSV; None is an empty cell."""
    stream = io.StringIO(newline="")
    if each := list(rows):
        writer = csv.DictWriter(stream, each[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(each)
    return stream.getvalue().encode(errors="replace")
