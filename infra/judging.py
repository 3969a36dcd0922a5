"""Evaluation of a trained network on a dataset: its figures, and the report's files."""

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from infra.tracer_rival import TIMED_SCENES, TracerRival
from model.open import find_network
from model.weights import network_digest
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from storage.typed_json import read_json
from train.evaluation.evaluate import (
    EvalConfig,
    judge_views,
    make_baselines,
    sheet_views,
    stored_resolution,
    worst_and_median,
    worst_of_each_excursion,
)
from train.evaluation.judged_view import NETWORK, JudgedView
from train.evaluation.report import markdown, record
from train.evaluation.same_time import same_time
from train.evaluation.sheet import draw_sheet, write_picture
from train.loop.distributed import choose_device
from train.loss.lpips import load_lpips
from train.result import pretty_json

EqualTimeReport = Callable[[Sequence[JudgedView]], dict[str, Any]]
"""Function that compares the evaluated views with the path tracer in equal time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Result of an evaluation."""

    record: dict[str, Any]
    """All figures as JSON values (train.evaluation.report)."""
    views: tuple[JudgedView, ...]
    """Scores of each view, in the order of the dataset."""
    contest: EvalConfig
    """Network, data and baselines of the evaluation."""


def judge_network(
    checkpoint: str,
    data: Sequence[str],
    *,
    split: str = "test",
    train_data: Sequence[str] | None = None,
    resolution: int | None = None,
    most_scenes: int = 10**6,
    tracer_views: int = 64,
    lpips: str | None = None,
    device: str | None = None,
    done: Callable[[int, int], None] = lambda now, total: None,
) -> Judgement:
    """Evaluate a network on each view, with the view's noise floor and simple baselines.

    Args:
        checkpoint: folder of a run, its model.safetensors, a checkpoint, or `builtin:`.
        data: root of a dataset, or shards by name or pattern.
        split: split of the dataset.
        train_data: data of the baselines' training pictures; by default `data`, if it has any.
        resolution: width in pixels; by default the network's training width, else the data's.
        most_scenes: maximum number of scenes, from the start of the split.
        tracer_views: maximum number of views on which the path tracer is evaluated in the network's
            time (infra.tracer_rival); 0 for none. Where it fails, the record says why.
        lpips: folder of LPIPS' weights, or `hub`; without them LPIPS is n/a.
        device: cpu or cuda; by default cuda if there is a GPU.
        done: called with (finished, all) scenes.

    Raises:
        TrilightError: the network or the data does not exist, or the split is empty.
    """
    opened = open_training_data(data)
    rivals = opened if train_data is None else open_training_data(train_data)
    network_file = find_network(checkpoint)
    shards = opened.split(split)
    if resolution is None:
        stored = stored_resolution(shards)
        resolution = min(network_file.trained.resolution or stored, stored)
    torch_device = choose_device(device)
    distance = load_lpips(lpips)
    contest = EvalConfig(
        network=network_file.open().to(torch_device),
        shards=shards,
        resolution=resolution,
        baselines=make_baselines(rivals.split("train"), resolution)
        if "train" in rivals.splits
        else None,
        lpips=None if distance is None else distance.to(torch_device),
        most_scenes=most_scenes,
    )
    counted = _SceneCounter(done, _num_scenes(contest))
    with _tracing(contest, tracer_views) as (contest, traced):
        views = judge_views(contest, counted.one_more)
    about = _about(checkpoint, opened, contest, split, views)
    return Judgement(
        record=record(views, about, traced(views)), views=tuple(views), contest=contest
    )


@contextlib.contextmanager
def _tracing(contest: EvalConfig, most_views: int) -> Iterator[tuple[EvalConfig, EqualTimeReport]]:
    """Add the path tracer in the network's time to the evaluation, if it can trace the scenes."""
    rival = TracerRival(contest.resolution, most_views=most_views, num_scenes=_num_scenes(contest))
    with contextlib.closing(rival):
        samples = list(itertools.islice(contest.samples(), TIMED_SCENES))
        times = rival.measure(contest.network, samples)
        if times.preview is not None:
            contest = dataclasses.replace(contest, traced=rival)
        yield contest, lambda views: same_time(views, times, rival.which)


