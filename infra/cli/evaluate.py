"""`trilight evaluate`: a trained network against the pictures of a dataset."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, look_at, print_json, progress_bars
from infra.torch_library import require_torch


def evaluate(
    checkpoint: Annotated[str, typer.Argument(help="run folder, model.safetensors or checkpoint")],
    data: Annotated[
        list[str], typer.Option(help="root of a dataset, or shards by name or pattern; repeatable")
    ],
    split: Annotated[str, typer.Option(help="train, validation or test")] = "test",
    train_data: Annotated[
        list[str] | None,
        typer.Option(help="data of the rivals' training pictures [the same, if it has any]"),
    ] = None,
    resolution: Annotated[
        int | None,
        typer.Option(help="pixels across [the run's if known, else the data's]"),
    ] = None,
    most_scenes: Annotated[int, typer.Option(min=1, help="judge the first so many scenes")] = 10**6,
    lpips: Annotated[
        str | None,
        typer.Option(help="folder of LPIPS' weights, or hub [$TRILIGHT_LPIPS; else LPIPS is n/a]"),
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="cpu or cuda [cuda where there is one]")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder of the report")] = Path("evaluation"),
    json: Annotated[bool, typer.Option(help="print the summary as JSON")] = False,
) -> None:
    """Judge a network; writes evaluation.json, evaluation.md and sheets of pictures."""
    first_words(f"Judging {checkpoint} on the split {split}", silent=json)
    require_torch("evaluate")
    from infra.judging import judge_network, write_judgement

    with progress_bars() as bars:
        task = bars.add_task("scenes", total=None, note="", visible=not json)
        judgement = judge_network(
            checkpoint,
            data,
            split=split,
            train_data=train_data,
            resolution=resolution,
            most_scenes=most_scenes,
            lpips=lpips,
            device=device,
            done=lambda now, total: bars.update(task, completed=now, total=total),
        )
    first_words(f"Drawing the sheets of {out}", silent=json)
    found = judgement.record
    write_judgement(judgement, out)
    if json:
        print_json({name: found[name] for name in ("about", "contestants")})
    else:
        _report(found, out)


def _report(found: dict[str, Any], out: Path) -> None:
    from train.evaluation.metrics import METRICS

    contestants = found["contestants"]
    table = Table(box=None, title_justify="left", header_style="dim")
    table.title = Text(f"Evaluation, medians over {len(found['views'])} views", style="bold")
    table.add_column("", style="dim", no_wrap=True)
    for name in contestants:
        table.add_column(Text(name), justify="right")
    for name, metric in METRICS.items():
        medians = [scores[name]["median"] for scores in contestants.values()]
        shown = ["n/a" if value is None else f"{value:.{metric.decimals}f}" for value in medians]
        table.add_row(name, *shown)
    near = [scores.get("near_floor") for scores in contestants.values()]
    table.add_row(
        "within 3 dB of the noise", *("" if share is None else f"{share:.1%}" for share in near)
    )
    console.print(table)
    look_at(f"Read {out / 'evaluation.md'}, look at {out / 'worst.png'}")
