"""Evaluation of a trained network, and leaderboards of all methods: figures, pages and charts.

Folders of OpenEXR pictures from elsewhere are judged beside renderers; all are checked first.
"""

import contextlib
import copy
import dataclasses
import functools
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from infra.render.methods import (
    BUILTIN_NETWORKS,
    compared_renderers,
    kind_of,
    network_labels,
    network_name,
)
from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from model.inference import NeuralRenderer
from model.open import find_network
from model.weights import network_digest
from pipeline.exchange.exports.export import picture_name
from pipeline.foreign.picture import MAX_BYTES, MAX_PIXELS, read_linear_picture
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import MOST_SPP, PreviewSettings
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError
from storage.machine import processor
from storage.records.safe_read import name_unreadable, read_plain
from storage.records.sample import Sample
from storage.renderer import Renderer
from storage.typed_json import read_json
from train.evaluation.cost_charts import plot_excursions, plot_leaderboard
from train.evaluation.evaluate import (
    BASELINE_SCENES,
    TIMED_SCENES,
    EvalConfig,
    Filter,
    Level,
    equal_time,
    judge_views,
    make_baselines,
    rows_of_sheets,
    sheet_views,
    spread_text,
    spread_views,
    stored_resolution,
    time_both,
)
from train.evaluation.leaderboard import (
    Board,
    OnProgress,
    WidthStandings,
    first_keys,
    judge_all,
    standings_of,
)
from train.evaluation.metrics import NETWORK, JudgedView
from train.evaluation.options import LeaderboardOptions
from train.evaluation.report_pages import (
    evaluation_page,
    leaderboard_page,
    pairs_csv,
    record,
    standings_csv,
)
from train.evaluation.sheet import draw_sheet, write_picture
from train.evaluation.validation import PictureSource, nearest_view
from train.folder import pretty_json
from train.loop.distributed import choose_device
from train.loss.training_loss import load_lpips

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
            time (train.evaluation.evaluate); 0 for none. Where it fails, the record says why.
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
            tracers = stack.enter_context(_previews(LADDER, contest.resolution))
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


