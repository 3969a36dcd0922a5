"""`trilight leaderboard`: compares methods and networks on one dataset by error and cost."""

import dataclasses
from typing import Any

from infra.cli.console import (
    first_words,
    note,
    print_json,
    print_table,
    progress,
    suggest_look,
)
from infra.cli.options import command
from infra.torch_library import require_torch
from storage.remote.safe_url import safe_url
from train.evaluation.options import LeaderboardOptions


@command("source")
def leaderboard(options: LeaderboardOptions) -> None:
    print_json(judge_methods(options))


def judge_methods(options: LeaderboardOptions) -> dict[str, Any]:
    """Make a leaderboard and print it as text; return it as JSON values."""
    first_words(f"Judging on {safe_url(options.source)}, into {options.out}")
    require_torch("leaderboard")
    from infra.leaderboard import make_leaderboard

    with progress("scenes") as on_progress:
        board = make_leaderboard(options, on_progress)
    for one in board.widths:
        title = f"{one.width} x {one.width} pixels: median psnr_log_db of {one.num_views} views"
        rows = [_row(each) for each in one.standings]
        print_table(f"{title}, lead over {board.rival}", rows)
    for text in board.notes:
        note(text)
    suggest_look(f"Read {board.out / 'leaderboard.md'}, look at {board.out / 'leaderboard.png'}")
    widths = [
        {
            "width": one.width,
            "views": one.num_views,
            "scenes": one.num_scenes,
            "standings": [dataclasses.asdict(each) for each in one.standings],
        }
        for one in board.widths
    ]
    return {"out": str(board.out), "rival": board.rival, "widths": widths}


def _row(standing: Any) -> dict[str, str]:
    from train.evaluation.cost_charts import number_text
    from train.evaluation.judged_view import METRIC, interval_text

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
