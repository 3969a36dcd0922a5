"""Trainings on scenes that a closed loop chose, beside trainings on scenes drawn as they come.

The scenes of all are made once (`--data`), and a training is given those of them that `trilight
improve` would have made next: drawn without replacement from the strata it weighs, for the same
core-seconds of making. What a scene costs is the median of its stratum. No symmetry is drawn, so
that hits are traced once a scene; each training is charged for those of its own.
"""

import copy
import itertools
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from infra.improve.held_out import HeldOutScene, by_stratum, held_out, losses
from infra.improve.weights import Lesson, next_weights
from scene_templates.strata import Stratum, stratum_of
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import read_scene_logs
from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import open_training_data
from storage.seeds import rng_for
from train.data.buckets import bucket_scenes
from train.data.unusable import Unusable, first_samples
from train.loop.crew import Crew
from train.loop.muon import fitting_precision
from train.loop.schedule import learning_rate
from train.loop.state import TrainState, new_state
from train.loop.step import Stepper
from train.loop.trainer import scene_flops
from train.loss.objective import Objective
from train.settings import TrainSettings


class Pool:
    """The scenes of a dataset with strata, with what is traced of them, in memory."""

    def __init__(self, data: str, settings: TrainSettings) -> None:
        opened = open_training_data([data])
        self.digest = opened.digest
        began = time.process_time()
        splits = {name: _scenes(opened.split(name), settings) for name in opened.splits}
        self.tracing_core_s = (time.process_time() - began) / sum(map(len, splits.values()))
        self.train, self.validation, self.test = (
            splits.get(name, []) for name in ("train", "validation", "test")
        )
        rows = read_scene_logs(DatasetFolder(Path(data)))
        logged = {row.scene_index: row.seconds * row.cores for row in rows}
        costs: dict[str, list[float]] = {}
        for scene in self.train:
            costs.setdefault(scene.stratum, []).append(logged[int(scene.key)])
        self.core_s = {name: statistics.median(values) for name, values in sorted(costs.items())}
        self.base = {name: 1.0 / len(self.core_s) for name in self.core_s}

    def drawn(
        self,
        weights: Mapping[str, float],
        core_s: float,
        taken: Sequence[HeldOutScene],
        rng: np.random.Generator,
    ) -> list[HeldOutScene]:
        """Return scenes for so many core-seconds, as a dataset with these weights holds them."""
        price = sum(weights[name] * self.core_s[name] for name in weights) / sum(weights.values())
        strata = [Stratum(name=name, weight=weight) for name, weight in weights.items()]
        used, left = {scene.key for scene in taken}, dict[str, list[HeldOutScene]]()
        for row in rng.permutation(len(self.train)):
            scene = self.train[row]
            if scene.key not in used:
                left.setdefault(scene.stratum, []).append(scene)
        found, index = list[HeldOutScene](), 0
        while len(found) < round(core_s / price) and any(left.values()):
            name = stratum_of(strata, index).name
            index += 1
            if left.get(name):  # where a stratum is used up, the others take its turns
                found.append(left[name].pop())
        return found

    def lessons(self, before: Mapping[str, float], now: Mapping[str, float]) -> dict[str, Lesson]:
        """Return what a round taught, from the losses of the held-out strata."""
        return {
            name: Lesson(loss_before=before[name], loss=now[name], core_s=self.core_s[name])
            for name in now
        }


