"""Short trainings beside each other: of equal core-seconds, or of equal steps.

Of equal core-seconds the schedule runs by the processor's clock, not by steps. So a network that is
cheaper a step takes more of them, and each is warmed up and cooled down alike.
"""

import dataclasses
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch

from model.config import ModelConfig
from model.costs import Workload, training_flops
from model.renderformer import RenderFormer
from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import open_training_data
from train.data.buckets import bucket_scenes
from train.data.stream import stream_batches
from train.data.unusable import Unusable, first_samples
from train.evaluation.judge import Judge
from train.evaluation.scores import ViewScore
from train.loop.crew import Crew
from train.loop.muon import fitting_precision
from train.loop.schedule import learning_rate
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.objective import Objective
from train.run import stream_settings
from train.runs import builtin
from train.settings import TrainSettings

_PARTS = 1000
"""Parts of a training's core-seconds, by which its schedule counts."""

_WARM_UP_PARTS = 50

_PROCESSOR = torch.device("cpu")


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """What all trainings of an experiment share: the scenes they see, and those they do not."""

    train: ShardSet
    judge: Judge
    about: str
    """What was seen and what was judged on, for the result's notes."""

    @classmethod
    def of(cls, data: str, held_out: int, resolution: int | None = None) -> "Course":
        """Return that of a dataset, judged on the first scenes of its validation split.

        Pictures are as wide as those of the run `builtin` unless a width in pixels is given.
        """
        opened = open_training_data([data])
        samples = list(first_samples(opened.split("validation"), held_out, Unusable(0)))
        resolution = resolution or builtin().resolution
        black = np.zeros((resolution, resolution, 3))
        train = opened.split("train")
        count = sum(train.num_samples(number) for number in range(len(train.names)))
        return cls(
            train=train,
            judge=Judge(samples, resolution, black),
            about=f"{count} scenes seen, {len(samples)} judged on, data {opened.digest[:8]}",
        )


@dataclass(frozen=True, kw_only=True)
class Trained:
    """How a training ended."""

    steps: int
    core_s: float
    """Of the whole process: reading, tracing, and both passes through the network; with a card, of
    its host alone."""
    view_core_s: float
    """Of a held-out view, its share of the scene's own stage included."""
    views: tuple[ViewScore, ...]
    """Held out."""


def train_for(course: Course, model: ModelConfig, *, seed: int, core_s: float) -> Trained:
    """Train a network on one thread until so many core-seconds are spent, and judge it.

    Args:
        course: the scenes.
        model: the network.
        seed: of its weights, of the order of the scenes and of their symmetries.
        core_s: when the last step begins, at the latest.
    """
    torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
    settings = _settings(model, seed)

    def rate(step: int, spent: float) -> float | None:
        part = int(_PARTS * spent / core_s)
        return learning_rate(part, settings) if part < _PARTS else None

    return _judged(course, *_trained(course.train, settings, rate))


def train_steps(
    course: Course, settings: TrainSettings, device: torch.device = _PROCESSOR
) -> Trained:
    """Train a network on one thread, or a card, for as many steps as its run has, and judge it."""
    torch.set_num_threads(1)

    def rate(step: int, spent: float) -> float | None:
        return learning_rate(step, settings) if step < settings.num_steps else None

    return _judged(course, *_trained(course.train, settings, rate, device))


def _judged(course: Course, network: RenderFormer, steps: int, spent: float) -> Trained:
    began = time.process_time()
    found = course.judge.judge(network.eval())
    each = (time.process_time() - began) / len(found.views)
    return Trained(steps=steps, core_s=spent, view_core_s=each, views=found.views)


def _settings(model: ModelConfig, seed: int) -> TrainSettings:
    """Return the shipped network's run with half its views; its steps are parts of the cost."""
    return dataclasses.replace(
        builtin(),
        run="short",
        model=model,
        seed=seed,
        num_steps=_PARTS,
        warmup_steps=_WARM_UP_PARTS,
        ema_decay=0.0,
        views_per_scene=2,
    )


def _trained(
    shards: ShardSet,
    settings: TrainSettings,
    rate: Callable[[int, float], float | None],
    device: torch.device = _PROCESSOR,
) -> tuple[RenderFormer, int, float]:
    """Return network, steps and core-seconds; `rate` says None after the last step."""
    crew = Crew(device=device)
    state = new_state(settings, device, muon_precision=fitting_precision(crew))
    stepper = Stepper(state, settings, Objective(settings.loss, None), crew)

    def flops(triangles: int) -> int:
        if device.type != "cpu":
            return 1  # one pass a step: of so small ones a card feels the number of kernels alone
        views, resolution = settings.views_per_scene, settings.resolution
        workload = Workload(triangles=triangles, views=views, resolution=resolution)
        return training_flops(settings.model, workload)

    spent, began = 0.0, time.process_time()
    batches = stream_batches(
        shards,
        stream_settings(settings),
        0,
        share=crew.share,
        workers=1,
        unusable=state.unusable,
    )
    with closing(batches):
        while (now := rate(state.step, spent)) is not None:
            buckets = bucket_scenes(next(batches), flops, settings.scenes_per_pass)
            stepper.take(buckets, now)  # nobody reads what it did, so a card is not waited for
            state.step += 1
            spent = time.process_time() - began
    return state.model, state.step, spent
