"""Makes a leaderboard: selects the contestants, evaluates them, and writes the files."""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from infra.leaderboard.chart import plot_leaderboard
from infra.leaderboard.contest import (
    BoardContest,
    JudgedWidth,
    OnProgress,
    first_keys,
    judge_all,
    judged_width,
)
from infra.leaderboard.contestants import (
    Contestant,
    MethodContestant,
    NearestContestant,
    NetworkContestant,
    SampledContestant,
)
from infra.leaderboard.options import LeaderboardOptions
from infra.leaderboard.page import page, pairs_csv, standings_csv
from infra.leaderboard.picture_folder import folder_contestants
from infra.leaderboard.rows import BoardRows
from infra.leaderboard.standings import WidthStandings, standings_of
from infra.processor import processor
from infra.render.methods import (
    BUILTIN_NETWORKS,
    DIRECT_LIGHT,
    SAMPLES,
    TRACED_LIGHT,
    direct_light_method,
    network_labels,
    network_method,
    network_name,
    traced_network,
)
from infra.tracer_rival import tracing_child
from pipeline.isolation import IsolatedChild
from pipeline.renders.variant import choose_variant
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from train.evaluation.evaluate import BASELINE_SCENES, make_baselines, stored_resolution
from train.loss.lpips import load_lpips

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer

USUAL_WIDTHS = (64, 256, 512)
"""Default widths in pixels, as far as they divide the dataset's width."""

FILTER = "fast"
"""Filter of the path tracer's rows."""

NEAREST_TRAINED = "nearest training view"
NEAREST_OTHER = "nearest other scene"


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
    rival = _names(order.checkpoint or BUILTIN_NETWORKS[:1])[0]
    nearest = _nearest(order, opened, keys)
    with contextlib.ExitStack() as stack:
        contest = BoardContest(
            shards=shards,
            keys=keys,
            num_views=opened.num_views,
            timed_scenes=order.timed_scenes,
            machine=processor() or "an unnamed processor",
            widths=widths,
            contestants=[
                *folder_contestants(order.pictures, views, widths).values(),
                *([nearest] if nearest else []),
                *_builtin_entries(stack),
                *_networks(order),
            ],
            lpips=load_lpips(order.lpips),
            rows=BoardRows(order.out / "rows.jsonl", opened.digest),
            notes=() if nearest else (ALONE,),
        )
        judge_all(contest, on_progress)
    return _write_leaderboard(order, opened, contest, rival)


def widths_of(requested: Sequence[int], stored: int) -> list[int]:
    """Return the widths to evaluate, ascending; raises TrilightError if one does not divide."""
    if wrong := [width for width in requested if stored % width]:
        raise TrilightError(
            f"--width is {wrong[0]}; expected a divisor of {stored}, the width of the set. "
            "Generate it at another --resolution for wider pictures."
        )
    usual = [width for width in USUAL_WIDTHS if stored % width == 0]
    return sorted(set(requested or usual or [stored]))


def _names(places: Sequence[str]) -> list[str]:
    """Return the row names of networks, by the folder of a run and without paths."""
    return [network_name(label) for label in network_labels(places)]


def _builtin_entries(stack: contextlib.ExitStack) -> Iterator[Contestant]:
    """Yield the traced contestants, which every leaderboard has."""
    yield MethodContestant(DIRECT_LIGHT, direct_light_method, notes=())
    traced = functools.cache(traced_network)
    yield MethodContestant(TRACED_LIGHT, lambda width: network_method(traced(), width), notes=())
    variant = choose_variant()

    @functools.cache
    def child() -> IsolatedChild:
        return stack.enter_context(contextlib.closing(tracing_child(variant)))

    for level in SAMPLES:
        if level[1] == FILTER:
            yield SampledContestant(level, variant, child)


ALONE = "no picture is looked up: the set has no scene beside the one that is judged"


