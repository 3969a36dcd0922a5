"""What Prefect costs, and workers against throughput.

Sleeping tasks in windows say what share of the wall time scheduling takes: the ideal is known
exactly. A thousand tasks without work are the largest flow run that we make; the server takes in
their records after the flow has ended, and how long that takes is the limit on what it can show.

Rendering is one `trilight generate --workers N` of the same tiny scenes for each N, each worker
with one core of its own (TRILIGHT_CORES). The first N scenes are left out, in which each worker
starts and compiles; that workers run out of work at the end, one after the other, counts.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.sides import prefect_process
from infra.bench.workshop import Workshop
from pipeline.making.tasks import MOST_TASKS
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_log import SceneLog, read_scene_logs

WINDOW = 8
RENDERING, WAITING = (1, 2, 4), (1, 2, 4, 8, 16)
"""Numbers of workers."""
VIEWS = 4
"""Of a scene of `smoke`."""
TASKS_EACH = 4
"""Sleeping tasks of each worker."""
_IDLE_S = 30.0


def _flow(workshop: Workshop) -> Callable[[float, int, int], None]:
    """Return a flow of sleeping tasks: seconds of each, their number and the window."""
    return workshop.kept("flow", lambda: prefect_process.sleeping_flow(workshop))


def _timed(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def _prefect(workshop: Workshop, point: Point, turn: str) -> Figures:
    flow = _flow(workshop)
    workshop.kept("warm", lambda: flow(0.0, WINDOW, WINDOW))  # imports, connections
    measured: Callable[[Any, Any], Figures] = point.settings[0]
    return measured(flow, point.settings[1])


def _idle(flow: Any, seconds: float) -> Figures:
    return {
        "seconds_a_task": seconds,
        "cores": prefect_process.cores_of_server(seconds),
        "mb": prefect_process.megabytes(prefect_process.server()),
    }


def _sleeping(flow: Any, asked: tuple[float, int]) -> Figures:
    sleep_s, count = asked
    cpu_s = prefect_process.cpu_s(os.getpid())
    took_s = _timed(lambda: flow(sleep_s, count, WINDOW))
    return {
        "seconds_a_task": took_s / count,
        "overhead": 100 * (took_s / (sleep_s * count / WINDOW) - 1),
        "cores": (prefect_process.cpu_s(os.getpid()) - cpu_s) / took_s,
        "mb": prefect_process.megabytes(os.getpid()),
    }


def _empty(flow: Any, count: int) -> Figures:
    before, bytes_before = prefect_process.recorded(), prefect_process.database_bytes()
    took_s = _timed(lambda: flow(0.0, count, WINDOW))
    recorded_s = prefect_process.until_recorded(before + count)
    return {
        "seconds_a_task": took_s / count,
        "recorded_s": recorded_s,
        "kb": (prefect_process.database_bytes() - bytes_before) / count / 1000,
        "mb": prefect_process.megabytes(prefect_process.server()),
    }


def _loads(effort: Effort) -> list[Point]:
    careful = effort.name == "careful"
    sleep_s, count = (60.0, 3 * WINDOW) if careful else (10.0, 2 * WINDOW)
    return [
        Point(name="idle server", settings=(_idle, _IDLE_S if careful else _IDLE_S / 3)),
        Point(
            name=f"{count} tasks of {sleep_s:.0f} s, {WINDOW} at a time",
            settings=(_sleeping, (sleep_s, count)),
            default=True,
        ),
        Point(name=f"{MOST_TASKS} tasks without work", settings=(_empty, MOST_TASKS)),
    ]


def _workers(effort: Effort) -> list[Point]:
    rendering = [Point(name=f"{n} rendering", settings=(_render, n)) for n in RENDERING]
    waiting = [Point(name=f"{n} waiting", settings=(_wait, n)) for n in WAITING]
    return [*rendering, *waiting]


def _one_rate(workshop: Workshop, point: Point, turn: str) -> Figures:
    measured, workers = point.settings
    rate = measured(workshop, workers)
    one = workshop.kept((measured, turn), lambda: rate)  # of one worker, which comes first
    return {"view_s": 3600 / rate, "share": 100 * rate / (workers * one)}


def _wait(workshop: Workshop, workers: int) -> float:
    """Return views an hour of tasks that sleep, each of which stands for a scene."""
    flow, tasks = _flow(workshop), TASKS_EACH * workers
    sleep_s = 5.0 if workshop.effort.name == "careful" else 2.0
    return 3600 * VIEWS * tasks / _timed(lambda: flow(sleep_s, tasks, workers))


def _render(workshop: Workshop, workers: int) -> float:
    """Return views an hour of `trilight generate`."""
    place = workshop.folder() / "set"
    count = 48 if workshop.effort.name == "careful" else 16
    words = [sys.executable, "-m", "trilight", "generate", "smoke", "--out", str(place)]
    words += ["--objects", workshop.asked.objects[0], "--scenes", str(count)]
    words += ["--resolution", "64", "--noise-floor", "20", "--workers", str(workers)]
    subprocess.run(
        words,
        env={**os.environ, "TRILIGHT_CORES": str(workers)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return views_per_hour(list(read_scene_logs(DatasetFolder(place))), workers)


def views_per_hour(scenes: Sequence[SceneLog], workers: int) -> float:
    """Return the rate after each worker has made one scene, up to the end of the last.

    Args:
        scenes: all that were made, in any order; more than there are workers.
        workers: how many made them.
    """
    finished = sorted(scene.finished_unix_s for scene in scenes)
    span_s = finished[-1] - finished[workers - 1]
    return 3600 * VIEWS * (len(finished) - workers) / max(span_s, 0.1)  # logs say tenths


EXPERIMENTS = (
    Experiment(
        name="prefect",
        title="What Prefect costs",
        about="A private server and one flow: idle, tasks that sleep, and tasks without work.",
        cost=Column(name="seconds a task, on the clock", figure="seconds_a_task"),
        columns=(
            Column(name="beyond the ideal %", figure="overhead"),
            Column(name="cores, server or flow", figure="cores"),
            Column(name="MB, server or flow", figure="mb"),
            Column(name="all recorded after, s", figure="recorded_s"),
            Column(name="database kB a task", figure="kb"),
        ),
        points=_loads,
        turns=lambda effort: ["round 1"],
        measure=one_by_one(_prefect),
    ),
    Experiment(
        name="workers",
        title="Workers against throughput",
        about="Views an hour of N workers of one core each, rendering four views of 64 x 64 a "
        "scene; and of tasks that only wait, N at a time, each of which stands for a scene.",
        cost=Column(name="seconds a view, on the clock", figure="view_s"),
        columns=(
            Column(name="views an hour", figure="view_s", then=lambda s: 3600 / s),
            Column(name="of N times one, %", figure="share"),
        ),
        points=_workers,
        turns=repeats,
        measure=one_by_one(_one_rate),
    ),
)
