"""Many makers of one dataset: simulated up to a thousand machines, and some as real processes.

What a maker does at its beginning, for a shard and at its end is measured here, on outlines of
several sizes in a folder and in a bucket; the simulation goes on from there to two million scenes.
"""

import dataclasses
import math
import os
import shutil
from collections.abc import Mapping, Sequence

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, percent
from infra.bench.sides.bucket_server import BucketServer, bucket_server
from infra.bench.sides.maker_costs import (
    StepFigures,
    fitted_steps,
    step_figures,
    upload_outline,
)
from infra.bench.sides.maker_processes import Stint, StintTimes, begun_here, stints_together
from infra.bench.sides.makers_simulation import (
    FINISHING,
    IDLE,
    LOST,
    MAKING,
    NOTHING,
    OWN_STEPS,
    STARTING,
    WAITING,
    Fleet,
    Growing,
    MakerStep,
    Protocol,
    simulated,
)
from infra.bench.subjects.simulated_set import write_outline
from infra.bench.workshop import Workshop
from pipeline.making.environment import environment
from pipeline.renders.variant import choose_variant

MACHINES = (10, 100, 1_000)
PLACES = ("folder", "bucket")
_OUTLINES: Mapping[tuple[str, str], tuple[int, ...]] = {
    ("folder", "quick"): (100, 1_000),
    ("folder", "careful"): (1_000, 20_000),
    ("bucket", "quick"): (10, 100),
    ("bucket", "careful"): (100, 1_000),
}
"""Shards of the outlines that steps are measured on, half of them made and all but one."""
_START_S = 20.0
"""A process imports a second, its render child starts and compiles ten; a shell and a container
take the rest."""
_REQUESTS_A_S, _LATENCY_S = 3_500.0, 0.03
"""What object stores promise for writes below one prefix, and take for one."""
_AT_ONCE = 32
"""Notes that whoever finishes fetches at a time (storage.dataset.shard_notes)."""

PROCESSES: Mapping[str, tuple[int, ...]] = {"quick": (1, 4, 16), "careful": (1, 4, 16, 64)}
_SHARDS_EACH, _SCENES = 4, 8
_SCENE_S: Mapping[str, float] = {"quick": 0.25, "careful": 1.0}

_SHARES = {
    "waiting": WAITING,
    "own_steps": OWN_STEPS,
    "starting": STARTING,
    "lost": LOST,
    "idle": IDLE,
    "finishing": FINISHING,
}