@contextlib.contextmanager
def _previews(levels: Sequence[Level], resolution: int) -> Iterator[list[Renderer]]:
    """Yield path tracers of one thread by samples and filter."""
    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        yield [
            PathTracer(child, PreviewSettings(resolution=resolution, spp=spp, denoiser=denoiser))
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
    chosen = rows_of_sheets(views)
    plot_excursions(folder / "excursions.png", views)
    with contextlib.ExitStack() as stack:
        if preview := evaluation["path tracer"]["preview"]:
            level = (preview["samples"], preview["denoiser"])
            (tracer,) = stack.enter_context(_previews([level], contest.resolution))
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


USUAL_WIDTHS = (64, 256, 512)
"""Default widths in pixels, as far as they divide the dataset's width."""

SAMPLES = (1, 4, 16)
"""Samples per pixel of the path tracer's rows, with the fast filter."""

NEAREST_TRAINED = "nearest training view"
NEAREST_OTHER = "nearest other scene"

BASELINE = "picture of another scene"
ELSEWHERE = "pictures made elsewhere"
"""Kinds of stored pictures, in addition to those of infra.render.methods."""

ALONE = "no picture is looked up: the set has no scene beside the one that is judged"

FEW_SCENES = 10
"""Number of scenes below which intervals over scenes are too narrow."""

_LEAST = -1e-2
"""Least radiance that still counts as a network's rounding of 0."""

Views = Sequence[tuple[str, int]]
"""Scene key and camera of every evaluated view."""


@dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Finished leaderboard."""

    widths: tuple[WidthStandings, ...]
    """Table of each width, ascending."""
    notes: tuple[str, ...]
    rival: str
    """Name of the row that all others are compared with."""


def make_leaderboard(options: LeaderboardOptions, on_progress: OnProgress) -> Leaderboard:
    """Evaluate the missing views; write leaderboard.md, leaderboard.csv, pairs.csv and a chart.

    Raises:
        TrilightError: the dataset, a network or a folder of pictures is unusable, the folder's rows
            are of another dataset, or no view could be evaluated.
    """
    with open_board(options) as (board, opened):
        judge_all(board, on_progress)
    rival = network_name(network_labels(options.checkpoint or BUILTIN_NETWORKS)[0])
    standings = [standings_of(board, width, rival) for width in board.widths]
    tables = tuple(one for one in standings if one is not None)
    if not tables:
        why = next(iter(board.left_out.values()), "the split is empty")
        raise TrilightError(f"leaderboard: no scene could be rendered by all entries ({why}).")
    about = {
        "set": f"{opened.build or 'a set of unknown build'}, digest {opened.digest[:12]}",
        "split": options.split,
        "scenes": str(len(board.keys)),
        "processor": board.machine,
    }
    notes = tuple(dict.fromkeys([*board.notes, *_notes(board, tables)]))
    for name, data in {
        "leaderboard.md": leaderboard_page(about, tables, notes, rival).encode(),
        "leaderboard.csv": standings_csv(tables, board.machine),
        "pairs.csv": pairs_csv(tables),
    }.items():
        write_atomically(options.out / name, data)
    title = f"{opened.build or 'leaderboard'}: what CPU seconds buy"
    plot_leaderboard(tables, title, options.out / "leaderboard.png")
    return Leaderboard(widths=tables, notes=notes, rival=rival)


@contextlib.contextmanager
def open_board(options: LeaderboardOptions) -> Iterator[tuple[Board, TrainingData]]:
    """Yield board and dataset; raises TrilightError for wrong options or pictures."""
    opened = open_training_data([options.source])
    shards = opened.split(options.split)
    if opened.num_views is None:
        raise TrilightError(
            f"{opened.display_name} is a list of shards; expected a dataset with its manifest."
        )
    board = Board(
        shards=shards,
        set_digest=opened.digest,
        keys=first_keys(shards, options.scenes),
        num_views=opened.num_views,
        timed_scenes=options.timed_scenes,
        machine=processor() or "an unnamed processor",
        widths=widths_of(options.width, stored_resolution(shards)),
        lpips=load_lpips(options.lpips),
        folder=options.out,
    )
    _add_folders(board, options.pictures)
    _add_nearest(board, options, opened)
    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        _add_renderers(board, options.checkpoint, child)
        yield board, opened


def widths_of(requested: Sequence[int], stored: int) -> list[int]:
    """Return the widths to evaluate, ascending; raises TrilightError if one does not divide."""
    if wrong := [width for width in requested if stored % width]:
        raise TrilightError(
            f"the width is {wrong[0]}; expected a divisor of {stored}, the width of the set. "
            "Generate it at another --resolution for wider pictures."
        )
    usual = [width for width in USUAL_WIDTHS if stored % width == 0]
    return sorted(set(requested or usual or [stored]))


def _add_folders(board: Board, folders: Sequence[Path]) -> None:
    views = [(key, view) for key in board.keys for view in range(board.num_views)]
    names: list[str] = []
    for folder in folders:
        pictures = picture_folder(folder, views, board.widths)
        if pictures.name in names:
            raise TrilightError(
                f"--pictures {folder}: another folder has the same name; expected different ones."
            )
        names.append(pictures.name)
        board.add(pictures, ELSEWHERE)
        board.notes.append(
            f"{pictures.name} were made elsewhere: what they cost is not known, and they are "
            f"judged at {pictures.resolution} pixels alone"
        )


def _add_nearest(board: Board, options: LeaderboardOptions, opened: TrainingData) -> None:
    """Add the lookup among pictures of the training split, or of the other scenes.

    There is none if the only scene to look up is the only evaluated one.
    """
    pool = open_training_data(options.train_data) if options.train_data else opened
    trained = "train" in pool.splits
    split = "train" if trained else options.split
    if options.train_data and not trained:
        raise TrilightError(
            f"--train-data {pool.display_name}: it has no training split; expected one. Leave it "
            "out to look up the other scenes of the set."
        )
    is_own = pool.digest == opened.digest
    if is_own and first_keys(pool.split(split), 2) == board.keys[:2] == board.keys[:1]:
        board.notes.append(ALONE)
        return
    name = NEAREST_TRAINED if trained else NEAREST_OTHER
    for width in board.widths:
        read = functools.partial(make_baselines, pool.split(split), width)
        pool_name = f"{pool.digest} {split}"
        nearest = nearest_view(name, width, read, pool=pool_name, not_itself=is_own)
        board.add(nearest, BASELINE)
    note = (
        f"{name} is found by the target itself, among the first {BASELINE_SCENES} scenes of the "
        f"{split} split: no way to look one of them up can do better"
    )
    if not trained:
        note += ". The set has no training split, so that its other scenes are looked up"
    board.notes.append(note)


def _add_renderers(board: Board, checkpoints: Sequence[str], child: RenderChild) -> None:
    """Add the built-in networks, those of the options, traced light and the path tracer."""
    places = [*BUILTIN_NETWORKS, *(each for each in checkpoints if each not in BUILTIN_NETWORKS)]
    names = [network_name(label) for label in network_labels(places)]
    if twice := [name for name in names if names.count(name) > 1]:
        raise TrilightError(
            f"{twice[0]} is there twice; expected each network once, in folders of different names."
        )
    networks: dict[str, NeuralRenderer] = {}
    for name, place in zip(names, places, strict=True):
        network = networks[name] = NeuralRenderer.load(place, device="cpu")
        trained = network.trained
        width = "an unknown width" if trained.resolution is None else f"{trained.resolution} pixels"
        triangles = trained.max_triangles
        most = "" if triangles is None else f", at most {triangles} triangles"
        board.notes.append(f"{name} is {network.digest[:8]}, trained at {width}{most}")
    for px in board.widths:
        fitting = {}
        for name, network in networks.items():
            try:
                network.config.require_resolution(px)
                fitting[name] = network
            except TrilightError as error:
                why = str(error).rstrip(".")
                board.notes.append(f"{name} is not judged at {px} pixels: {why}")
        for one in compared_renderers(px, fitting, child, [(spp, "fast") for spp in SAMPLES]):
            board.add(one, kind_of(one.name))


def _notes(board: Board, tables: Sequence[WidthStandings]) -> Iterator[str]:
    for (width, key), why in board.left_out.items():
        yield f"scene {key} is left out at {width} pixels: {why}"
    for machine in sorted(board.rows.machines() - {board.machine}):
        yield (
            f"rows.jsonl also has CPU seconds of {machine}, which are not in the table: those of "
            "two machines do not compare"
        )
    if any(one.num_scenes == 1 for one in tables):
        yield "of one scene there are no intervals: it says nothing of others"
    elif min(one.num_scenes for one in tables) < FEW_SCENES:
        yield f"fewer than {FEW_SCENES} scenes: intervals are narrower than they should be"
    if board.lpips is None:
        yield "LPIPS is n/a without its weights (--lpips)"
    yield "targets went through the path tracer's denoiser, which favors its rows a little"
    yield (
        "the references' noise was measured at the width of the set; less is left at smaller ones. "
        "In log_l1 it is an upper bound, and in metrics after it, SSIM, LPIPS and HDR-FLIP that of "
        "independent noise of its size, where a denoiser's is smoother: a row may score better"
    )
    sizes = {key: size for one in tables for key, size in one.triangles.items()}
    for method in board.methods:
        most = method.network.trained.max_triangles if isinstance(method, NetworkRenderer) else None
        larger = 0 if most is None else sum(size > most for size in sizes.values())
        if larger:
            yield (
                f"{larger} of {len(sizes)} scenes have more triangles than any that {method.name} "
                "was trained on"
            )


def picture_folder(folder: Path, views: Views, widths: Sequence[int]) -> PictureSource:
    """Return a folder of pictures from elsewhere, all of one width, after checking every view's.

    Values slightly below 0, which networks of logarithms return, count as 0; alpha is ignored.

    Raises:
        TrilightError: a picture is missing, unreadable, of another width than the first one or than
            the evaluated ones, or has values that are not finite or below 0.
    """
    if not folder.is_dir():
        raise TrilightError(f"--pictures {folder}: no such folder; expected one.")
    missing = [name for name in views if not (folder / picture_name(*name)).is_file()]
    if missing:
        raise TrilightError(
            f"--pictures {folder}: {len(missing)} of {len(views)} pictures are missing, the first "
            f"is {picture_name(*missing[0])}; expected one for each view, called as `trilight "
            "export SET --form exr` calls them. Fewer scenes can be judged (--scenes of "
            "leaderboard, --most-scenes of evaluate)."
        )
    sha256: dict[tuple[str, int], str] = {}
    by_width: dict[int, Path] = {}
    for key, view in views:
        path = folder / picture_name(key, view)
        data, radiance_rgb = _read_picture(path, widths)
        by_width.setdefault(len(radiance_rgb), path)
        sha256[key, view] = sha256_hex(data)
    if len(by_width) > 1:
        listed = ", ".join(f"{path.name} has {width}" for width, path in by_width.items())
        raise TrilightError(
            f"--pictures {folder}: its pictures have several widths ({listed}); expected one. "
            "Put those of each width into a folder of their own."
        )
    (resolution,) = by_width

    def pictures(sample: Sample) -> NDArray[np.float32]:
        names = [picture_name(sample.key, view) for view in range(sample.scene.num_views)]
        paths = [folder / name for name in names]
        read = [_read_picture(path, [resolution])[1] for path in paths]
        return np.maximum(np.stack(read), 0)

    return PictureSource(
        name=f"pictures of {folder.name or folder.resolve().name}",
        resolution=resolution,
        digest=lambda key, view: sha256[key, view],
        pictures=pictures,
    )


def _read_picture(path: Path, widths: Sequence[int]) -> tuple[bytes, NDArray[np.float32]]:
    """Return a file, and the radiance [R, R, 3] in it, whose width is one of `widths`."""
    with name_unreadable(path.name):
        if path.stat().st_size > MAX_BYTES:
            raise TrilightError(f"{path.name}: expected a picture of at most {MAX_BYTES} bytes.")
        data = read_plain(path)
    try:
        linear = read_linear_picture(data, MAX_PIXELS)
    except Rejected as error:
        if error.reason == "too_many_pixels":
            raise TrilightError(f"{path.name}: {error.message}.") from error
        linear = None
    if linear is None or linear.values.shape[2] < 3:
        raise TrilightError(
            f"{path.name}: no readable OpenEXR picture of channels R, G and B; expected linear "
            "radiance as `trilight export SET --form exr` writes it."
        )
    height, width = linear.values.shape[:2]
    if height != width or width not in widths:
        expected = " or ".join(f"{each} x {each}" for each in widths)
        raise TrilightError(
            f"{path.name}: {width} x {height} pixels; expected {expected}. Render it at that size, "
            "or choose another width."
        )
    radiance_rgb = linear.values[..., :3].copy()
    illegal = ~(np.isfinite(radiance_rgb) & (radiance_rgb >= _LEAST))
    if illegal.any():
        row, column, channel = (int(place) for place in np.argwhere(illegal)[0])
        raise TrilightError(
            f"{path.name}: row {row}, column {column} is {radiance_rgb[row, column].tolist()}, and "
            f"{int(illegal.any(axis=-1).sum())} pixels are like it; expected finite radiance of at "
            f"least 0 (channel {'RGB'[channel]}). Make the picture again."
        )
    return data, radiance_rgb
