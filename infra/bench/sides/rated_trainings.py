"""The trainings by which learning rates are chosen: one small network, one thing changed at a time.

The networks are those of the view stage `bundles`, two layers each stage, of any width; all else is
as in our runs: symmetries, the decoupled decay, a warm-up of a tenth, and a decay of a fifth.
"""

import dataclasses
from typing import Literal

import numpy as np

from infra.bench.sides.short_trainings import Course, Trained, train_steps
from model.base_widths import BaseWidths
from model.config import ModelConfig, smoke
from train.loop.crew import choose_device
from train.runs import named_run
from train.settings import Precision, Schedule, TrainSettings

Optimiser = Literal["AdamW", "Muon"]

BASE_WIDTH = 64
"""Width at which rates are stated where they follow the width; also the width of every head."""

RESOLUTION = 32
"""Pixels across the pictures."""

MUON_RATE = 3.0
"""Muon's rate beside that of the vectors, as in all our runs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rated:
    """One training."""

    optimiser: Optimiser
    """Of the matrices; vectors are AdamW's."""
    learning_rate: float
    """Peak rate; Muon's own is MUON_RATE times that."""
    by_width: bool = False
    """Whether rates and initial weights follow the width from BASE_WIDTH on."""
    schedule: Schedule = "wsd"
    """Course of the rate."""
    steps_share: float = 1.0
    """Steps, as a share of all."""


def network_of(width: int) -> ModelConfig:
    """Return the network of a width, a multiple of BASE_WIDTH."""
    return dataclasses.replace(
        smoke(),
        width=width,
        num_heads=width // BASE_WIDTH,
        hidden_width=3 * width,
        encoder_layers=2,
        decoder_layers=2,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Amount:
    """How much each training does, alike in all."""

    steps: int
    """Of a training that takes all."""
    scenes_per_step: int
    """Two views each."""
    precision: Precision
    """Of the network's products."""


def run_of(rated: Rated, amount: Amount, *, width: int, seed: int) -> TrainSettings:
    """Return the whole description of a training."""
    num_steps = max(2, round(rated.steps_share * amount.steps))
    return dataclasses.replace(
        named_run("smoke"),
        run="rated",
        model=network_of(width),
        resolution=RESOLUTION,
        seed=seed,
        num_steps=num_steps,
        warmup_steps=num_steps // 10,
        scenes_per_step=amount.scenes_per_step,
        precision=amount.precision,
        compile="no",  # it would take longer than it saves
        views_per_scene=2,
        learning_rate=rated.learning_rate,
        muon_rate=MUON_RATE if rated.optimiser == "Muon" else 0.0,
        base_widths=BaseWidths(width=BASE_WIDTH) if rated.by_width else BaseWidths(),
        schedule=rated.schedule,
    )


def course_of(data: str, held_out: int) -> Course:
    """Return the scenes of all trainings."""
    return Course.of(data, held_out, RESOLUTION)


def figures_of(trained: Trained) -> dict[str, float]:
    """Return what a table shows of a training; no error where its weights were lost."""
    figures = {"core_s": trained.core_s, "step_s": trained.core_s / trained.steps}
    l1 = float(np.mean([view.log_l1 for view in trained.views]))
    if np.isfinite(l1):
        figures |= {"log_l1": l1, "percent": 100 * float(np.log(l1))}
    return figures


def rated(
    course: Course, one: Rated, amount: Amount, *, width: int, seed: int, device: str
) -> dict[str, float]:
    """Train once on `cpu` or `cuda`, and judge."""
    settings = run_of(one, amount, width=width, seed=seed)
    return figures_of(train_steps(course, settings, choose_device(device)))
