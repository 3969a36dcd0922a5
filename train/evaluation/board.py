"""Judges every method on every view of a split, and adds the missing rows.

The evaluation is that of one network (`train.evaluation.evaluate`): targets, masks, metrics and
noise floors are equal.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.dataset.shard_set import ShardSet
from storage.digests import canonical_json, sha256_hex
from storage.errors import Unrenderable
from storage.records.sample import Sample
from storage.renderer import Camera, Renderer
from train.data.bad_samples import BadSampleCounter, first_samples
from train.evaluation.judge import ValidationScene, validation_scene
from train.evaluation.judged_view import JudgedView, scene_facts
from train.evaluation.metrics import METRICS, noise_floors, picture_scores
from train.evaluation.rows import Row, RowKey, Rows
from train.evaluation.stored_pictures import StoredPictures, method_digest
from train.evaluation.timing import Price, time_scene
from train.loss.lpips import Lpips

NOISE = "noise of the references"
"""Name of the row of the targets' own noise, which bounds what any method can score."""

Method = Renderer | StoredPictures

OnProgress = Callable[[int, int, str], None]
"""Callback with (finished, all) pairs of scene and width, and the current step as text."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Scenes, widths and methods of a leaderboard."""

    shards: ShardSet
    """Dataset shards of the evaluated split."""
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
    methods: Sequence[Method]
    """Methods, each of one width, in the order of evaluation."""
    lpips: Lpips | None
    """LPIPS metric; None without its weights."""
    rows: Rows
    """Stored rows, to which new ones are added."""
    left_out: dict[tuple[int, str], str] = field(default_factory=dict)
    """Reason by (width, key) of scenes that a method cannot render."""

    @functools.cached_property
    def judged_by(self) -> str:
        """Digest of the metrics' definitions."""
        meanings = {metric: METRICS[metric].meaning for metric in METRICS}
        return sha256_hex(canonical_json([meanings, self.lpips is not None]))

    def row_key(self, width: int, name: str, made_by: str, key: str, view: int) -> RowKey:
        """Return the key of a row; `made_by` is the digest of the method of the picture."""
        digest = sha256_hex(f"{made_by} {self.judged_by}".encode())
        return RowKey(width=width, scene=key, view=view, name=name, digest=digest)

    @functools.cached_property
    def _renderer_digests(self) -> dict[int, str]:
        """Digest of each renderer by its `id`."""
        return {
            id(method): method_digest(method.identity)
            for method in self.methods
            if not isinstance(method, StoredPictures)
        }

    def key_of(self, method: Method, key: str, view: int) -> RowKey:
        """Return the key of a method's row."""
        if isinstance(method, StoredPictures):
            made_by = method.digest(key, view)
        else:
            made_by = self._renderer_digests[id(method)]
        return self.row_key(method.resolution, method.name, made_by, key, view)

    def present(self, width: int) -> list[Method]:
        """Return the methods of a width."""
        return [method for method in self.methods if method.resolution == width]


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
    done = 0
    on_progress(done, total, "")
    samples = first_samples(board.shards, len(board.keys), BadSampleCounter(0))
    for number, sample in enumerate(samples):
        for width in board.widths:
            scene_run = _SceneAtWidth(board, sample, width, timed=number < board.timed_scenes)
            for method in scene_run.missing():
                on_progress(done, total, f"{width} px, {method.name}")
                scene_run.judge(method)
            scene_run.judge_noise()
            done += 1
            on_progress(done, total, "")


