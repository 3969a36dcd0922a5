"""Evaluates every contestant on every view, and adds the missing rows.

The evaluation is that of `trilight evaluate`: targets, masks, metrics and noise floors are equal.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

from infra.leaderboard.contestants import Contestant
from infra.leaderboard.rows import BoardRow, BoardRows, RowKey
from pipeline.isolation import ChildFailed
from storage.dataset.shard_set import ShardSet
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.records.sample import Sample
from storage.seeds import rng_for
from train.data.bad_samples import BadSampleCounter, first_samples
from train.evaluation.judge import ValidationScene, validation_scene
from train.evaluation.judged_view import JudgedView, scene_facts
from train.evaluation.metrics import METRICS, noise_floors, picture_scores
from train.loss.lpips import Lpips

NOISE = "noise of the references"
"""Name of the row of the targets' own noise, which bounds what any method can score."""

OnProgress = Callable[[int, int, str], None]
"""Callback with (finished, all) pairs of scene and width, and the current step as text."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardContest:
    """Scenes, widths and contestants of a leaderboard."""

    shards: ShardSet
    """Dataset shards of the evaluated split."""
    keys: Sequence[str]
    """Keys of the evaluated scenes, the first ones of the split."""
    num_views: int
    """Number of cameras of each scene."""
    timed_scenes: int
    """Number of scenes, from the start of `keys`, on which contestants are timed."""
    machine: str
    """Name of this processor; times of different processors are not comparable."""
    widths: Sequence[int]
    """Widths of pictures in pixels, ascending."""
    contestants: Sequence[Contestant]
    """Contestants in the order of evaluation."""
    lpips: Lpips | None
    """LPIPS metric; None without its weights."""
    rows: BoardRows
    """Stored rows, to which new ones are added."""
    left_out: dict[tuple[int, str], str] = field(default_factory=dict)
    """Reason by (width, key) of scenes that a contestant cannot render."""
    notes: Sequence[str] = ()
    """Notes for the reader, in addition to those of contestants."""

    @functools.cached_property
    def judged_by(self) -> str:
        """Digest of the metrics' definitions."""
        meanings = {metric: METRICS[metric].meaning for metric in METRICS}
        return sha256_hex(canonical_json([meanings, self.lpips is not None]))

    def row_key(self, width: int, name: str, made_by: str, key: str, view: int) -> RowKey:
        """Return the key of a row; `made_by` is the digest of the method of the picture."""
        digest = sha256_hex(f"{made_by} {self.judged_by}".encode())
        return RowKey(width=width, scene=key, view=view, name=name, digest=digest)

    def key_of(self, contestant: Contestant, width: int, key: str, view: int) -> RowKey:
        """Return the key of a contestant's row."""
        return self.row_key(width, contestant.name, contestant.digest(key, view), key, view)

    def present(self, width: int) -> list[Contestant]:
        """Return the contestants that have pictures of a width."""
        return [one for one in self.contestants if not one.why_not(width)]


def first_keys(shards: ShardSet, limit: int) -> list[str]:
    """Return the keys of the first scenes of a split; no picture is read."""
    keys: list[str] = []
    for number in range(len(shards.names)):
        if len(keys) < limit:
            with closing(shards.open(number)) as shard:
                keys += shard.keys
    return keys[:limit]


def judge_all(contest: BoardContest, on_progress: OnProgress) -> None:
    """Add every missing row.

    Raises:
        TrilightError: damaged data, or a network that cannot render a scene.
    """
    total = len(contest.keys) * len(contest.widths)
    done = 0
    on_progress(done, total, "")
    samples = first_samples(contest.shards, len(contest.keys), BadSampleCounter(0))
    for number, sample in enumerate(samples):
        for width in contest.widths:
            scene_run = _SceneAtWidth(contest, sample, width, timed=number < contest.timed_scenes)
            for contestant in scene_run.missing():
                on_progress(done, total, f"{width} px, {contestant.name}")
                scene_run.judge(contestant)
            scene_run.judge_noise()
            done += 1
            on_progress(done, total, "")


