"""What the published view stage lacks, added one thing at a time: trainings of equal cost."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.workshop import Workshop

if TYPE_CHECKING:
    from train.evaluation.scores import ViewScore

CORE_S, QUICK_CORE_S = 60.0, 20.0
"""Of each training."""

PAIRS = 6
"""Seeds: with each, every network is trained once."""

HELD_OUT = 32
"""Scenes that every network is judged on."""

FINE = {"patch_px": 4}
DEMODULATED = {"demodulated": True, "hit_rays": 2}
POINTS: Mapping[str, Mapping[str, Any]] = {
    "smoke: 2 + 4 layers": {},
    "4 + 2 layers, as published": {"encoder_layers": 4, "decoder_layers": 2},
    "4-pixel bundles": FINE,
    "demodulated": DEMODULATED,
    "both": {**FINE, **DEMODULATED},
}
BASE = next(iter(POINTS))


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Train every network from one seed; figures beside the first one's are of the same views."""
    import dataclasses

    from infra.bench.sides.short_trainings import Course, train_for
    from model.config import smoke

    course = workshop.kept("course", lambda: Course.of(workshop.asked.data or "", HELD_OUT))
    seed, base = int(turn.split()[-1]), None
    core_s = QUICK_CORE_S if workshop.effort.name == "quick" else CORE_S
    workshop.note(course.about)
    for point in points:
        model = dataclasses.replace(smoke(), **point.settings)
        trained = train_for(course, model, seed=seed, core_s=core_s)
        figures = {
            "core_s": trained.core_s,
            "steps": float(trained.steps),
            "view_s": trained.view_core_s,
            **_scores(trained.views),
        }
        base = figures if base is None else base
        figures["gain_db"] = figures["mean_db"] - base["mean_db"]
        figures["object_gain_db"] = figures["object_db"] - base["object_db"]
        figures["l1_change"] = 100 * (figures["log_l1"] / base["log_l1"] - 1)
        yield point.name, figures


def _scores(views: "Sequence[ViewScore]") -> dict[str, float]:
    found = [view.psnr_log_db for view in views]
    return {
        "log_l1": float(np.mean([view.log_l1 for view in views])),
        "db": float(np.median(found)),
        "mean_db": float(np.mean(found)),
        "p5_db": float(np.percentile(found, 5)),
        "object_db": float(np.mean([view.object_psnr_log_db for view in views])),
    }


def _turns(effort: Effort) -> list[str]:
    return [f"seed {seed}" for seed in range(PAIRS)]


def _points(effort: Effort) -> list[Point]:
    return [
        Point(name=name, settings=settings, default=name == BASE)
        for name, settings in POINTS.items()
    ]


EXPERIMENTS = (
    Experiment(
        name="repairs",
        title="What the view stage of `tokens` lacks",
        about=f"The size `smoke` with one thing changed, each trained for {CORE_S:g} core-seconds "
        f"(with --quick {QUICK_CORE_S:g}) on one thread; every turn is a seed of weights, order "
        "and symmetries.",
        covers=(
            "train.model.patch_px",
            "train.model.demodulated",
            "train.model.hit_rays",
        ),
        cost=Column(name="core-seconds of a view", figure="view_s"),
        error=Column(name="held-out log L1", figure="log_l1", over="mean"),
        against=f"{HELD_OUT} scenes of the validation split of `--data`, all their views",
        columns=(
            Column(name="log L1 to smoke, %", figure="l1_change", over="mean"),
            Column(name="%, low", figure="l1_change", over="low"),
            Column(name="%, high", figure="l1_change", over="high"),
            Column(name="psnr_log_db, median", figure="db", over="mean"),
            Column(name="5th percentile, dB", figure="p5_db", over="mean"),
            Column(name="to smoke, dB", figure="gain_db", over="mean"),
            Column(name="dB, low", figure="gain_db", over="low"),
            Column(name="dB, high", figure="gain_db", over="high"),
            Column(name="object, to smoke, dB", figure="object_gain_db", over="mean"),
            Column(name="object dB, low", figure="object_gain_db", over="low"),
            Column(name="object dB, high", figure="object_gain_db", over="high"),
            Column(name="steps", figure="steps"),
            Column(name="core-seconds of training", figure="core_s"),
        ),
        because="Default: none of them, so that published networks are what they were. Intervals "
        "are of the mean over the seeds.",
        points=_points,
        turns=_turns,
        measure=_measure,
        needs=("torch", "data"),
    ),
)
