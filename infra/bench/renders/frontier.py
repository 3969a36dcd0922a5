"""Cost at equal true error: our renderer, plain Mitsuba and, where asked for, Blender's Cycles.

Errors are true ones, to converged references of our own renderer (infra.bench.renders.references):
where another renderer transports light differently it cannot come nearer than that difference, as
its error at many samples shows. The sides take turns on every scene.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.bench.cycles import environment
from infra.bench.cycles.comparison import NamedScene
from infra.bench.cycles.cycles_picture import Request, cycles_picture
from infra.bench.harness import Options, Result, machine
from infra.bench.render_child import smoke_child
from infra.bench.renders.claims import (
    Claim,
    Shot,
    Summary,
    at_equal_worst_error,
    at_error_not_worse,
    summarised,
)
from infra.bench.renders.kept import Kept
from infra.bench.renders.ladder import render_ladder
from infra.bench.renders.named_set import named_set
from infra.bench.renders.plain_mitsuba import render_levels
from infra.bench.renders.references import RESOLUTION, Reference, make_reference
from pipeline.isolation import IsolatedChild
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.scene import Scene

NAME = "render-frontier"
_SEED = 20_261_121


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is rendered of every scene."""

    scenes: tuple[str, ...]
    """Names in the set."""
    resolution: int
    """Pixels each way."""
    targets_db: tuple[float, ...]
    """Our noise floors."""
    max_spp: int
    """Our cap."""
    mitsuba_spp: tuple[int, ...]
    """Fixed numbers of samples of plain Mitsuba, from few to many."""
    cycles_spp: tuple[int, ...]
    """Those of Cycles."""
    threads: int
    """Of every renderer."""


@dataclass(frozen=True, kw_only=True)
class Frontier(Result):
    """All pictures, every side over the set, and the ratios."""

    plan: Plan
    """What was rendered."""
    shots: tuple[Shot, ...]
    """Scene by scene, the sides in turns."""
    reference_floors_db: dict[str, float]
    """The references' own floors by scene: errors near them are the references' as well."""
    summaries: tuple[Summary, ...]
    """Ours by target, then Mitsuba and Cycles by samples."""
    claims: tuple[Claim, ...]
    """Mitsuba against each of our targets, Cycles against the cheapest that is as good."""
    num_resumed: int = 0
    """Scenes that an earlier, interrupted run measured."""


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return len(_chosen(options))


def run(options: Options, round_done: Callable[[], None]) -> Frontier:
    """Measure; quickly four scenes and few samples, otherwise the named set.

    Raises:
        TrilightError: the folder of scenes holds none, or Blender is asked for and not to be had.
    """
    chosen = _chosen(options)
    if options.cycles_spp:
        environment.blender_python()  # before anything is measured
    return measure(chosen, _plan(options, chosen), options, round_done)


def measure(
    chosen: Sequence[NamedScene], plan: Plan, options: Options, round_done: Callable[[], None]
) -> Frontier:
    """Render and judge every scene; see `run`."""
    kept = Kept(NAME, {**machine(), **dataclasses.asdict(plan)}, resume=options.resume)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.closing(smoke_child(Path(folder), threads=plan.threads)) as child:
            for named in chosen:
                measure_scene = functools.partial(_scene_record, named, plan, child)
                found[named.name] = kept.item(named.name, measure_scene)
                round_done()
    kept.forget()
    shots = tuple(Shot(**shot) for record in found.values() for shot in record["shots"])
    floors = {name: record["reference_floor_db"] for name, record in found.items()}
    return dataclasses.replace(judged(plan, shots, floors), num_resumed=kept.num_resumed)


def judged(plan: Plan, shots: tuple[Shot, ...], reference_floors_db: dict[str, float]) -> Frontier:
    """Return what the pictures of a plan say.

    Args:
        plan: what was rendered.
        shots: one of every scene and side.
        reference_floors_db: the references' own floors by scene.
    """
    ours = [summarised(shots, our_side(target_db)) for target_db in plan.targets_db]
    mitsuba = [summarised(shots, mitsuba_side(spp)) for spp in plan.mitsuba_spp]
    cycles = [summarised(shots, cycles_side(spp)) for spp in plan.cycles_spp]
    claims: list[Claim | None] = [at_equal_worst_error(one, mitsuba, "mitsuba") for one in ours]
    claims += [at_error_not_worse(ours, one) for one in cycles]
    return Frontier(
        name=NAME,
        plan=plan,
        shots=shots,
        reference_floors_db=reference_floors_db,
        summaries=(*ours, *mitsuba, *cycles),
        claims=tuple(claim for claim in claims if claim),
    )


