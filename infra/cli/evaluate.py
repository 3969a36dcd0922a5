"""`trilight evaluate`: a trained network against the pictures of a dataset."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, look_at, print_json, progress_bars
from infra.cli.options import Shown, command
from storage.atomic import write_atomically
from storage.errors import TrilightError
from train.evaluation.order import EvaluationOrder

if TYPE_CHECKING:
    from storage.training_data import TrainingData
    from train.evaluation.evaluate import Contest
    from train.evaluation.judged_view import JudgedView


@command("checkpoint")
def evaluate(order: EvaluationOrder, shown: Shown) -> None:
    out = order.out
    first_words(f"Judging {order.checkpoint} on the split {order.split}", silent=shown.json)
    try:
        from storage.training_data import open_training_data
        from train.evaluation.evaluate import judged_views
        from train.evaluation.report import markdown, record
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise TrilightError("evaluate: torch is not installed; run `make setup-all`.") from error
    opened = open_training_data(order.data)
    rivals = open_training_data(order.train_data) if order.train_data else opened
    contest = _contest(order, opened, rivals)
    with progress_bars() as bars:
        total = _num_scenes(contest)
        task = bars.add_task("scenes", total=total, note="", visible=not shown.json)
        views = judged_views(contest, lambda: bars.advance(task))
    first_words(f"Drawing the sheets of {out}", silent=shown.json)
    found = record(views, _about(order, opened, contest, views))
    write_atomically(out / "evaluation.json", _encoded(found))
    write_atomically(out / "evaluation.md", markdown(found).encode())
    _write_pictures(out, contest, views)
    if shown.json:
        print_json({name: found[name] for name in ("about", "contestants")})
    else:
        _report(found, out)


def _about(
    order: EvaluationOrder,
    opened: "TrainingData",
    contest: "Contest",
    views: "Sequence[JudgedView]",
) -> dict[str, str | int]:
    """Return what the report says of itself; no path of this machine."""
    from model.weights import network_digest

    return {
        "network": Path(order.checkpoint).name,
        "network sha256": network_digest(contest.network),
        "data": opened.shown.rstrip("/").rsplit("/", 1)[-1],
        "build": opened.build or "unknown",
        "data digest": opened.digest,
        "split": order.split,
        "resolution": contest.resolution,
        "scenes": len({view.key for view in views}),
    }


def _contest(order: EvaluationOrder, opened: "TrainingData", rivals: "TrainingData") -> "Contest":
    from train.evaluation.evaluate import Contest, make_rivals, stored_resolution
    from train.loop.crew import choose_device
    from train.loss.lpips_weights import load_lpips
    from train.networks import open_network, trained_resolution

    network = open_network(order.checkpoint)
    shards = opened.split(order.split)
    resolution = (
        order.resolution or trained_resolution(order.checkpoint) or stored_resolution(shards)
    )
    place, distance = choose_device(order.device), load_lpips(order.lpips)
    return Contest(
        network=network.to(place),
        shards=shards,
        resolution=resolution,
        rivals=make_rivals(rivals.split("train"), resolution) if "train" in rivals.splits else None,
        lpips=None if distance is None else distance.to(place),
        most_scenes=order.most_scenes,
    )


def _write_pictures(out: Path, contest: "Contest", views: "list[JudgedView]") -> None:
    from infra.excursion_plots import plot_excursions
    from train.evaluation.evaluate import sheet_views, worst_and_median, worst_of_each_excursion
    from train.evaluation.sheet import drawn_sheet, write_picture

    chosen = worst_and_median(views)
    if excursions := worst_of_each_excursion(views):
        chosen["worst of each axis"] = excursions
        plot_excursions(out / "excursions.png", views)
    shown = iter(sheet_views(contest, [row for rows in chosen.values() for row in rows]))
    for name, rows in chosen.items():
        title = (f"{name}, of {len(views)} views at {contest.resolution} pixels, by psnr_log_db",)
        sheet = drawn_sheet([next(shown) for _ in rows], title)
        write_picture(out / f"{name.replace(' ', '_')}.png", sheet)


def _encoded(found: dict[str, Any]) -> bytes:
    from train.result import pretty_json

    return pretty_json(found)


def _num_scenes(contest: "Contest") -> int:
    """Return how many scenes will be judged; opens no shard that is not judged anyway."""
    count = 0
    for number in range(len(contest.shards.names)):
        if count < contest.most_scenes:
            count += contest.shards.num_samples(number)
    return min(count, contest.most_scenes)


def _report(found: dict[str, Any], out: Path) -> None:
    from train.evaluation.picture_scores import DECIMALS

    contestants = found["contestants"]
    table = Table(box=None, title_justify="left", header_style="dim")
    table.title = Text(f"Evaluation, medians over {len(found['views'])} views", style="bold")
    table.add_column("", style="dim", no_wrap=True)
    for name in contestants:
        table.add_column(Text(name), justify="right")
    for metric, places in DECIMALS.items():
        medians = [scores[metric]["median"] for scores in contestants.values()]
        shown = ["n/a" if value is None else f"{value:.{places}f}" for value in medians]
        table.add_row(metric, *shown)
    near = [scores.get("near_floor") for scores in contestants.values()]
    table.add_row(
        "within 3 dB of the noise", *("" if share is None else f"{share:.1%}" for share in near)
    )
    console.print(table)
    look_at(f"Read {out / 'evaluation.md'}, look at {out / 'worst.png'}")
