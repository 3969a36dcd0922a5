"""Judges every method on every view of a split, adds the missing rows, and makes tables of them.

The evaluation is that of one network (`train.evaluation.evaluate`): targets, masks, metrics and
stated errors are equal. Scores are stored in rows.jsonl, so that no view is evaluated twice; its
first line names the dataset, each other one is a `Row`.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from storage.atomic import append_line
from storage.dataset.shard_set import ShardSet
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, Unrenderable
from storage.records.safe_read import read_plain
from storage.records.sample import Sample
from storage.renderer import Camera, Renderer, fingerprint
from storage.typed_json import read_json_lines
from train.data.bad_samples import first_samples
from train.evaluation.cost_charts import on_front
from train.evaluation.evaluate import Price, median_price, time_scene
from train.evaluation.metrics import (
    METRIC,
    METRICS,
    JudgedView,
    PairedLead,
    noise_floors,
    paired_lead,
    picture_scores,
    scene_facts,
    summarize_views,
)
from train.evaluation.validation import PictureSource, ValidationScene, validation_scene
from train.loss.training_loss import Lpips

UNKNOWN_MACHINE = "a machine that is not named"
"""Machine of old rows, which do not name theirs."""


class RowKey(NamedTuple):
    """Key of a row."""

    width: int
    """Width of the picture in pixels."""
    scene: str
    """Key of the scene's sample in the dataset."""
    view: int
    """Row of the camera in the scene."""
    name: str
    """Name of the method, as in the table."""
    digest: str
    """SHA-256 of everything that decides the picture and its evaluation."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Scores and times of one picture."""

    scores: Mapping[str, float | None]
    """Value by metric; None is n/a."""
    first_s: float | None = None
    """CPU seconds of the scene's first view, loading included; None if it is not timed."""
    further_s: float | None = None
    """CPU seconds of a further view; None if it is not timed."""
    machine: str | None = None
    """Processor of the times; None without times."""
    facts: Mapping[str, Any] | None = None
    """Facts of the scene, in rows of the targets' noise only."""


class Rows:
    """Rows in rows.jsonl of a folder."""

    def __init__(self, path: Path, set_digest: str) -> None:
        """Read the file if it exists, else begin it.

        Raises:
            TrilightError: the file holds rows of another dataset, or no rows.
        """
        self.path = path
        self._rows: dict[RowKey, Row] = {}
        self._prices: dict[tuple[RowKey, str], Price] = {}
        data = read_plain(path) if path.is_file() else b""
        try:
            records = read_json_lines(data, dict[str, Any], str(path), torn_end=True)
            if not records:
                self._append({"set": set_digest})
                return
            stored_digest = str(records[0]["set"])
            for record in records[1:]:
                key = RowKey(*(record.pop(name) for name in RowKey._fields))
                self._keep(key, Row(**record))
        except (ValueError, KeyError, TypeError) as error:
            raise TrilightError(
                f"{path}: not the rows of a leaderboard ({error}). Choose another --out, or delete "
                "the file."
            ) from error
        if stored_digest != set_digest:
            raise TrilightError(
                f"{path}: its rows are of the set {stored_digest[:12]}, and this set is "
                f"{set_digest[:12]}; expected the same set. Choose another --out."
            )

    def get(self, key: RowKey) -> Row | None:
        """Return the row of a key, or None."""
        return self._rows.get(key)

    def price(self, key: RowKey, machine: str) -> Price | None:
        """Return the CPU seconds of first and further view on a machine, or None."""
        return self._prices.get((key, machine))

    def machines(self) -> set[str]:
        """Return the names of all machines with times."""
        return {machine for _, machine in self._prices}

    def add(self, key: RowKey, row: Row) -> None:
        """Append a row to the file; of two rows with one key the later one counts."""
        plain = {name: value for name, value in asdict(row).items() if value is not None}
        self._append({**key._asdict(), **plain})
        self._keep(key, row)

    def _keep(self, key: RowKey, row: Row) -> None:
        self._rows[key] = row
        if row.first_s is not None and row.further_s is not None:
            price = Price(first_s=row.first_s, further_s=row.further_s)
            self._prices[key, row.machine or UNKNOWN_MACHINE] = price

    def _append(self, record: Mapping[str, Any]) -> None:
        append_line(self.path, json.dumps(record, sort_keys=True, allow_nan=False), durable=True)


NOISE = "noise of the references"
"""Name of the row of the targets' own noise, which bounds what any method can score."""

Method = Renderer | PictureSource

