"""Report of an evaluation, as JSON and as Markdown."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from train.evaluation.judged_view import (
    GROUPED,
    NEAR_DB,
    NETWORK,
    JudgedView,
    by_group,
    summarize_views,
)
from train.evaluation.metrics import METRICS
from train.evaluation.published import PUBLISHED_WHERE, compare_with_published
from train.evaluation.same_time import TRACER, sentences

NOT_AVAILABLE = "n/a"


def record(
    views: Sequence[JudgedView],
    about: Mapping[str, Any],
    traced: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return all measurements of an evaluation as JSON values.

    Args:
        views: rows of the evaluation.
        about: network, data, split and resolution, as the report shows them.
        traced: comparison at equal time (evaluation.same_time); None if it was not measured.
    """
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
        "light passes": passes_compared(views),
        "published": compare_with_published(views, about),
        "groups": by_group(views),
        "views": [dataclasses.asdict(view) for view in views],
    }


def markdown(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown: a table of all methods, and one for each grouping."""
    lines = ["# Evaluation", ""]
    lines += [
        f"- {name}: {_escape_markdown(str(value))}" for name, value in report["about"].items()
    ]
    lines += ["", "Median over all views; in brackets the worse 5 %.", ""]
    lines += _contestant_table(report["contestants"])
    network = report["contestants"][NETWORK]
    lines += ["", *_noise_lines(network)]
    lines += _same_time_lines(report["path tracer"])
    lines += _swapped_lines(report["swapped scenes"])
    lines += _published_lines(report["published"]) + _light_pass_lines(report["light passes"])
    for split, parts in report["groups"].items():
        lines += ["", f"## By {split}", "", *_group_table(parts)]
    lines += ["", "## What the figures are", ""]
    lines += [f"- `{name}`: {meaning}" for name, meaning in report["metrics"].items()]
    return "\n".join(lines) + "\n"


def _contestant_table(contestants: Mapping[str, Any]) -> list[str]:
    names = list(contestants)
    rows = []
    for name, metric in METRICS.items():
        cells = [_with_tail(name, contestants[each][name]) for each in names]
        better = "higher" if metric.higher_is_better else "lower"
        rows.append([f"{name} ({better} is better)", *cells])
    return _table(["metric", *names], rows)


def _noise_lines(network: Mapping[str, Any]) -> list[str]:
    rows = []
    for metric in METRICS:
        gap = network[metric]["median_worse_than_noise"]
        rows.append([metric, _format_score(metric, gap)])
    drawn = ", ".join(name for name, metric in METRICS.items() if metric.floor is None)
    return [
        "Median of how much worse the network's picture is than the noise of its own target. The "
        "noise of the PSNRs was measured, at the resolution of the data; log_l1 stands against an "
        f"upper bound of it, and against independent noise of that size stand {drawn}:",
        "",
        *_table(["metric", "worse than noise"], rows),
        "",
        f"{network['near_floor']:.1%} of {network['views']} views are within {NEAR_DB:g} dB of "
        "their floor.",
    ]


def _same_time_lines(traced: Mapping[str, Any] | None) -> list[str]:
    if traced is None:
        return []
    lines = ["", "## Beside the path tracer, in the network's own time", ""]
    lines += [_escape_markdown(" ".join(sentences(traced)))]
    if "tracer" not in traced:
        return lines
    both = {name: traced[part] for name, part in ((NETWORK, "network"), (TRACER, "tracer"))}
    return [*lines, "", *_contestant_table(both)]


def _swapped_lines(loss: Mapping[str, Any] | None) -> list[str]:
    if loss is None:
        return []
    return [
        "",
        f"With the triangles of another scene the network loses {loss['median_db']:.2f} dB of "
        f"psnr_log_db in the median and {loss['mean_db']:.2f} dB on average, and is worse in "
        f"{loss['share_lost']:.1%} of {loss['views']} views. What looks at no scene loses nothing.",
    ]


def _published_lines(comparison: Mapping[str, Any] | None) -> list[str]:
    if comparison is None:
        return []
    rows = [
        [metric, f"{figures['published']:g}", _format_score(metric, figures["ours"])]
        for metric, figures in comparison.items()
    ]
    return [
        "",
        "## Beside the paper",
        "",
        f"{PUBLISHED_WHERE} Means, as there.",
        "",
        *_table(["metric", "published", "this network"], rows),
    ]


def _light_pass_lines(passes: Mapping[str, Any] | None) -> list[str]:
    if passes is None:
        return []
    rows = [
        [name, str(part["views"])]
        + [_format_score(metric, part[metric]["median"]) for metric in METRICS]
        for name, part in passes.items()
    ]
    return [
        "",
        "## Many lights: one pass, or groups added up",
        "",
        *_table(["", "views", *METRICS], rows),
    ]


def _group_table(parts: Mapping[str, Any]) -> list[str]:
    rows = [
        [_escape_markdown(name), str(part["views"])]
        + [_format_score(metric, part[metric]["median"]) for metric in METRICS]
        + [_format_score("psnr_log_db", part["psnr_log_db"]["median_worse_than_noise"])]
        for name, part in parts.items()
    ]
    return _table(["part", "views", *METRICS, "dB below noise floor"], rows)


def _with_tail(metric: str, figures: Mapping[str, Any]) -> str:
    if figures["median"] is None:
        return NOT_AVAILABLE
    tail = _format_score(metric, figures["worse_5_percent"])
    return f"{_format_score(metric, figures['median'])} ({tail})"


def _format_score(metric: str, value: float | None) -> str:
    return NOT_AVAILABLE if value is None else f"{value:.{METRICS[metric].decimals}f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        f"| {' | '.join(head)} |",
        f"|{'---|' * len(head)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def _escape_markdown(text: str) -> str:
    """Escape text so that Markdown shows it literally."""
    for character in "\\|<>[]`*_":
        text = text.replace(character, f"\\{character}")
    return text.replace("\n", " ")


def passes_compared(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return summaries of one pass and of light groups over the views that have both, or None."""
    both = [view for view in views if GROUPED in view.scores]
    if not both:
        return None
    return {"one pass": summarize_views(both, NETWORK), "groups": summarize_views(both, GROUPED)}


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
