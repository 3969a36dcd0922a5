"""Makes a leaderboard: selects the methods, judges them, and writes the files."""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from infra.judged_renderers import MethodRenderer, network_renderer, samples_renderers
from infra.picture_folder import picture_folders
from infra.processor import processor
from infra.render.methods import (
    BUILTIN_NETWORKS,
    DIRECT_LIGHT,
    TRACED_LIGHT,
    direct_light_method,
    kind_of,
    network_labels,
    network_method,
    network_name,
    samples_name,
    traced_network,
)
from model.neural_renderer import NeuralRenderer
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from train.evaluation.board import (
    Board,
    JudgedWidth,
    Method,
    OnProgress,
    first_keys,
    judge_all,
    judged_width,
)
from train.evaluation.chart import plot_leaderboard
from train.evaluation.evaluate import BASELINE_SCENES, make_baselines, stored_resolution
from train.evaluation.options import LeaderboardOptions
from train.evaluation.pages import leaderboard_page, pairs_csv, standings_csv
from train.evaluation.rows import Rows
from train.evaluation.standings import WidthStandings, standings_of
from train.evaluation.stored_pictures import NearestView, StoredPictures
from train.loss.lpips import load_lpips

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


@dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """Finished leaderboard."""

    widths: tuple[WidthStandings, ...]
    """Table of each width, ascending."""
    notes: tuple[str, ...]
    """Notes for the reader, each once."""
    rival: str
    """Name of the row that all others are compared with."""
    out: Path
    """Folder of the leaderboard's files."""


@dataclass(frozen=True, kw_only=True)
class Lineup:
    """Methods of a leaderboard, and what its reader should know of them."""

    methods: list[Method] = field(default_factory=list)
    """Methods, each of one width, in the order of evaluation."""
    kinds: dict[str, str] = field(default_factory=dict)
    """Kind of each method by name, which decides the chart's color."""
    notes: list[str] = field(default_factory=list)
    """Notes for the reader."""
    most_triangles: dict[str, int] = field(default_factory=dict)
    """Triangles of the largest scene that a network was trained on, by name."""

    def add(self, method: Method, kind: str) -> None:
        """Add a method of one width."""
        self.methods.append(method)
        self.kinds[method.name] = kind


def make_leaderboard(order: LeaderboardOptions, on_progress: OnProgress) -> Leaderboard:
    """Evaluate the missing views; write leaderboard.md, leaderboard.csv, pairs.csv and a chart.

    Raises:
        TrilightError: the dataset, a network or a folder of pictures is unusable, the folder's rows
            are of another dataset, or no view could be evaluated.
    """
    opened = open_training_data([order.source])
    shards = opened.split(order.split)
    if opened.num_views is None:
        raise TrilightError(
            f"SOURCE is {opened.display_name}, a list of shards; expected a dataset with its "
            "manifest."
        )
    widths = widths_of(order.width, stored_resolution(shards))
    keys = first_keys(shards, order.scenes)
    views = [(key, view) for key in keys for view in range(opened.num_views)]
    lineup = Lineup()
    _add_folders(lineup, order, views, widths)
    _add_nearest(lineup, order, opened, keys, widths)
    _add_traced(lineup, widths)
    _add_networks(lineup, order, widths)
    board = Board(
        shards=shards,
        keys=keys,
        num_views=opened.num_views,
        timed_scenes=order.timed_scenes,
        machine=processor() or "an unnamed processor",
        widths=widths,
        methods=lineup.methods,
        lpips=load_lpips(order.lpips),
        rows=Rows(order.out / "rows.jsonl", opened.digest),
    )
    with contextlib.ExitStack() as stack:
        for method in lineup.methods:
            if not isinstance(method, StoredPictures):
                stack.callback(method.close)
        judge_all(board, on_progress)
    return _write_leaderboard(order, opened, board, lineup)


def widths_of(requested: Sequence[int], stored: int) -> list[int]:
    """Return the widths to evaluate, ascending; raises TrilightError if one does not divide."""
    if wrong := [width for width in requested if stored % width]:
        raise TrilightError(
            f"--width is {wrong[0]}; expected a divisor of {stored}, the width of the set. "
            "Generate it at another --resolution for wider pictures."
        )
    usual = [width for width in USUAL_WIDTHS if stored % width == 0]
    return sorted(set(requested or usual or [stored]))


def _add_folders(
    lineup: Lineup,
    order: LeaderboardOptions,
    views: Sequence[tuple[str, int]],
    widths: Sequence[int],
) -> None:
    for folder in picture_folders(order.pictures, views, widths):
        lineup.add(folder, ELSEWHERE)
        lineup.notes.append(
            f"{folder.name} were made elsewhere: what they cost is not known, and they are judged "
            f"at {folder.resolution} pixels alone"
        )


def _add_nearest(
    lineup: Lineup,
    order: LeaderboardOptions,
    opened: TrainingData,
    keys: Sequence[str],
    widths: Sequence[int],
) -> None:
    """Add the lookup among pictures of the training split, or of the other scenes.

    There is none if the only scene to look up is the only evaluated one.
    """
    pool = open_training_data(order.train_data) if order.train_data else opened
    trained = "train" in pool.splits
    split = "train" if trained else order.split
    if order.train_data and not trained:
        raise TrilightError(
            f"--train-data {pool.display_name}: it has no training split; expected one. Leave it "
            "out to "
            "look up the other scenes of the set."
        )
    if pool.digest == opened.digest and first_keys(pool.split(split), 2) == keys[:2] == keys[:1]:
        lineup.notes.append(ALONE)
        return
    name = NEAREST_TRAINED if trained else NEAREST_OTHER
    for width in widths:
        nearest = NearestView(
            name,
            width,
            functools.partial(make_baselines, pool.split(split), width),
            pool=f"{pool.digest} {split}",
            not_itself=pool.digest == opened.digest,
        )
        lineup.add(nearest, BASELINE)
    note = (
        f"{name} is found by the target itself, among the first {BASELINE_SCENES} scenes of the "
        f"{split} split: no way to look one of them up can do better"
    )
    if not trained:
        note += ". The set has no training split, so that its other scenes are looked up"
    lineup.notes.append(note)


