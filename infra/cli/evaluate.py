"""`trilight evaluate`: compares a network, or all methods, with the pictures of a dataset."""

import dataclasses
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, print_json, progress, suggest_look
from infra.cli.leaderboard import judge_methods
from infra.cli.options import command
from infra.torch_library import require_torch
from train.evaluation.options import EvaluationOptions


@command("checkpoint")
def evaluate(options: EvaluationOptions) -> None:
    record: dict[str, Any] = {}
    board = options.leaderboard()
    if options.checkpoint:
        if board:
            from infra.leaderboard import check_leaderboard

            check_leaderboard(board)  # the evaluation before it may take hours
        record, out = _judge_network(options, options.checkpoint)
        board = board and dataclasses.replace(board, out=out)
    if board:
        standings = judge_methods(board)
        record = record | {"leaderboard": standings} if record else standings
    print_json(record)


def _judge_network(options: EvaluationOptions, checkpoint: str) -> tuple[dict[str, Any], Path]:
    """Evaluate a network, and print the figures; return figures and folder."""
    first_words(f"Judging {checkpoint} on the split {options.split}")
    require_torch("evaluate")
    from infra.judging import judge_network, write_judgement

    with progress("scenes") as done:
        judgement = judge_network(
            checkpoint,
            data=options.data,
            split=options.split,
            train_data=options.train_data or None,
            resolution=options.resolution,
            most_scenes=options.most_scenes,
            tracer_views=options.tracer_views,
            lpips=options.lpips,
            device=options.device,
            done=done,
        )
    first_words("Drawing the sheets")
    record = judgement.record
    out = write_judgement(judgement, options.report_folder)
    _report(record, out)
    return {name: record[name] for name in ("about", "contestants", "path tracer")}, out


def _report(record: dict[str, Any], out: Path) -> None:
    from train.evaluation.equal_time import sentences
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