class _SceneAtWidth:
    """Evaluation of one scene at one width."""

    def __init__(self, contest: BoardContest, sample: Sample, width: int, *, timed: bool) -> None:
        self._contest = contest
        self._sample = sample
        self._width = width
        self._timed = timed
        self._scene: ValidationScene | None = None

    def missing(self) -> list[Contestant]:
        """Return the contestants that lack rows or times of the scene."""
        return [one for one in self._contest.present(self._width) if not self._has_all(one)]

    def _has_all(self, contestant: Contestant) -> bool:
        rows = self._contest.rows
        machine = self._contest.machine
        keys = [self._key(contestant, view) for view in self._views()]
        is_priced = not (self._timed and contestant.is_timed) or rows.price(keys[0], machine)
        return bool(is_priced) and all(rows.get(key) is not None for key in keys)

    def _key(self, contestant: Contestant, view: int) -> RowKey:
        return self._contest.key_of(contestant, self._width, self._sample.key, view)

    def _views(self) -> Sequence[int]:
        return range(self._sample.scene.num_views)

    def judge(self, contestant: Contestant) -> None:
        """Add a contestant's rows, or record why the scene is left out."""
        timed = self._timed and contestant.is_timed
        try:
            pictures = contestant.shown(self._sample, self._width, timed=timed)
        except (Rejected, ChildFailed) as error:
            self._contest.left_out[self._width, self._sample.key] = f"{contestant.name}: {error}"
            return
        scene = self._judged_scene()
        for view, picture in enumerate(pictures.radiance_VRR3):
            scores = picture_scores(
                picture, scene.target_VRR3[view], scene.hits_VRR[view], self._contest.lpips
            )
            row = BoardRow(
                scores=scores,
                first_s=pictures.first_s if view == 0 else None,
                further_s=pictures.further_s if view == 0 else None,
                machine=self._contest.machine if timed and view == 0 else None,
            )
            self._contest.rows.add(self._key(contestant, view), row)

    def judge_noise(self) -> None:
        """Add the scores of the targets' own noise, with facts of the scene."""
        sample = self._sample
        facts = scene_facts(self._sample)
        for view in self._views():
            key = self._contest.row_key(self._width, NOISE, "", sample.key, view)
            if self._contest.rows.get(key) is None:
                scene = self._judged_scene()
                floors = noise_floors(
                    sample.views[view],
                    scene.target_VRR3[view],
                    scene.hits_VRR[view],
                    self._contest.lpips,
                    rng_for(0, f"noise of {sample.key}", view),
                )
                self._contest.rows.add(key, BoardRow(scores=floors, facts=facts))

    def _judged_scene(self) -> ValidationScene:
        if self._scene is None:
            self._scene = validation_scene(self._sample, self._width)
        return self._scene


@dataclass(frozen=True, kw_only=True)
class JudgedWidth:
    """Scores and times of all contestants at one width."""

    width: int
    """Width of the pictures in pixels."""
    views: tuple[JudgedView, ...]
    """Views that every contestant of the width has, with NOISE as a further contestant."""
    first_s: dict[str, list[float]]
    """CPU seconds of first views by contestant, one for each timed scene."""
    further_s: dict[str, list[float]]
    """CPU seconds of further views by contestant, one for each timed scene."""


def judged_width(contest: BoardContest, width: int) -> JudgedWidth:
    """Return the rows of a width, grouped by view."""
    judged = JudgedWidth(width=width, views=tuple(_views(contest, width)), first_s={}, further_s={})
    scene_keys = {view.key for view in judged.views}
    timed = [key for key in contest.keys[: contest.timed_scenes] if key in scene_keys]
    for one in contest.present(width):
        for key in timed:
            price = contest.rows.price(contest.key_of(one, width, key, 0), contest.machine)
            if price is not None:
                judged.first_s.setdefault(one.name, []).append(price[0])
                judged.further_s.setdefault(one.name, []).append(price[1])
    return judged


def _views(contest: BoardContest, width: int) -> Iterator[JudgedView]:
    present = contest.present(width)
    for key in contest.keys:
        for view in range(contest.num_views):
            noise = contest.rows.get(contest.row_key(width, NOISE, "", key, view))
            rows = {
                one.name: contest.rows.get(contest.key_of(one, width, key, view)) for one in present
            }
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
