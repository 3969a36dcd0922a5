"""Runs one experiment: every point once in each turn, stored as soon as it is measured.

Machines drift. The points of an experiment therefore take turns (A B A B ...), and only ratios
within one run are claims.
"""

import contextlib
import dataclasses
import importlib.util
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from infra.bench.effort import Asked, Effort
from infra.bench.experiment import Experiment, points_of
from infra.bench.machine import ROOT, machine
from infra.bench.plot import plot
from infra.bench.shares import Share, rows_of, shared_rows
from infra.bench.store import Run, Store
from infra.bench.subjects.named_scenes import described
from infra.bench.workshop import Workshop
from pipeline.isolation import ChildFailed
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError

RESULTS = ROOT / "docs" / "bench"

TurnDone = Callable[[int, int], None]
"""Called with the number of finished turns and of all turns."""


def store_of(folder: Path, name: str, effort: str) -> Store:
    """Return the results of an experiment at an effort (`quick` or `careful`)."""
    suffix = "" if effort == "careful" else f"-{effort}"
    return Store(folder / f"{name}{suffix}.jsonl")


def newest_run(folder: Path, name: str) -> tuple[Run, Store] | None:
    """Return the last careful run of an experiment, else the last quick one, with its file."""
    for effort in ("careful", "quick"):
        store = store_of(folder, name, effort)
        if found := store.newest():
            return found, store
    return None


def run(
    experiment: Experiment,
    effort: Effort,
    asked: Asked,
    *,
    folder: Path = RESULTS,
    turn_done: TurnDone = lambda done, total: None,
) -> Store:
    """Measure what is missing of an experiment, draw its figure, and return its results.

    A run of the same plan that was interrupted goes on. Turns that were measured are not measured
    again; an interrupted turn is, or only what it lacks where points are measured one by one. Rows
    that shares have measured (`run_share`) are taken over.

    Raises:
        TrilightError: something that the experiment needs is missing, or no turn could be measured.
    """
    if lack := lacking(experiment, asked):
        raise TrilightError(f"bench {experiment.name}: {lack}.")
    store = store_of(folder, experiment.name, effort.name)
    current = store.begin(_plan(experiment, effort, asked))
    taken = _take_shares(store, current)
    began = time.perf_counter()
    with contextlib.closing(Workshop(effort, asked, folder)) as workshop:
        _measure(experiment, current, store, workshop, turn_done)
        notes = [*workshop.notes, *taken]
    if not current.whole_turns():
        reasons = "; ".join(sorted(set(current.left_out.values())))
        raise TrilightError(f"bench {experiment.name}: no turn could be measured: {reasons}.")
    # before the end is stored: a run that cannot be drawn is unfinished
    plot(experiment, current, store.path.with_suffix(".png"))
    store.end(current, time.perf_counter() - began, notes)
    return store


def run_share(
    experiment: Experiment,
    effort: Effort,
    asked: Asked,
    share: Share,
    *,
    folder: Path = RESULTS,
    turn_done: TurnDone = lambda done, total: None,
) -> Store:
    """Measure what is missing of one share of an experiment, and return the file of the share.

    Raises:
        TrilightError: as `run`.
    """
    if lack := lacking(experiment, asked):
        raise TrilightError(f"bench {experiment.name}: {lack}.")
    store = Store(share.path(store_of(folder, experiment.name, effort.name).path))
    plan = _plan(experiment, effort, asked)
    current = store.begin(plan)
    turns, points = current.plan["turns"], current.plan["points"]
    wanted = rows_of(turns, points, share, apart=experiment.by_point)
    with contextlib.closing(Workshop(effort, asked, folder)) as workshop:
        _measure(experiment, current, store, workshop, turn_done, wanted)
    return store


def _take_shares(store: Store, current: Run) -> list[str]:
    """Take rows over that shares have measured; return what is to be said of them."""
    machines = Counter[str]()
    for turn, point, figures, name in shared_rows(store.path, current.plan):
        if point not in current.turns.get(turn, {}):
            store.add(current, turn, point, figures)
        machines[name] += 1
    return [f"{count} rows are of {name}" for name, count in sorted(machines.items())]


def lacking(experiment: Experiment, asked: Asked) -> str:
    """Return what an experiment needs that is missing; empty if nothing is."""
    if "torch" in experiment.needs and importlib.util.find_spec("torch") is None:
        return "torch is not installed; run `make setup-all`"
    if "moto" in experiment.needs and importlib.util.find_spec("moto") is None:
        return "moto is not installed, which stands for a bucket; run `make setup-all`"
    if "data" in experiment.needs and not asked.data:
        return "expected --data SET, the root of a finished dataset"
    return ""


def _plan(experiment: Experiment, effort: Effort, asked: Asked) -> dict[str, object]:
    if "blender" in experiment.needs:
        from infra.bench.sides.blender_environment import blender_python

        blender_python()  # before anything is measured
    # results are published, and nobody's folders with them
    wanted = {
        **dataclasses.asdict(asked),
        "scenes": asked.scenes.name if asked.scenes else None,
        "checkpoint": asked.network_names,
        "data": _named(asked.data) if asked.data else None,
    }
    folder = described(asked.scenes) if experiment.takes_scenes else []
    rival = {"rival": experiment.rival(asked)} if experiment.rival else {}
    return {
        "experiment": experiment.name,
        "effort": dataclasses.asdict(effort),
        "asked": wanted,
        "machine": machine(asked.device),
        "points": [point.name for point in points_of(experiment, effort, asked)],
        "turns": [*(named.name for named in folder), *experiment.turns(effort)],
        **rival,
    }


def _named(data: str) -> str:
    """Return the name of a dataset's root, with what tells it from others of that name."""
    return f"{PurePosixPath(data).name} ({sha256_hex(data.encode())[:8]})"


def _measure(
    experiment: Experiment,
    current: Run,
    store: Store,
    workshop: Workshop,
    turn_done: TurnDone,
    only: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Measure the points that turns lack; `only` these of each turn, where some are named."""
    points = points_of(experiment, workshop.effort, workshop.asked)
    missing, total = current.missing_turns(), len(current.plan["turns"])
    if experiment.warm_up and missing:
        for _ in experiment.measure(workshop, points, missing[0]):
            pass
    for number, turn in enumerate(missing, total - len(missing) + 1):
        done = current.turns.get(turn, {}) if experiment.by_point else {}
        named = None if only is None else only[turn]
        wanted = [
            point
            for point in points
            if point.name not in done and (named is None or point.name in named)
        ]
        try:
            for point, figures in experiment.measure(workshop, wanted, turn) if wanted else ():
                store.add(current, turn, point, figures)
        except (Rejected, ChildFailed) as error:
            store.leave_out(current, turn, str(error))
        turn_done(number, total)