def _chosen(options: Options) -> list[NamedScene]:
    every = named_set(options.scenes)
    return every[:: len(every) // 4][:4] if options.quick else every


def _plan(options: Options, chosen: Sequence[NamedScene]) -> Plan:
    num_levels = 4 if options.quick else 7
    return Plan(
        scenes=tuple(named.name for named in chosen),
        resolution=RESOLUTION,
        targets_db=(38.0, 42.0, 46.0, 50.0),
        max_spp=1024,  # a sixteenth of the references'
        mitsuba_spp=tuple(64 << doubling for doubling in range(num_levels)),
        cycles_spp=tuple(sorted(options.cycles_spp)),
        threads=os.cpu_count() or 1,
    )


def _scene_record(named: NamedScene, plan: Plan, child: IsolatedChild) -> dict[str, Any]:
    """Return what is kept of a scene, as JSON values."""
    reference = make_reference(named, child)
    scene = named.make(child)
    shots = _our_shots(named.name, scene, plan, child, reference)
    shots += _mitsuba_shots(named.name, scene, plan, child, reference)
    shots += [_cycles_shot(named.name, scene, plan, spp, reference) for spp in plan.cycles_spp]
    return {
        "shots": [dataclasses.asdict(shot) for shot in shots],
        "reference_floor_db": reference.noise_floor_db,
    }


def _our_shots(
    name: str, scene: Scene, plan: Plan, child: IsolatedChild, reference: Reference
) -> list[Shot]:
    ladder = child.call(render_ladder, scene, plan.resolution, plan.targets_db, plan.max_spp, _SEED)
    return [
        Shot(
            scene=name,
            side=our_side(rung.target_db),
            spp=rung.view.spp,
            core_s=rung.core_s,
            load_s=ladder.load_core_s,
            noise_floor_db=rung.view.noise_floor_db,
            **_errors(rung.view.radiance_rgb, reference),
        )
        for rung in ladder.rungs
    ]


def _mitsuba_shots(
    name: str, scene: Scene, plan: Plan, child: IsolatedChild, reference: Reference
) -> list[Shot]:
    found = child.call(render_levels, scene, plan.resolution, plan.mitsuba_spp, _SEED)
    return [
        Shot(
            scene=name,
            side=mitsuba_side(level.spp),
            spp=level.spp,
            core_s=level.core_s,
            load_s=found.load_core_s,
            noise_floor_db=None,
            **_errors(level.radiance_rgb, reference),
        )
        for level in found.levels
    ]


def _cycles_shot(name: str, scene: Scene, plan: Plan, spp: int, reference: Reference) -> Shot:
    request = Request(
        resolution=plan.resolution, spp=spp, denoise=True, seed=spp, threads=plan.threads
    )
    picture = cycles_picture(scene, 0, request)
    return Shot(
        scene=name,
        side=cycles_side(spp),
        spp=spp,
        core_s=picture.core_s,
        load_s=picture.prepare_s,
        noise_floor_db=None,
        **_errors(picture.radiance_rgb, reference),
    )


def _errors(radiance_rgb: NDArray[np.float32], reference: Reference) -> dict[str, float]:
    return {
        "log_db": psnr_log_db(radiance_rgb, reference.radiance_rgb),
        "linear_db": psnr_linear_db(radiance_rgb, reference.radiance_rgb),
    }


def our_side(target_db: float) -> str:
    """Return the name of one of our targets."""
    return f"trilight {target_db:.0f} dB"


def mitsuba_side(spp: int) -> str:
    """Return the name of plain Mitsuba with a number of samples."""
    return f"mitsuba {spp}"


def cycles_side(spp: int) -> str:
    """Return the name of Cycles with a number of samples."""
    return f"cycles {spp}"