def _scenes(shards: ShardSet, settings: TrainSettings) -> list[HeldOutScene]:
    samples = first_samples(shards, 10**6, Unusable(0))
    return held_out(samples, settings.model, settings.resolution)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How much a training makes and takes."""

    settings: TrainSettings
    """The run; its steps are divided evenly among the rounds."""
    rounds: int
    """Rounds, the first included, which all trainings of a seed share."""
    first_scenes: int
    """Scenes of the first round, drawn alike from all strata."""
    core_s: float
    """Core-seconds of making in each further round."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """How a training ended."""

    losses: Mapping[str, float]
    """By test scene."""
    making_core_s: float
    """Of all its scenes."""
    training_core_s: float
    """Of all its steps."""
    num_scenes: int
    """Scenes that it was given."""
    weights: Sequence[Mapping[str, float]]
    """Of each further round."""


@dataclass(kw_only=True, eq=False)
class _Course:
    """A training between two rounds."""

    state: TrainState
    scenes: list[HeldOutScene]
    core_s: float = 0.0


def compared(pool: Pool, plan: Plan, floors: Mapping[str, float], seed: int) -> dict[str, Chosen]:
    """Return by name how trainings end that share all but their floor (infra.improve.weights).

    Args:
        pool: the scenes.
        plan: how much is made and trained.
        floors: by name; 1 draws alike throughout.
        seed: of weights, order, symmetries and the choice of scenes.
    """
    torch.set_num_threads(1)
    settings = replace(plan.settings, seed=seed)
    price = sum(pool.base[name] * pool.core_s[name] for name in pool.base)
    rng = rng_for(seed, "improve-first")
    first = pool.drawn(pool.base, plan.first_scenes * price, (), rng)
    crew = Crew(device=torch.device("cpu"))
    course = _Course(
        state=new_state(settings, muon_precision=fitting_precision(crew)), scenes=first
    )
    untrained = by_stratum(pool.validation, losses(course.state.shown.eval(), pool.validation))
    _train_round(course, settings, plan, 0, crew)
    first_round = by_stratum(pool.validation, losses(course.state.shown.eval(), pool.validation))
    lessons = pool.lessons(untrained, first_round)
    return {
        name: _rounds(pool, _branched(course), settings, plan, floor, lessons, crew)
        for name, floor in floors.items()
    }


def _branched(course: _Course) -> _Course:
    """Return a copy that trains on its own; the tally of damage, which allows none, is shared."""
    unusable = course.state.unusable
    state = copy.deepcopy(course.state, {id(unusable): unusable})
    return replace(course, state=state, scenes=list(course.scenes))


def _rounds(
    pool: Pool,
    course: _Course,
    settings: TrainSettings,
    plan: Plan,
    floor: float,
    lessons: Mapping[str, Lesson],
    crew: Crew,
) -> Chosen:
    history = []
    for number in range(1, plan.rounds):
        weights = next_weights(pool.base, lessons, floor)
        history.append(weights)
        rng = rng_for(settings.seed, "improve-round", number)
        course.scenes += pool.drawn(weights, plan.core_s, course.scenes, rng)
        _train_round(course, settings, plan, number, crew)
        if number + 1 < plan.rounds and floor < 1:
            now = by_stratum(pool.validation, losses(course.state.shown.eval(), pool.validation))
            before = {name: lesson.loss for name, lesson in lessons.items()}
            lessons = pool.lessons(before, now)
    return Chosen(
        losses=losses(course.state.shown.eval(), pool.test),
        making_core_s=sum(pool.core_s[scene.stratum] for scene in course.scenes),
        training_core_s=course.core_s + pool.tracing_core_s * len(course.scenes),
        num_scenes=len(course.scenes),
        weights=history,
    )


def _train_round(
    course: _Course, settings: TrainSettings, plan: Plan, number: int, crew: Crew
) -> None:
    """Train one round's share of the steps on the scenes that there are."""
    state, steps = course.state, settings.num_steps // plan.rounds
    stepper = Stepper(state, settings, Objective(settings.loss, None), crew)
    cost, rng = partial(scene_flops, settings), rng_for(settings.seed, "improve-order", number)
    state.model.train()
    began = time.process_time()
    order = itertools.chain.from_iterable(
        rng.permutation(len(course.scenes)) for _ in itertools.count()
    )
    for _ in range(steps):
        rows = itertools.islice(order, settings.scenes_per_step)
        batch = [course.scenes[row].judged.scene for row in rows]
        buckets = bucket_scenes(batch, cost, settings.scenes_per_pass)
        stepper.step(buckets, learning_rate(state.step, settings))
        state.step += 1
    course.core_s += time.process_time() - began
