"""Makes a leaderboard: selects the methods, judges them, and writes the files.

Folders of OpenEXR pictures from elsewhere are judged beside renderers; all are checked first.
"""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.processor import processor
from infra.render.methods import (
    BUILTIN_NETWORKS,
    compared_renderers,
    kind_of,
    network_labels,
    network_name,
)
from infra.render.path_tracer import RenderChild
from model.inference import NeuralRenderer
from pipeline.exchange.exports.scenes import picture_name
from pipeline.exchange.pictures import MAX_BYTES, decode_pixels
from pipeline.renders.mitsuba_variant import choose_variant
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.records.sample import Sample
from train.evaluation.chart import plot_leaderboard
from train.evaluation.evaluate import BASELINE_SCENES, make_baselines, stored_resolution
from train.evaluation.leaderboard import (
    Board,
    OnProgress,
    WidthStandings,
    first_keys,
    judge_all,
    standings_of,
)
from train.evaluation.options import LeaderboardOptions
from train.evaluation.report_pages import leaderboard_page, pairs_csv, standings_csv
from train.evaluation.validation import PictureSource, nearest_view
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
    out: Path


def make_leaderboard(options: LeaderboardOptions, on_progress: OnProgress) -> Leaderboard:
    """Evaluate the missing views; write leaderboard.md, leaderboard.csv, pairs.csv and a chart.

    Raises:
        TrilightError: the dataset, a network or a folder of pictures is unusable, the folder's rows
            are of another dataset, or no view could be evaluated.
    """
    with _open_board(options) as (board, opened, most_triangles):
        judge_all(board, on_progress)
        return _write_leaderboard(options, opened, board, most_triangles)


def check_leaderboard(options: LeaderboardOptions) -> None:
    """Raise TrilightError for wrong options or pictures of a leaderboard that is made later."""
    with _open_board(options):
        pass


@contextlib.contextmanager
def _open_board(
    options: LeaderboardOptions,
) -> Iterator[tuple[Board, TrainingData, dict[str, int]]]:
    """Yield board, dataset, and the most triangles that each network was trained on."""
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
        yield board, opened, _add_renderers(board, options.checkpoint, child)


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


def _add_renderers(board: Board, checkpoints: Sequence[str], child: RenderChild) -> dict[str, int]:
    """Add the built-in networks, those of the options, traced light and the path tracer.

    Returns:
        Triangles of the largest scene that a network was trained on, by its name.
    """
    places = [*BUILTIN_NETWORKS, *(each for each in checkpoints if each not in BUILTIN_NETWORKS)]
    names = _names(places)
    if twice := [name for name in names if names.count(name) > 1]:
        raise TrilightError(
            f"{twice[0]} is there twice; expected each network once, in folders of different names."
        )
    networks: dict[str, NeuralRenderer] = {}
    most_triangles: dict[str, int] = {}
    for name, place in zip(names, places, strict=True):
        network = networks[name] = NeuralRenderer.load(place, device="cpu")
        trained = network.trained
        width = "an unknown width" if trained.resolution is None else f"{trained.resolution} pixels"
        most = ""
        if trained.max_triangles is not None:
            most_triangles[name] = trained.max_triangles
            most = f", at most {trained.max_triangles} triangles"
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
    return most_triangles


def _names(places: Sequence[str]) -> list[str]:
    """Return the row names of networks, by the folder of a run and without paths."""
    return [network_name(label) for label in network_labels(places)]


def _write_leaderboard(
    options: LeaderboardOptions,
    opened: TrainingData,
    board: Board,
    most_triangles: dict[str, int],
) -> Leaderboard:
    rival = _names(options.checkpoint or BUILTIN_NETWORKS[:1])[0]
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
    every_note = [*board.notes, *_notes(board, tables), *_beyond(most_triangles, tables)]
    notes = tuple(dict.fromkeys(every_note))
    page = leaderboard_page(about, tables, notes, rival)
    write_atomically(options.out / "leaderboard.md", page.encode())
    write_atomically(options.out / "leaderboard.csv", standings_csv(tables, board.machine))
    write_atomically(options.out / "pairs.csv", pairs_csv(tables))
    title = f"{opened.build or 'leaderboard'}: what CPU seconds buy"
    plot_leaderboard(tables, title, options.out / "leaderboard.png")
    return Leaderboard(widths=tables, notes=notes, rival=rival, out=options.out)


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


def _beyond(most_triangles: dict[str, int], tables: Sequence[WidthStandings]) -> Iterator[str]:
    """Yield a note for each network that rendered larger scenes than it was trained on."""
    sizes = {key: size for one in tables for key, size in one.triangles.items()}
    for name, most in most_triangles.items():
        larger = sum(size > most for size in sizes.values())
        if larger:
            yield (
                f"{larger} of {len(sizes)} scenes have more triangles than any that {name} was "
                "trained on"
            )


def picture_folder(folder: Path, views: Views, widths: Sequence[int]) -> PictureSource:
    """Return a folder of pictures from elsewhere, all of one width, after checking every view's.

    Values slightly below 0, which networks of logarithms return, count as 0; alpha is ignored.

    Raises:
        TrilightError: a picture is missing, unreadable, of another width than the first one or than
            the evaluated ones, or has values that are not finite or below 0.
    """
    _require_all(folder, views)
    sha256: dict[tuple[str, int], str] = {}
    by_width: dict[int, Path] = {}
    for key, view in views:
        path = folder / picture_name(key, view)
        data = _bytes_of(path)
        by_width.setdefault(_picture(data, path, widths).shape[0], path)
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
        read = [_picture(_bytes_of(path), path, [resolution]) for path in paths]
        return np.maximum(np.stack(read), 0)

    return PictureSource(
        name=f"pictures of {folder.name or folder.resolve().name}",
        resolution=resolution,
        digest=lambda key, view: sha256[key, view],
        pictures=pictures,
    )


def _require_all(folder: Path, views: Views) -> None:
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


def _bytes_of(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise TrilightError(f"{path.name}: expected a picture of at most {MAX_BYTES} bytes.")
        return read_plain(path)
    except OSError as error:
        raise TrilightError(f"{path.name}: cannot be read ({error.strerror}).") from error


def _picture(data: bytes, path: Path, widths: Sequence[int]) -> NDArray[np.float32]:
    """Return the radiance [R, R, 3] of a file whose width is one of `widths`."""
    pixels = decode_pixels(data, path.name)
    if pixels is None or pixels.dtype != np.float32 or pixels.shape[2] < 3:
        raise TrilightError(
            f"{path.name}: no readable OpenEXR picture of channels R, G and B; expected linear "
            "radiance as `trilight export SET --form exr` writes it."
        )
    height, width = pixels.shape[:2]
    if height != width or width not in widths:
        expected = " or ".join(f"{each} x {each}" for each in widths)
        raise TrilightError(
            f"{path.name}: {width} x {height} pixels; expected {expected}. Render it at that size, "
            "or choose another width."
        )
    radiance_rgb = np.asarray(pixels[..., :3], np.float32)
    illegal = ~(np.isfinite(radiance_rgb) & (radiance_rgb >= _LEAST))
    if illegal.any():
        row, column, channel = (int(place) for place in np.argwhere(illegal)[0])
        raise TrilightError(
            f"{path.name}: row {row}, column {column} is {radiance_rgb[row, column].tolist()}, and "
            f"{int(illegal.any(axis=-1).sum())} pixels are like it; expected finite radiance of at "
            f"least 0 (channel {'RGB'[channel]}). Make the picture again."
        )
    return radiance_rgb