def _outlined(workshop: Workshop, place: str) -> dict[str, MakerStep]:
    """Return the steps of a maker as measured here, by the size of the dataset."""
    found: list[tuple[int, int, StepFigures]] = []
    folder = workshop.folder()
    for planned in _OUTLINES[place, workshop.effort.name]:
        for made in (planned // 2, planned - 1):
            root = folder / f"{planned}-{made}"
            write_outline(root, planned, made=made)
            if place == "folder":
                found.append((planned, made, step_figures(str(root))))
            else:
                server = _server(workshop)
                url = upload_outline(root, server, root.name)
                found.append((planned, made, step_figures(url, server.log, folder / "cache")))
            shutil.rmtree(root)
    return fitted_steps(found)


def _server(workshop: Workshop) -> BucketServer:
    return workshop.kept("server", lambda: workshop.entered(bucket_server()))


def protocol_of(workshop: Workshop, place: str) -> Protocol:
    """Return what makers do beside making scenes, in a folder or a bucket."""
    steps = workshop.kept(("steps", place), lambda: _outlined(workshop, place))
    if place == "folder":
        return Protocol(
            start_s=_START_S,
            begin=steps["begin"],
            note=steps["note"],
            end=steps["end"],
            finish=steps["finish"],
        )
    own = {  # the folder is one machine's own, and so are its turns
        name: dataclasses.replace(step, in_turn_s=NOTHING) for name, step in steps.items()
    }
    return Protocol(
        start_s=_START_S,
        keeps_scenes=False,
        requests_a_s=_REQUESTS_A_S,
        latency_s=_LATENCY_S,
        begin=own["begin"],
        note=own["note"],
        end=own["end"],
        finish=own["finish"],
        at_once=_AT_ONCE,
    )


def _simulated(workshop: Workshop, point: Point, turn: str) -> Figures:
    place, machines = point.settings
    fleet = Fleet(machines=machines)
    fate = simulated(fleet, protocol_of(workshop, place))
    shares = fate.shares()
    worst = max((name for name in shares if name != MAKING), key=lambda name: shares[name])
    workshop.note(f"{point.name}: most is lost to {worst}, {shares[worst]:.0%}")
    return {
        "hours": fate.seconds / 3600,
        "ideal_hours": fleet.ideal_s / 3600,
        "making": shares[MAKING],
        **{name: shares[what] for name, what in _SHARES.items()},
    }


def _real(workshop: Workshop, point: Point, turn: str) -> Figures:
    place, count = point.settings
    scene_s = _SCENE_S[workshop.effort.name]
    stints = _stints(workshop, place, count, scene_s)
    requests = _server(workshop).num_requests() if place == "bucket" else 0
    begun_here(stints[0], freeze=True)
    seconds, times = stints_together(stints)
    if place == "bucket":
        requests = _server(workshop).num_requests() - requests
    one = workshop.kept(("alone", place), lambda: (times[0], requests, seconds))
    fleet = Fleet(
        machines=count, cores=1, num_shards=count * _SHARDS_EACH, scenes_per_shard=_SCENES,
        scene_core_s=scene_s, spread=0.0, slow_share=0.0, life_s=math.inf,
        cores_together=os.cpu_count() or 1, shards_per_task=_SHARDS_EACH,
    )  # fmt: skip
    return {
        "clock_s": seconds,
        "simulated_s": simulated(fleet, _alone(workshop, place, *one[:2])).seconds,
        "ideal_s": fleet.ideal_s,
        "core_s": sum(_core_s(each) for each in times) / count,
        "requests": requests / count,
    }


def _stints(workshop: Workshop, place: str, count: int, scene_s: float) -> list[Stint]:
    root = workshop.folder()
    found = workshop.kept("environment", lambda: environment(choose_variant()))
    to = str(root / "set") if place == "folder" else f"{_server(workshop).url}-of-{count}"
    return [
        Stint(
            place=to, cache=str(root / f"cache-{number}"),
            shards=(number * _SHARDS_EACH, (number + 1) * _SHARDS_EACH),
            num_shards=count * _SHARDS_EACH, scenes_per_shard=_SCENES, scene_s=scene_s,
            environment=found,
        )
        for number in range(count)
    ]  # fmt: skip


def _alone(workshop: Workshop, place: str, times: StintTimes, requests: int) -> Protocol:
    """Return what a maker does by what one alone took; the rest as it grows with the dataset."""
    found = protocol_of(workshop, place)
    note = dataclasses.replace(found.note, work_s=Growing(fixed=times.made_core_s / _SHARDS_EACH))
    if place == "folder":
        return dataclasses.replace(found, start_s=0.0, note=note)
    # each request takes the server, which is one process, and our line no time
    server = _server(workshop)
    rate = server.num_requests() / max(server.core_s(), 0.1)
    return dataclasses.replace(found, start_s=0.0, note=note, requests_a_s=rate, latency_s=0.0)


def _core_s(times: StintTimes) -> float:
    return times.begin_core_s + times.made_core_s + times.end_core_s


def _machines(effort: Effort) -> list[Point]:
    return [
        Point(name=f"{place}, {count:,} machines", settings=(place, count))
        for place in PLACES
        for count in MACHINES
    ]


def _processes(effort: Effort) -> list[Point]:
    return [
        Point(name=f"{place}, {count} processes", settings=(place, count))
        for place in PLACES
        for count in PROCESSES[effort.name]
    ]


def _count(point: Point) -> tuple[str, float]:
    place, _, count = point.name.rpartition(", ")
    return place, float(count.split()[0].replace(",", ""))


_LOST_TO: Sequence[tuple[str, str]] = (
    ("waiting for a turn %", "waiting"),
    ("begin, note, end %", "own_steps"),
    ("starting %", "starting"),
    ("made twice %", "lost"),
    ("idle %", "idle"),
)

EXPERIMENTS = (
    Experiment(
        name="makers-simulated",
        title="Two million scenes by 10, 100 and 1,000 machines, simulated",
        about=(
            "250,000 shards of eight scenes at 61.8 core-seconds each, by machines of 16 cores of "
            "which one in fifty takes three times as long, and each vanishes after eight hours in "
            "the mean and is replaced in five minutes. Each takes tasks of an array (40 shards or "
            "fewer). What makers do beside making scenes is measured here; shares are of all "
            "machine-seconds."
        ),
        cost=Column(name="hours", figure="hours"),
        columns=(
            Column(name="ideal hours", figure="ideal_hours"),
            Column(name="making scenes %", figure="making", then=percent),
            *(Column(name=name, figure=figure, then=percent) for name, figure in _LOST_TO),
        ),
        size_of=_count,
        against_size="machines",
        points=_machines,
        turns=lambda effort: ["round 1"],
        measure=one_by_one(_simulated),
        needs=("moto",),
    ),
    Experiment(
        name="makers-real",
        title="Makers as real processes, beside the simulation",
        about=(
            "Processes that each make four shards of eight scenes, of scenes that only take a "
            "second; all else is real. Seconds on the clock of two busy cores say little; "
            "core-seconds and requests do."
        ),
        cost=Column(name="core-seconds a maker", figure="core_s"),
        columns=(
            Column(name="requests a maker", figure="requests"),
            Column(name="seconds on the clock", figure="clock_s"),
            Column(name="simulated", figure="simulated_s"),
            Column(name="ideal", figure="ideal_s"),
        ),
        also_cost=("seconds on the clock",),
        size_of=_count,
        against_size="processes",
        points=_processes,
        turns=lambda effort: ["round 1"],
        measure=one_by_one(_real),
        needs=("moto",),
    ),
)