OnProgress = Callable[[int, int, str], None]
"""Callback with (finished, all) pairs of scene and width, and the current step as text."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Scenes, widths and methods of a leaderboard, and what its reader should know of them."""

    shards: ShardSet
    """Dataset shards of the evaluated split."""
    set_digest: str
    """Digest of the dataset, which the first line of the rows holds."""
    keys: Sequence[str]
    """Keys of the evaluated scenes, the first ones of the split."""
    num_views: int
    """Number of cameras of each scene."""
    timed_scenes: int
    """Number of scenes, from the start of `keys`, on which renderers are timed."""
    machine: str
    """Name of this processor; times of different processors are not comparable."""
    widths: Sequence[int]
    """Widths of pictures in pixels, ascending."""
    lpips: Lpips | None
    """LPIPS metric; None without its weights."""
    folder: Path
    """Folder in which rows.jsonl is written, and read when a run resumes."""
    methods: list[Method] = field(default_factory=list)
    """Methods, each of one width, in the order of evaluation."""
    kinds: dict[str, str] = field(default_factory=dict)
    """Kind of each method by name, which decides the chart's color."""
    notes: list[str] = field(default_factory=list)
    """Sentences on the methods, without full stops, which stand below the tables."""
    left_out: dict[tuple[int, str], str] = field(default_factory=dict)
    """Reason by (width, key) of scenes that a method cannot render."""
    _renderer_digests: dict[int, str] = field(default_factory=dict, init=False)
    """Digest of each renderer by its `id`."""

    def add(self, method: Method, kind: str) -> None:
        """Add a method of one width."""
        self.methods.append(method)
        self.kinds[method.name] = kind
        if not isinstance(method, PictureSource):
            self._renderer_digests[id(method)] = fingerprint(method.identity)

    @functools.cached_property
    def rows(self) -> Rows:
        """Stored rows; raises TrilightError if those of the folder are of another dataset."""
        return Rows(self.folder / "rows.jsonl", self.set_digest)

    @functools.cached_property
    def _judged_by(self) -> str:
        """Digest of the metrics' definitions."""
        meanings = {metric: METRICS[metric].meaning for metric in METRICS}
        return sha256_hex(canonical_json([meanings, self.lpips is not None]))

    def key_of(self, method: Method, key: str, view: int) -> RowKey:
        """Return the key of a method's row."""
        if isinstance(method, PictureSource):
            made_by = method.digest(key, view)
        else:
            made_by = self._renderer_digests[id(method)]
        return self._row_key(method.resolution, method.name, made_by, key, view)

    def noise_key(self, width: int, key: str, view: int) -> RowKey:
        """Return the key of the row of a target's own noise."""
        return self._row_key(width, NOISE, "", key, view)

    def _row_key(self, width: int, name: str, made_by: str, key: str, view: int) -> RowKey:
        return RowKey(width, key, view, name, sha256_hex(f"{made_by} {self._judged_by}".encode()))

    def present(self, width: int) -> list[Method]:
        """Return the methods of a width."""
        return [method for method in self.methods if method.resolution == width]

    def views(self, width: int) -> Iterator[JudgedView]:
        """Yield the views that every method of a width has, with NOISE as a further method."""
        present = self.present(width)
        known = {one.name for one in dataclasses.fields(JudgedView)}
        for key in self.keys:
            for view in range(self.num_views):
                noise = self.rows.get(self.noise_key(width, key, view))
                rows = {one.name: self.rows.get(self.key_of(one, key, view)) for one in present}
                if noise is None or noise.facts is None or None in rows.values():
                    continue
                floors = {name: value for name, value in noise.scores.items() if value is not None}
                scores = {name: dict(row.scores) for name, row in rows.items() if row is not None}
                scores[NOISE] = {metric: noise.scores.get(metric) for metric in METRICS}
                facts = {name: value for name, value in noise.facts.items() if name in known}
                if facts["excursion"] is not None:  # JSON has no pairs
                    facts["excursion"] = tuple(facts["excursion"])
                yield JudgedView(view=view, floors=floors, scores=scores, **facts)

    def prices(self, width: int) -> dict[str, list[Price]]:
        """Return the prices of this machine by method, one for each timed scene."""
        prices: dict[str, list[Price]] = {}
        for method in self.present(width):
            for key in self.keys[: self.timed_scenes]:
                price = self.rows.price(self.key_of(method, key, 0), self.machine)
                if price is not None and (width, key) not in self.left_out:
                    prices.setdefault(method.name, []).append(price)
        return prices


def first_keys(shards: ShardSet, limit: int) -> list[str]:
    """Return the keys of the first scenes of a split; no picture is read."""
    keys: list[str] = []
    for number in range(len(shards.names)):
        if len(keys) < limit:
            with closing(shards.open(number)) as shard:
                keys += shard.keys
    return keys[:limit]


def judge_all(board: Board, on_progress: OnProgress) -> None:
    """Add every missing row.

    Raises:
        TrilightError: damaged data, or a network that cannot render a scene.
    """
    total = len(board.keys) * len(board.widths)
    samples = first_samples(board.shards, len(board.keys))
    turns = ((row, sample, width) for row, sample in enumerate(samples) for width in board.widths)
    for done, (row, sample, width) in enumerate(turns):
        on_progress(done, total, "")
        judged = functools.cache(functools.partial(validation_scene, sample, width))
        for method in board.present(width):
            timed = row < board.timed_scenes and not isinstance(method, PictureSource)
            views = range(sample.scene.num_views)
            keys = [board.key_of(method, sample.key, view) for view in views]
            is_priced = not timed or board.rows.price(keys[0], board.machine) is not None
            if not is_priced or any(board.rows.get(key) is None for key in keys):
                on_progress(done, total, f"{width} px, {method.name}")
                _judge(board, method, sample, judged, keys, timed=timed)
        _judge_noise(board, sample, width, judged)
    on_progress(total, total, "")


