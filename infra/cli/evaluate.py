"""`trilight evaluate` and `leaderboard`: compare a network, or all methods, with a dataset."""

import dataclasses
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from infra.cli.console import (
    console,
    first_words,
    note,
    print_json,
    print_table,
    progress,
    suggest_look,
)
from infra.cli.options import command
from infra.torch_library import require_torch
from storage.remote.url import safe_url
from train.evaluation.options import EvaluationOptions, LeaderboardOptions

_JUDGED_BY = (
    "data", "split", "resolution", "most_scenes", "tracer_views", "lpips", "device"
)  # fmt: skip
"""Options that the evaluation of a network takes as they are."""


@command("checkpoint")
def evaluate(options: EvaluationOptions) -> None:
    record: dict[str, Any] = {}
    board = options.leaderboard()
    if options.checkpoint:
        if board:
            from infra.judging import open_board

            with open_board(board):  # checked first: the evaluation before it may take hours
                pass
        first_words(f"Judging {options.checkpoint} on the split {options.split}")
        require_torch("evaluate")
        from infra.judging import judge_network, write_judgement

        with progress("scenes") as done:
            judgement = judge_network(
                options.checkpoint,
                train_data=options.train_data or None,
                done=done,
                **{name: getattr(options, name) for name in _JUDGED_BY},
            )
        first_words("Drawing the sheets")
        out = write_judgement(judgement, options.report_folder)
        _report(judgement.record, out)
        record = {name: judgement.record[name] for name in ("about", "contestants", "path tracer")}
        board = board and dataclasses.replace(board, out=out)
    if board:
        standings = judge_methods(board)
        record = record | {"leaderboard": standings} if record else standings
    print_json(record)


def _report(record: dict[str, Any], out: Path) -> None:
    from train.evaluation.evaluate import sentences
    from train.evaluation.metrics import METRICS

    contestants = record["contestants"]
    table = Table(box=None, title_justify="left", header_style="dim")
    table.title = Text(f"Evaluation, medians over {len(record['views'])} views", style="bold")
    table.add_column("", style="dim", no_wrap=True)
    for name in contestants:
        table.add_column(Text(name), justify="right")
    for name, metric in METRICS.items():
        medians = [scores[name]["median"] for scores in contestants.values()]
        texts = ["n/a" if value is None else f"{value:.{metric.decimals}f}" for value in medians]
        table.add_row(name, *texts)
    near = [scores.get("near_floor") for scores in contestants.values()]
    table.add_row(
        "within 3 dB of the noise", *("" if share is None else f"{share:.1%}" for share in near)
    )
    console.print(table)
    for sentence in sentences(record["path tracer"]):
        console.print(sentence, soft_wrap=True)
    suggest_look(f"Read {out / 'evaluation.md'}, look at {out / 'worst.png'}")


@command("source")
def leaderboard(options: LeaderboardOptions) -> None:
    print_json(judge_methods(options))


def judge_methods(options: LeaderboardOptions) -> dict[str, Any]:
    """Make a leaderboard and print it as text; return it as JSON values."""
    first_words(f"Judging on {safe_url(options.source)}, into {options.out}")
    require_torch("leaderboard")
    from infra.judging import make_leaderboard

    with progress("scenes") as on_progress:
        board = make_leaderboard(options, on_progress)
    for one in board.widths:
        title = f"{one.width} x {one.width} pixels: median psnr_log_db of {one.num_views} views"
        rows = [_row(each) for each in one.standings]
        print_table(f"{title}, lead over {board.rival}", rows)
    for text in board.notes:
        note(text)
    out = options.out
    suggest_look(f"Read {out / 'leaderboard.md'}, look at {out / 'leaderboard.png'}")
    widths = [
        {
            "width": one.width,
            "views": one.num_views,
            "scenes": one.num_scenes,
            "standings": [dataclasses.asdict(each) for each in one.standings],
        }
        for one in board.widths
    ]
    return {"out": str(out), "rival": board.rival, "widths": widths}


def _row(standing: Any) -> dict[str, str]:
    from train.evaluation.cost_charts import number_text
    from train.evaluation.metrics import METRIC, interval_text

    lead = standing.lead
    scores = standing.scores[METRIC]
    ends = interval_text(lead.low, lead.high, 1) if lead is not None else ""
    return {
        "": standing.name,
        "first, s": "" if standing.first_s is None else number_text(standing.first_s),
        "further": "" if standing.further_s is None else number_text(standing.further_s),
        "dB": f"{scores['median']:.1f}",
        "5th": f"{scores['worse_5_percent']:.1f}",
        "lead, dB": "" if lead is None else f"{lead.mean:+.1f}" + (f" ({ends})" if ends else ""),
    }