def write_judgement(judgement: Judgement, out: str | Path) -> Path:
    """Write evaluation.json, evaluation.md and sheets of pictures into a folder.

    Returns:
        The folder: `out`, or the first of out-2, out-3 ... without another network's report.

    Raises:
        TrilightError: the folder cannot be written.
    """
    evaluation = judgement.record
    replaceable = (None, evaluation["about"]["network sha256"])
    numbered = (f"{out}-{number}" if number > 1 else out for number in itertools.count(1))
    folder = next(place for place in map(Path, numbered) if _network_of(place) in replaceable)
    write_atomically(folder / "evaluation.json", pretty_json(evaluation))
    write_atomically(folder / "evaluation.md", markdown(evaluation).encode())
    contest = judgement.contest
    views = list(judgement.views)
    chosen = worst_and_median(views)
    if excursions := worst_of_each_excursion(views):
        chosen["worst of each axis"] = excursions
        plot_excursions(folder / "excursions.png", views)
    with contextlib.closing(contest.traced) if contest.traced else contextlib.nullcontext():
        pictures = sheet_views(contest, [row for rows in chosen.values() for row in rows])
    remaining = iter(pictures)
    for name, rows in chosen.items():
        title = (f"{name}, of {len(views)} views at {contest.resolution} pixels, by psnr_log_db",)
        sheet = draw_sheet([next(remaining) for _ in rows], title)
        write_picture(folder / f"{name.replace(' ', '_')}.png", sheet)
    return folder


def _network_of(folder: Path) -> str | None:
    """Return the digest of the network whose report a folder holds; None where it holds none."""
    try:
        data = (folder / "evaluation.json").read_bytes()
        report = read_json(data, dict[str, Any], str(folder))
        return str(report["about"]["network sha256"])
    except OSError:
        return None
    except (TrilightError, KeyError, TypeError):
        return "unknown"


class _SceneCounter:
    """Counter that reports the evaluated scenes and all scenes."""

    def __init__(self, done: Callable[[int, int], None], total: int) -> None:
        self._done = done
        self._total = total
        self._now = 0
        done(0, total)

    def one_more(self) -> None:
        self._now += 1
        self._done(self._now, self._total)


def _about(
    checkpoint: str,
    opened: TrainingData,
    contest: EvalConfig,
    split: str,
    views: Sequence[JudgedView],
) -> dict[str, str | int]:
    """Return the report's facts about itself, without paths of this machine."""
    return {
        "network": Path(checkpoint).name,
        "network sha256": network_digest(contest.network),
        "data": opened.display_name.rstrip("/").rsplit("/", 1)[-1],
        "build": opened.build or "unknown",
        "data digest": opened.digest,
        "split": split,
        "resolution": contest.resolution,
        "scenes": len({view.key for view in views}),
    }


def _num_scenes(contest: EvalConfig) -> int:
    """Return the number of scenes to evaluate; opens only shards that are evaluated anyway."""
    count = 0
    for number in range(len(contest.shards.names)):
        if count < contest.most_scenes:
            count += contest.shards.num_samples(number)
    return min(count, contest.most_scenes)


COLUMNS = 3
"""Number of plots in a row."""


def plot_excursions(path: Path, views: Sequence[JudgedView]) -> int:
    """Plot psnr_log_db beyond the usual range of scenes; return the number of axes.

    Each axis has a plot: a dot is a view, the line the median at each value, the dashed line the
    median of the noise floors. Nothing is written if no view leaves the usual range.
    """
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    axes: dict[str, list[JudgedView]] = {}
    for view in views:
        if view.excursion is not None:
            axes.setdefault(view.excursion[0], []).append(view)
    if not axes:
        return 0
    rows = -(-len(axes) // COLUMNS)
    figure, grid = plt.subplots(
        rows, COLUMNS, figsize=(4.2 * COLUMNS, 3.2 * rows), squeeze=False, layout="constrained"
    )
    for place, (axis, members) in zip(grid.flat, sorted(axes.items()), strict=False):
        at = np.array([view.excursion[1] for view in members if view.excursion is not None])
        scores = np.array([view.scores[NETWORK]["psnr_log_db"] for view in members], float)
        floors = np.array([view.floors["psnr_log_db"] for view in members])
        values = np.unique(at)
        place.plot(at, scores, ".", color="tab:blue", alpha=0.4)
        medians = [np.median(scores[at == value]) for value in values]
        place.plot(values, medians, "-o", color="tab:blue", label="network")
        noise = [np.median(floors[at == value]) for value in values]
        place.plot(values, noise, "--", color="grey", label="noise floor")
        place.set(title=axis.replace("_", " "), xlabel="value", ylabel="psnr_log_db")
        if values[0] > 0 and values[-1] / values[0] > 8:
            place.set_xscale("log")
    grid.flat[0].legend()
    for place in grid.flat[len(axes) :]:
        place.axis("off")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return len(axes)
