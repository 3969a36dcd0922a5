"""The closed loop against scenes drawn as the build draws them, at equal core-seconds."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.workshop import Workshop
from infra.improve.axes import halves_of
from storage.errors import Rejected

if TYPE_CHECKING:
    from infra.bench.sides.improved_trainings import Chosen, Plan, Pool
    from train.settings import TrainSettings

UNIFORM, LOOP = "as the build draws", "closed loop"

FLOORS = {UNIFORM: 1.0, LOOP: 0.3}
"""Share of the scenes that are drawn as the build draws them."""

HALVES = (
    *("few_walls", "many_walls", "few_lights", "many_lights", "glossy", "rough"),
)  # fmt: skip
"""Of the axes walls, lights and roughness (infra.improve.axes)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extent:
    """How much is made and trained."""

    seeds: int
    """Pairs of trainings."""
    held_out: int
    """Scenes of the test split, each of which judges every pair."""
    rounds: int
    """Rounds of a training, of which both of a pair share the first."""
    steps: int
    """Steps of a round, of two views of two scenes each."""
    scenes: int
    """Scenes of a round where they are drawn as the build draws them."""


EXTENTS = {
    "quick": Extent(seeds=8, held_out=40, rounds=3, steps=24, scenes=18),
    "careful": Extent(seeds=16, held_out=80, rounds=5, steps=400, scenes=96),
}
"""By effort."""


def settings_of(extent: Extent) -> "TrainSettings":
    """Return the run of all trainings: `hits` at 32 pixels, short and without symmetries."""
    from train.runs import hits
    from train.settings import AugmentationSettings

    return dataclasses.replace(
        hits(),
        run="improved",
        resolution=32,
        num_steps=extent.rounds * extent.steps,
        scenes_per_step=2,
        schedule="wsd",
        warmup_steps=max(1, extent.steps // 4),
        ema_decay=0.97,
        augmentation=AugmentationSettings(),
    )


def _extent(effort: Effort) -> Extent:
    return EXTENTS[effort.name]


def _turns(effort: Effort) -> list[str]:
    extent = _extent(effort)
    return [
        f"seed {seed}, scene {scene}"
        for seed in range(1, extent.seeds + 1)
        for scene in range(1, extent.held_out + 1)
    ]


def _pool(workshop: Workshop) -> "Pool":
    from infra.bench.sides.improved_trainings import Pool

    settings = settings_of(_extent(workshop.effort))
    pool = workshop.kept("pool", lambda: Pool(workshop.asked.data or "", settings))
    dearest, cheapest = max(pool.core_s.values()), min(pool.core_s.values())
    sizes = len(pool.train), len(pool.validation), len(pool.test)
    workshop.note(
        f"a pool of {sizes[0]} scenes, {sizes[1]} that weigh and {sizes[2]} that judge, data "
        f"{pool.digest[:8]}; a scene costs {cheapest:.2f} to {dearest:.2f} core-seconds by stratum"
    )
    return pool


def _plan(extent: Extent, pool: "Pool") -> "Plan":
    from infra.bench.sides.improved_trainings import Plan

    price = sum(pool.base[name] * pool.core_s[name] for name in pool.base)
    return Plan(
        settings=settings_of(extent),
        rounds=extent.rounds,
        first_scenes=extent.scenes,
        core_s=extent.scenes * price,
    )


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    from infra.bench.sides.improved_trainings import compared

    seed, scene = (int(part.split()[-1]) for part in turn.split(", "))
    pool = _pool(workshop)
    if scene > len(pool.test):
        raise Rejected("no_scene", f"only {len(pool.test)} scenes judge")
    plan = _plan(_extent(workshop.effort), pool)
    # of one seed at a time: the networks are not kept, but what they scored is
    ended = workshop.kept(("seed", seed), lambda: compared(pool, plan, FLOORS, seed))
    judged = pool.test[scene - 1]
    for point in points:
        yield point.name, _figures(ended[point.name], judged.key, judged.stratum)


def _figures(chosen: "Chosen", key: str, stratum: str) -> dict[str, float]:
    loss, core_s = chosen.losses[key], chosen.making_core_s + chosen.training_core_s
    percent = 100 * math.log(loss)
    weights = list(chosen.weights[-1].values())
    return {
        "core_s": core_s,
        "core_s_percent": 100 * math.log(core_s),
        "making_s": chosen.making_core_s,
        "training_s": chosen.training_core_s,
        "scenes": float(chosen.num_scenes),
        "most_weight": max(weights) * len(weights),
        "log_l1": loss,
        "percent": percent,
        **{f"percent {half}": percent for half in halves_of(stratum)},
    }


EXPERIMENTS = (
    Experiment(
        name="improve",
        title="A closed loop against scenes drawn as the build draws them",
        about=(
            "Pairs of trainings of the run `hits`, without symmetries, that share weights, first "
            "round and number of steps; later rounds get new scenes for equal core-seconds, alike "
            "from all strata, or by `trilight improve` (loss x learnability / cost, 30 % alike)."
        ),
        cost=Column(name="making and training, core-seconds", figure="core_s", over="mean"),
        error=Column(name="log L1", figure="log_l1", over="mean"),
        against="scenes of the test split of `--data`, all their views at 32 pixels",
        columns=(
            Column(name="making", figure="making_s", over="mean"),
            Column(name="training", figure="training_s", over="mean"),
            Column(name="scenes", figure="scenes", over="mean"),
            Column(name="largest weight, x alike", figure="most_weight", over="mean"),
            Column(name="cost, %", figure="core_s_percent", over="pair"),
            Column(name="error, %", figure="percent", over="pair"),
            *(
                Column(name=f"{half.replace('_', ' ')}, %", figure=f"percent {half}", over="pair")
                for half in HALVES
            ),
        ),
        rival=lambda asked: UNIFORM,
        points=lambda effort: [Point(name=name) for name in FLOORS],
        turns=_turns,
        measure=_measure,
        cluster=lambda turn: turn.split(", ")[1],
        because=(
            "Differences are of logarithms, times 100: per cent where they are small. Intervals "
            "are 95 %, bootstrapped over the scenes that judge, with all seeds of a scene together."
        ),
        covers=("build.scenes.strata.weight",),
        needs=("torch", "data"),
    ),
)
