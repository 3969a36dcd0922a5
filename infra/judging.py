"""Evaluation of a trained network on a dataset: its figures, and the report's files."""

import contextlib
import copy
import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples
from model.inference import NeuralRenderer
from model.open import find_network
from model.weights import network_digest
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import MOST_SPP
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from storage.renderer import Renderer
from storage.typed_json import read_json
from train.evaluation.chart import plot_excursions
from train.evaluation.equal_time import (
    TIMED_SCENES,
    Filter,
    Level,
    equal_time,
    spread_text,
    spread_views,
    time_both,
)
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
from train.evaluation.report_pages import evaluation_page, record
from train.evaluation.sheet import draw_sheet, write_picture
from train.folder import pretty_json
from train.loop.distributed import choose_device
from train.loss.lpips import load_lpips

FILTERS: tuple[Filter, ...] = ("fast", "high")

LADDER = [(1 << step, each) for step in range(MOST_SPP.bit_length()) for each in FILTERS]
"""Samples per pixel and filters that the path tracer tries in the network's time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Result of an evaluation."""

    record: dict[str, Any]
    """All figures as JSON values (train.evaluation.report_pages)."""
    views: tuple[JudgedView, ...]
    contest: EvalConfig
    """Network, data and baselines of the evaluation."""


def judge_network(
    checkpoint: str | os.PathLike[str],
    *,
    data: str | os.PathLike[str] | Sequence[str],
    split: str = "test",
    train_data: Sequence[str] | None = None,
    resolution: int | None = None,
    most_scenes: int = 10**6,
    tracer_views: int = 64,
    lpips: str | None = None,
    device: str | None = None,
    done: Callable[[int, int], None] = lambda now, total: None,
) -> Judgement:
    """Evaluate a network on each view, with the view's stated error and simple baselines.

    Args:
        checkpoint: folder of a run, its model.safetensors, a checkpoint, or `builtin:`.
        data: root of a dataset, or shards by name or pattern.
        split: split of the dataset.
        train_data: data of the baselines' training pictures; by default `data`, if it has any.
        resolution: width in pixels; by default the network's training width, else the data's.
        most_scenes: maximum number of scenes, from the start of the split.
        tracer_views: maximum number of views on which the path tracer is evaluated in the network's
            time (train.evaluation.equal_time); 0 for none. Where it fails, the record says why.
        lpips: folder of LPIPS' weights, or `hub`; without them LPIPS is n/a.
        device: cpu or cuda; by default cuda if there is a GPU.
        done: called with (finished, all) scenes.

    Raises:
        TrilightError: PyTorch, the network or the data does not exist, or the split is empty.
    """
    opened = open_training_data([os.fspath(data)] if isinstance(data, str | os.PathLike) else data)
    rivals = opened if train_data is None else open_training_data(train_data)
    network_file = find_network(os.fspath(checkpoint))
    shards = opened.split(split)
    stored = stored_resolution(shards)
    resolution = resolution or min(network_file.trained.resolution or stored, stored)
    trained = rivals.split("train") if "train" in rivals.splits else None
    torch_device = choose_device(device)
    distance = load_lpips(lpips)
    contest = EvalConfig(
        network=network_file.open().to(torch_device),
        shards=shards,
        resolution=resolution,
        baselines=None if trained is None else make_baselines(trained, resolution),
        lpips=None if distance is None else distance.to(torch_device),
        most_scenes=most_scenes,
        tracer_views=tracer_views,
    )
    total = contest.num_scenes
    numbers = itertools.count()
    done(next(numbers), total)
    with contextlib.ExitStack() as stack:
        times, tracer = _time_tracer(contest, stack)
        traced = dataclasses.replace(contest, tracer=tracer)
        views = judge_views(traced, lambda: done(next(numbers), total))
    about = _about(Path(checkpoint).name, opened, contest, split, views)
    spread = spread_text(*spread_views(tracer_views, total), 1 + max(row.view for row in views))
    comparison = equal_time(views, times, spread)
    return Judgement(record=record(views, about, comparison), views=tuple(views), contest=contest)


def _time_tracer(
    contest: EvalConfig, stack: contextlib.ExitStack
) -> tuple[dict[str, Any], Renderer | None]:
    """Time the network and the path tracer; return the latter, too, if it can trace the scenes."""
    network = NetworkRenderer(
        name=NETWORK,
        checkpoint=NETWORK,
        resolution=contest.resolution,
        threads=1,  # core-seconds of waiting threads are not the network's
        opened=NeuralRenderer(copy.deepcopy(contest.network).cpu()),
    )
    previews: dict[Level, Renderer] = {}
    note = ""
    missing = "" if contest.tracer_views else "no views of it were requested"
    if contest.tracer_views:
        try:
            note = choose_variant().note
            tracers = _previews(LADDER, contest.resolution, stack)
            previews = dict(zip(LADDER, tracers, strict=True))
        except TrilightError as error:
            missing = str(error).rstrip(".")
    samples = list(itertools.islice(contest.samples(), TIMED_SCENES))
    threads = torch.get_num_threads()
    try:
        times = time_both(network, previews, samples, missing=missing, note=note)
    finally:
        torch.set_num_threads(threads)
    chosen = times["preview"]
    return times, previews[chosen["samples"], chosen["denoiser"]] if chosen else None


def _previews(
    levels: Sequence[Level], resolution: int, stack: contextlib.ExitStack
) -> list[Renderer]:
    """Return path tracers of one thread by samples and filter, until `stack` ends their child."""
    child = RenderChild(choose_variant(), threads=1)
    stack.callback(child.close)
    return [
        PathTracer(child, FixedSamples(spp=spp, denoiser=denoiser), resolution)
        for spp, denoiser in levels
    ]


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
    write_atomically(folder / "evaluation.md", evaluation_page(evaluation).encode())
    contest = judgement.contest
    views = list(judgement.views)
    chosen = worst_and_median(views)
    if excursions := worst_of_each_excursion(views):
        chosen["worst of each axis"] = excursions
        plot_excursions(folder / "excursions.png", views)
    with contextlib.ExitStack() as stack:
        if preview := evaluation["path tracer"]["preview"]:
            level = (preview["samples"], preview["denoiser"])
            (tracer,) = _previews([level], contest.resolution, stack)
            contest = dataclasses.replace(contest, tracer=tracer)
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


def _about(
    network: str,
    opened: TrainingData,
    contest: EvalConfig,
    split: str,
    views: Sequence[JudgedView],
) -> dict[str, str | int]:
    """Return the report's facts about itself, without paths of this machine."""
    return {
        "network": network,
        "network sha256": network_digest(contest.network),
        "data": opened.display_name.rstrip("/").rsplit("/", 1)[-1],
        "build": opened.build or "unknown",
        "data digest": opened.digest,
        "split": split,
        "resolution": contest.resolution,
        "scenes": len({view.key for view in views}),
    }
