"""A trained network judged on a dataset: the figures, and the files that show them."""

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
    Contest,
    judged_views,
    make_rivals,
    sheet_views,
    stored_resolution,
    worst_and_median,
    worst_of_each_excursion,
)
from train.evaluation.judged_view import NETWORK, JudgedView
from train.evaluation.report import markdown, record
from train.evaluation.same_time import same_time
from train.evaluation.sheet import drawn_sheet, write_picture
from train.loop.checkpoints import network_of_run
from train.loop.crew import choose_device
from train.loss.lpips import load_lpips
from train.result import pretty_json

Told = Callable[[Sequence[JudgedView]], dict[str, Any]]
"""Says of the judged views what the same time buys elsewhere."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """The result of an evaluation."""

    record: dict[str, Any]
    """All that was measured, as JSON values (train.evaluation.report)."""
    views: tuple[JudgedView, ...]
    """View by view."""
    contest: Contest
    """Who was judged on what."""


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
    """Judge a network view by view, beside each view's own noise floor and simple baselines.

    Args:
        checkpoint: folder of a run, its model.safetensors, a checkpoint, or `builtin:`.
        data: root of a dataset, or shards by name or pattern.
        split: which of its splits.
        train_data: data of the baselines' training pictures; by default `data`, if it has any.
        resolution: pixels across; by default what the network was trained at, else the data's.
        most_scenes: the first so many scenes are judged.
        tracer_views: on so many views at most the path tracer is judged in the network's own time
            (infra.tracer_rival); 0: nothing is traced. Where it cannot be, the record says why.
        lpips: folder of LPIPS' weights, or `hub`; without them LPIPS is n/a.
        device: cpu or cuda; by default cuda where there is one.
        done: called with (finished, all) scenes.

    Raises:
        TrilightError: no such network or data, or a split that holds no scene.
    """
    opened = open_training_data(data)
    rivals = opened if train_data is None else open_training_data(train_data)
    found = find_network(checkpoint, network_of_run)
    shards = opened.split(split)
    if resolution is None:
        stored = stored_resolution(shards)
        resolution = min(found.trained.resolution or stored, stored)
    place = choose_device(device)
    distance = load_lpips(lpips)
    contest = Contest(
        network=found.open().to(place),
        shards=shards,
        resolution=resolution,
        rivals=make_rivals(rivals.split("train"), resolution) if "train" in rivals.splits else None,
        lpips=None if distance is None else distance.to(place),
        most_scenes=most_scenes,
    )
    counted = _Counted(done, _num_scenes(contest))
    with _tracing(contest, tracer_views) as (contest, traced):
        views = judged_views(contest, counted.one_more)
    about = _about(checkpoint, opened, contest, split, views)
    return Judgement(
        record=record(views, about, traced(views)), views=tuple(views), contest=contest
    )


@contextlib.contextmanager
def _tracing(contest: Contest, most_views: int) -> Iterator[tuple[Contest, Told]]:
    """Enter a contest with the path tracer in the network's own time, if one can be had."""
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
    found = judgement.record
    own = (None, found["about"]["network sha256"])
    numbered = (f"{out}-{number}" if number > 1 else out for number in itertools.count(1))
    folder = next(place for place in map(Path, numbered) if _network_of(place) in own)
    write_atomically(folder / "evaluation.json", pretty_json(found))
    write_atomically(folder / "evaluation.md", markdown(found).encode())
    contest = judgement.contest
    views = list(judgement.views)
    chosen = worst_and_median(views)
    if excursions := worst_of_each_excursion(views):
        chosen["worst of each axis"] = excursions
        plot_excursions(folder / "excursions.png", views)
    with contextlib.closing(contest.traced) if contest.traced else contextlib.nullcontext():
        pictures = sheet_views(contest, [row for rows in chosen.values() for row in rows])
    shown = iter(pictures)
    for name, rows in chosen.items():
        title = (f"{name}, of {len(views)} views at {contest.resolution} pixels, by psnr_log_db",)
        sheet = drawn_sheet([next(shown) for _ in rows], title)
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


class _Counted:
    """Reports the number of judged scenes and of all."""

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
    contest: Contest,
    split: str,
    views: Sequence[JudgedView],
) -> dict[str, str | int]:
    """Return what the report says of itself; no path of this machine."""
    return {
        "network": Path(checkpoint).name,
        "network sha256": network_digest(contest.network),
        "data": opened.shown.rstrip("/").rsplit("/", 1)[-1],
        "build": opened.build or "unknown",
        "data digest": opened.digest,
        "split": split,
        "resolution": contest.resolution,
        "scenes": len({view.key for view in views}),
    }


def _num_scenes(contest: Contest) -> int:
    """Return how many scenes will be judged; opens no shard that is not judged anyway."""
    count = 0
    for number in range(len(contest.shards.names)):
        if count < contest.most_scenes:
            count += contest.shards.num_samples(number)
    return min(count, contest.most_scenes)


COLUMNS = 3
"""Plots in a row."""


def plot_excursions(path: Path, views: Sequence[JudgedView]) -> int:
    """Draw how psnr_log_db falls off beyond the usual range; return how many axes there are.

    One plot for each axis: a dot is a view, the line the median at each value, the dashed line
    that of the noise floors. Nothing is written where no view leaves the usual range.
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
