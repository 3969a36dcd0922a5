"""Experiment `paired-training`: two trainings with different settings and equal seeds."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from infra.bench.context import BenchContext
from infra.bench.experiment import (
    BenchScale,
    Column,
    Experiment,
    Figures,
    Point,
    device_of,
)
from infra.bench_options import BenchOptions
from storage.errors import Rejected, TrilightError

if TYPE_CHECKING:
    from train.settings import TrainSettings

SIDE_A = "a"
SIDE_B = "b"
PRESET = "smoke"


def settings_of(side: str, seed: int, scale: BenchScale, options: BenchOptions) -> "TrainSettings":
    """Return the settings of one side's training.

    Raises:
        TrilightError: several presets are named, or a change names no setting.
    """
    from train.presets import override_training_preset

    if len(options.run) > 1:
        raise TrilightError(
            f"bench paired-training: --run names {len(options.run)} presets; expected one. Say "
            "what differs by --set-a and --set-b."
        )
    side_changes = options.set_a if side == SIDE_A else options.set_b
    changes = {"seed": seed, **options.changes, **side_changes}
    steps = changes.pop("num_steps", scale.steps)  # warm-up and decay are in proportion
    return override_training_preset((options.run or (PRESET,))[0], changes, steps=steps)


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    return [
        Point(name=SIDE_A, measure=partial(_measure, SIDE_A), kind=SIDE_A, default=True),
        Point(name=SIDE_B, measure=partial(_measure, SIDE_B), kind=SIDE_B, rival=SIDE_A),
    ]


def _trials(scale: BenchScale, options: BenchOptions) -> list[str]:
    return [
        f"seed {seed}, scene {scene}"
        for seed in range(options.seeds)
        for scene in range(scale.held_out)
    ]


def scene_of(trial: str) -> str:
    """Return the scene of a trial, since its errors with all seeds form one cluster."""
    return trial.partition(", ")[2]


def _measure(side: str, context: BenchContext, trial: str) -> Figures:
    seed, scene = (int(part.split()[1]) for part in trial.split(", "))
    scenes = context.get_or_make((side, seed), lambda: _train(context, side, seed))
    if scene >= len(scenes):
        raise Rejected("no_scene", f"the validation split has {len(scenes)} scenes")
    return scenes[scene]


def _train(context: BenchContext, side: str, seed: int) -> Sequence[Figures]:
    """Train one side, and return the figures of each judged scene."""
    import torch

    from infra.bench.workloads.trainings import scenes_of, training_figures
    from train.loop.distributed import choose_device

    options = context.options
    settings = settings_of(side, seed, context.scale, options)
    px = settings.resolution
    train, judge, note = context.get_or_make(
        ("scenes", px), lambda: scenes_of(options.data or "", context.scale.held_out, px)
    )
    context.note(note)
    side_changes = options.set_a if side == SIDE_A else options.set_b
    changed = ", ".join(f"{name}={value}" for name, value in side_changes.items()) or "as it is"
    context.note(f"{side}: {settings.run}, {settings.num_steps} steps, {changed}")
    if device_of(options) == "cpu":
        torch.set_num_threads(context.cores)
    return training_figures(train, judge, settings, choose_device(device_of(options)))


EXPERIMENT = Experiment(
    name="paired-training",
    title="Two trainings, side by side",
    cost=Column("seconds of a training", "seconds", over="mean"),
    error=Column("held-out log L1, thousandths", "log_l1", over="mean", then=lambda l1: 1000 * l1),
    columns=(
        Column("a step, s", "step_s", over="mean"),
        Column("psnr_log_db, dB", "db", over="mean"),
        Column("more error than a, %", "percent", over="pair"),
        Column("more than a, dB", "db", over="pair"),
    ),
    because="Differences are of pairs of one seed and scene, with the 95 % interval of their mean, "
    "bootstrapped over scenes: it says nothing of other seeds where there are few.",
    points=_points,
    trials=_trials,
    cluster=scene_of,
    needs=("torch", "data"),
)