def _nearest(
    order: LeaderboardOptions, opened: TrainingData, keys: Sequence[str]
) -> NearestContestant | None:
    """Return the lookup among pictures of the training split, or of the other scenes.

    None if the only scene to look up is the only evaluated one.
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
        return None
    name = NEAREST_TRAINED if trained else NEAREST_OTHER
    note = (
        f"{name} is found by the target itself, among the first {BASELINE_SCENES} scenes of the "
        f"{split} split: no way to look one of them up can do better"
    )
    if not trained:
        note += ". The set has no training split, so that its other scenes are looked up"
    return NearestContestant(
        name,
        lambda width: make_baselines(pool.split(split), width),
        pool=f"{pool.digest} {split}",
        not_itself=pool.digest == opened.digest,
        notes=(note,),
    )


def _networks(order: LeaderboardOptions) -> Iterator[Contestant]:
    """Yield the built-in networks and those of the options, each once."""
    from model.neural_renderer import NeuralRenderer

    places = [
        *BUILTIN_NETWORKS,
        *(place for place in order.checkpoint if place not in BUILTIN_NETWORKS),
    ]
    names = _names(places)
    if twice := [name for name in names if names.count(name) > 1]:
        raise TrilightError(
            f"--checkpoint: {twice[0]} is there twice; expected each network once, in folders of "
            "different names."
        )
    for name, place in zip(names, places, strict=True):
        renderer = NeuralRenderer.load(place, device="cpu")
        yield NetworkContestant(name, renderer, [_about_network(name, renderer)])


def _about_network(name: str, renderer: "NeuralRenderer") -> str:
    """Return a sentence on a network's weights and what it was trained on."""
    trained = renderer.trained
    width = "an unknown width" if trained.resolution is None else f"{trained.resolution} pixels"
    most = "" if trained.max_triangles is None else f", at most {trained.max_triangles} triangles"
    return f"{name} is {renderer.digest[:8]}, trained at {width}{most}"


def _write_leaderboard(
    order: LeaderboardOptions, opened: TrainingData, contest: BoardContest, rival: str
) -> Leaderboard:
    kinds = {one.name: one.kind for one in contest.contestants}
    judged = [judged_width(contest, width) for width in contest.widths]
    tables = tuple(standings_of(one, kinds, rival) for one in judged if one.views)
    if not tables:
        why = next(iter(contest.left_out.values()), "the split is empty")
        raise TrilightError(f"leaderboard: no scene could be rendered by all entries ({why}).")
    about = {
        "set": f"{opened.build or 'a set of unknown build'}, digest {opened.digest[:12]}",
        "split": order.split,
        "scenes": str(len(contest.keys)),
        "processor": contest.machine,
    }
    notes = tuple(dict.fromkeys([*_notes(contest, tables), *_beyond(contest, judged)]))
    write_atomically(order.out / "leaderboard.md", page(about, tables, notes, rival).encode())
    write_atomically(order.out / "leaderboard.csv", standings_csv(tables, contest.machine))
    write_atomically(order.out / "pairs.csv", pairs_csv(tables))
    title = f"{opened.build or 'leaderboard'}: what core-seconds buy"
    plot_leaderboard(tables, title, order.out / "leaderboard.png")
    return Leaderboard(widths=tables, notes=notes, rival=rival, out=order.out)


FEW_SCENES = 10
"""Number of scenes below which intervals over scenes are too narrow."""


def _notes(contest: BoardContest, tables: Sequence[WidthStandings]) -> Iterator[str]:
    yield from contest.notes
    for one in contest.contestants:
        yield from one.notes
        for width in contest.widths:
            if why := one.why_not(width):
                yield f"{one.name} is not judged at {width} pixels: {why}"
    for (width, key), why in contest.left_out.items():
        yield f"scene {key} is left out at {width} pixels: {why}"
    for machine in sorted(contest.rows.machines() - {contest.machine}):
        yield (
            f"rows.jsonl also has core-seconds of {machine}, which are not in the table: those of "
            "two machines do not compare"
        )
    if any(one.num_scenes == 1 for one in tables):
        yield "of one scene there are no intervals: it says nothing of others"
    elif min(one.num_scenes for one in tables) < FEW_SCENES:
        yield f"fewer than {FEW_SCENES} scenes: intervals are narrower than they should be"
    if contest.lpips is None:
        yield "LPIPS is n/a without its weights (--lpips)"
    yield "targets went through the path tracer's denoiser, which favours its rows a little"
    yield (
        "the references' noise was measured at the width of the set; less is left at smaller ones. "
        "In log_l1 it is an upper bound, and in SSIM, LPIPS and HDR-FLIP that of independent noise "
        "of its size, where a denoiser's is smoother: a row may score better than it"
    )


def _beyond(contest: BoardContest, judged: Sequence[JudgedWidth]) -> Iterator[str]:
    """Yield a note for each network that rendered larger scenes than it was trained on."""
    sizes = {view.key: view.num_triangles for one in judged for view in one.views}
    for one in contest.contestants:
        most = one.most_triangles if isinstance(one, NetworkContestant) else None
        larger = 0 if most is None else sum(size > most for size in sizes.values())
        if larger:
            yield (
                f"{larger} of {len(sizes)} scenes have more triangles than any that {one.name} was "
                "trained on"
            )