class _SceneAtWidth:
    """Evaluation of one scene at one width."""

    def __init__(self, board: Board, sample: Sample, width: int, *, timed: bool) -> None:
        self._board = board
        self._sample = sample
        self._width = width
        self._timed = timed

    @functools.cached_property
    def _judged(self) -> ValidationScene:
        return validation_scene(self._sample, self._width)

    def missing(self) -> list[Method]:
        """Return the methods that lack rows or times of the scene."""
        return [one for one in self._board.present(self._width) if not self._has_all(one)]

    def _has_all(self, method: Method) -> bool:
        rows = self._board.rows
        keys = [self._board.key_of(method, self._sample.key, view) for view in self._views()]
        is_priced = not self._is_timed(method) or rows.price(keys[0], self._board.machine)
        return bool(is_priced) and all(rows.get(key) is not None for key in keys)

    def _is_timed(self, method: Method) -> bool:
        return self._timed and not isinstance(method, StoredPictures)

    def _views(self) -> Sequence[int]:
        return range(self._sample.scene.num_views)

    def judge(self, method: Method) -> None:
        """Add a method's rows, or record why the scene is left out."""
        try:
            pictures, price = _show(method, self._sample, timed=self._is_timed(method))
        except Unrenderable as error:
            reason = f"{method.name}: {error}"
            self._board.left_out[self._width, self._sample.key] = reason
            return
        judged = self._judged
        for view, picture in enumerate(pictures):
            scores = picture_scores(
                picture, judged.target_VRR3[view], judged.hits_VRR[view], self._board.lpips
            )
            row = Row(scores=scores)
            if price is not None and view == 0:
                row = Row(scores=scores, **dataclasses.asdict(price), machine=self._board.machine)
            self._board.rows.add(self._board.key_of(method, self._sample.key, view), row)

    def judge_noise(self) -> None:
        """Add the scores of the targets' own noise, with facts of the scene."""
        board, sample = self._board, self._sample
        for view in self._views():
            key = board.row_key(self._width, NOISE, "", sample.key, view)
            if board.rows.get(key) is None:
                judged = self._judged
                floors = noise_floors(
                    sample, view, judged.target_VRR3[view], judged.hits_VRR[view], board.lpips
                )
                board.rows.add(key, Row(scores=floors, facts=scene_facts(sample)))


def _show(
    method: Method, sample: Sample, *, timed: bool
) -> tuple[Sequence[NDArray[np.floating]], Price | None]:
    """Return the pictures [R, R, 3] of all views, and the price if it is measured."""
    if isinstance(method, StoredPictures):
        return list(method.pictures(sample)), None
    scene, price = sample.scene, None
    if timed:
        loaded, price = time_scene(method, scene, sample.key)
    else:
        loaded = method.load(scene, sample.key)
    cameras = [Camera.of_scene(scene, view) for view in range(scene.num_views)]
    return [loaded.render(camera).radiance_rgb for camera in cameras], price


@dataclass(frozen=True, kw_only=True)
class JudgedWidth:
    """Scores and times of all methods at one width."""

    width: int
    """Width of the pictures in pixels."""
    views: tuple[JudgedView, ...]
    """Views that every method of the width has, with NOISE as a further method."""
    prices: dict[str, list[Price]]
    """Prices by method, one for each timed scene."""


def judged_width(board: Board, width: int) -> JudgedWidth:
    """Return the rows of a width, grouped by view."""
    judged = JudgedWidth(width=width, views=tuple(_views(board, width)), prices={})
    scene_keys = {view.key for view in judged.views}
    for method in board.present(width):
        for key in board.keys[: board.timed_scenes]:
            price = board.rows.price(board.key_of(method, key, 0), board.machine)
            if key in scene_keys and price is not None:
                judged.prices.setdefault(method.name, []).append(price)
    return judged


def _views(board: Board, width: int) -> Iterator[JudgedView]:
    present = board.present(width)
    for key in board.keys:
        for view in range(board.num_views):
            noise = board.rows.get(board.row_key(width, NOISE, "", key, view))
            rows = {one.name: board.rows.get(board.key_of(one, key, view)) for one in present}
            if noise is None or noise.facts is None or None in rows.values():
                continue
            floors = {name: value for name, value in noise.scores.items() if value is not None}
            scores = {name: dict(row.scores) for name, row in rows.items() if row is not None}
            scores[NOISE] = {metric: noise.scores.get(metric) for metric in METRICS}
            yield JudgedView(view=view, floors=floors, scores=scores, **_facts(noise.facts))


def _facts(facts: Any) -> dict[str, Any]:
    """Return facts of a view from JSON, with the pair that JSON turned into a list."""
    excursion = facts["excursion"]
    known = {one.name for one in dataclasses.fields(JudgedView)}
    values = {**facts, "excursion": None if excursion is None else tuple(excursion)}
    return {name: value for name, value in values.items() if name in known}