def _add_traced(lineup: Lineup, widths: Sequence[int]) -> None:
    """Add the traced methods, which every leaderboard has."""
    traced = traced_network()
    for width in widths:
        direct = direct_light_method(width)
        lineup.add(
            MethodRenderer(DIRECT_LIGHT, direct, width, {"name": DIRECT_LIGHT, "weights": ""}),
            kind_of(TRACED_LIGHT),
        )
        method = network_method(traced, width)
        lineup.add(
            MethodRenderer(TRACED_LIGHT, method, width, {"name": TRACED_LIGHT, "weights": ""}),
            kind_of(TRACED_LIGHT),
        )
        names = {spp: samples_name((spp, "fast")) for spp in SAMPLES}
        for renderer in samples_renderers(names, width):
            lineup.add(renderer, kind_of(renderer.name))


def _add_networks(lineup: Lineup, order: LeaderboardOptions, widths: Sequence[int]) -> None:
    """Add the built-in networks and those of the options, at the widths that each supports."""
    more = [place for place in order.checkpoint if place not in BUILTIN_NETWORKS]
    places = [*BUILTIN_NETWORKS, *more]
    names = _names(places)
    if twice := [name for name in names if names.count(name) > 1]:
        raise TrilightError(
            f"--checkpoint: {twice[0]} is there twice; expected each network once, in folders of "
            "different names."
        )
    for name, place in zip(names, places, strict=True):
        network = NeuralRenderer.load(place, device="cpu")
        trained = network.trained
        width = "an unknown width" if trained.resolution is None else f"{trained.resolution} pixels"
        most = ""
        if trained.max_triangles is not None:
            lineup.most_triangles[name] = trained.max_triangles
            most = f", at most {trained.max_triangles} triangles"
        lineup.notes.append(f"{name} is {network.digest[:8]}, trained at {width}{most}")
        for px in widths:
            try:
                lineup.add(network_renderer(name, network, px), kind_of(name))
            except TrilightError as error:
                why = str(error).rstrip(".")
                lineup.notes.append(f"{name} is not judged at {px} pixels: {why}")


def _names(places: Sequence[str]) -> list[str]:
    """Return the row names of networks, by the folder of a run and without paths."""
    return [network_name(label) for label in network_labels(places)]


def _write_leaderboard(
    order: LeaderboardOptions, opened: TrainingData, board: Board, lineup: Lineup
) -> Leaderboard:
    rival = _names(order.checkpoint or BUILTIN_NETWORKS[:1])[0]
    judged = [judged_width(board, width) for width in board.widths]
    tables = tuple(standings_of(one, lineup.kinds, rival) for one in judged if one.views)
    if not tables:
        why = next(iter(board.left_out.values()), "the split is empty")
        raise TrilightError(f"leaderboard: no scene could be rendered by all entries ({why}).")
    about = {
        "set": f"{opened.build or 'a set of unknown build'}, digest {opened.digest[:12]}",
        "split": order.split,
        "scenes": str(len(board.keys)),
        "processor": board.machine,
    }
    told = [*lineup.notes, *_notes(board, tables), *_beyond(lineup, judged)]
    notes = tuple(dict.fromkeys(told))
    page = leaderboard_page(about, tables, notes, rival)
    write_atomically(order.out / "leaderboard.md", page.encode())
    write_atomically(order.out / "leaderboard.csv", standings_csv(tables, board.machine))
    write_atomically(order.out / "pairs.csv", pairs_csv(tables))
    title = f"{opened.build or 'leaderboard'}: what core-seconds buy"
    plot_leaderboard(tables, title, order.out / "leaderboard.png")
    return Leaderboard(widths=tables, notes=notes, rival=rival, out=order.out)


def _notes(board: Board, tables: Sequence[WidthStandings]) -> Iterator[str]:
    for (width, key), why in board.left_out.items():
        yield f"scene {key} is left out at {width} pixels: {why}"
    for machine in sorted(board.rows.machines() - {board.machine}):
        yield (
            f"rows.jsonl also has core-seconds of {machine}, which are not in the table: those of "
            "two machines do not compare"
        )
    if any(one.num_scenes == 1 for one in tables):
        yield "of one scene there are no intervals: it says nothing of others"
    elif min(one.num_scenes for one in tables) < FEW_SCENES:
        yield f"fewer than {FEW_SCENES} scenes: intervals are narrower than they should be"
    if board.lpips is None:
        yield "LPIPS is n/a without its weights (--lpips)"
    yield "targets went through the path tracer's denoiser, which favours its rows a little"
    yield (
        "the references' noise was measured at the width of the set; less is left at smaller ones. "
        "In log_l1 it is an upper bound, and in SSIM, LPIPS and HDR-FLIP that of independent noise "
        "of its size, where a denoiser's is smoother: a row may score better than it"
    )


def _beyond(lineup: Lineup, judged: Sequence[JudgedWidth]) -> Iterator[str]:
    """Yield a note for each network that rendered larger scenes than it was trained on."""
    sizes = {view.key: view.num_triangles for one in judged for view in one.views}
    for name, most in lineup.most_triangles.items():
        larger = sum(size > most for size in sizes.values())
        if larger:
            yield (
                f"{larger} of {len(sizes)} scenes have more triangles than any that {name} was "
                "trained on"
            )