def _judge(
    board: Board,
    method: Method,
    sample: Sample,
    judged: Callable[[], ValidationScene],
    keys: Sequence[RowKey],
    *,
    timed: bool,
) -> None:
    """Add a method's rows of a scene by their keys, or record why the scene is left out."""
    price: dict[str, Any] = {}
    try:
        if isinstance(method, PictureSource):
            pictures = list(method.pictures(sample))
        else:
            scene = sample.scene
            measured = time_scene(method, scene, sample.key) if timed else None
            loaded = measured.loaded if measured else method.load(scene, sample.key)
            cameras = [Camera.of_scene(scene, view) for view in range(scene.num_views)]
            pictures = [loaded.render(camera).radiance_rgb for camera in cameras]
            if measured:
                price = asdict(measured.price) | {"machine": board.machine}
    except Unrenderable as error:
        board.left_out[method.resolution, sample.key] = f"{method.name}: {error}"
        return
    views = zip(keys, pictures, judged().target_VRR3, judged().hits_VRR, strict=True)
    for key, picture, target, hits in views:
        board.rows.add(key, Row(scores=picture_scores(picture, target, hits, board.lpips), **price))
        price = {}  # it is that of the first view


def _judge_noise(
    board: Board, sample: Sample, width: int, judged: Callable[[], ValidationScene]
) -> None:
    """Add the scores of the targets' own noise, with facts of the scene."""
    for view in range(sample.scene.num_views):
        key = board.noise_key(width, sample.key, view)
        if board.rows.get(key) is None:
            scene = judged()
            floors = noise_floors(
                sample, view, scene.target_VRR3[view], scene.hits_VRR[view], board.lpips
            )
            board.rows.add(key, Row(scores=floors, facts=scene_facts(sample)))


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Figures of one method at one width."""

    name: str
    """Name of the method, or NOISE."""
    kind: str
    """Kind of method; empty for NOISE."""
    first_s: float | None = None
    """Median CPU seconds of a scene's first view, loading included; None without times."""
    further_s: float | None = None
    """Median CPU seconds of a further view; None without times."""
    timed_scenes: int
    """Number of scenes behind these medians."""
    scores: Mapping[str, Any]
    """Summary of each metric by name (train.evaluation.metrics.summarize_views)."""
    lead: PairedLead | None
    """Paired difference from the rival; None for the rival and for NOISE."""
    on_front: bool | None
    """True on the Pareto front of error and costs; None without costs."""

    @property
    def median_db(self) -> float:
        """Median of METRIC over the views, by which the table is sorted."""
        return float(self.scores[METRIC]["median"])


@dataclass(frozen=True, kw_only=True)
class WidthStandings:
    """Table of one width."""

    width: int
    """Width of the pictures in pixels."""
    num_views: int
    """Number of views that all methods rendered."""
    triangles: Mapping[str, int]
    """Number of triangles of each scene by its key."""
    standings: tuple[Standing, ...]
    """Rows, NOISE first, then sorted from the best to the worst."""
    pairs: Mapping[tuple[str, str], PairedLead]
    """Paired difference of the first from the second, for every pair of names."""

    @property
    def num_scenes(self) -> int:
        """Number of scenes of these views."""
        return len(self.triangles)


def standings_of(board: Board, width: int, rival: str) -> WidthStandings | None:
    """Return the table of a width, compared with `rival`; None without a judged view."""
    views = list(board.views(width))
    if not views:
        return None
    names = [name for name in views[0].scores if name != NOISE]
    pairs = {two: paired_lead(views, *two) for two in itertools.permutations(names, 2)}
    scores = {name: summarize_views(views, name) for name in [NOISE, *names]}
    prices = board.prices(width)
    costs = {name: asdict(median_price(each)) for name, each in prices.items()}
    figures = [
        (-float(scores[name][METRIC]["median"]), tuple(cost.values()))
        for name, cost in costs.items()
    ]
    front = dict(zip(costs, on_front(figures), strict=True))
    standings = [
        Standing(
            name=name,
            kind=board.kinds.get(name, ""),
            timed_scenes=len(prices.get(name, ())),
            scores=summary,
            lead=pairs.get((name, rival)),
            on_front=front.get(name),
            **costs.get(name, {}),
        )
        for name, summary in scores.items()
    ]
    return WidthStandings(
        width=width,
        num_views=len(views),
        triangles={view.key: view.num_triangles for view in views},
        standings=tuple(sorted(standings, key=lambda one: (one.name != NOISE, -one.median_db))),
        pairs=pairs,
    )
