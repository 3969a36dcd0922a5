"""What Prefect costs, and workers against throughput.

Sleeping tasks in windows say what share of the wall time scheduling takes: the ideal is known
exactly. A thousand tasks without work are the largest flow run that we make; the server takes in
their records after the flow has ended, and how long that takes is the limit on what it can show.

Rendering is one `trilight generate --workers N` of the same tiny scenes for each N, each worker
with one core of its own (TRILIGHT_CORES). The first N scenes are left out, in which each worker
starts and compiles; that workers run out of work at the end, one after the other, counts.
"""

import contextlib
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.workshop import Workshop
from pipeline.flows.prefect_server import SERVER, prefect_server, quiet_prefect
from pipeline.making.runner import in_window
from pipeline.making.tasks import MOST_TASKS
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import SceneLog, read_scene_logs

_RECORDS_S = 600.0


def sleeping_flow(workshop: Workshop) -> Callable[[float, int, int], None]:
    """Start a server, and return a flow called with seconds of a task, their number, the window.

    Tasks are handed out as `PrefectRunner` does. Prefect is imported when its server is up.
    """
    quiet_prefect()
    workshop.entered(prefect_server())
    from prefect import flow, task

    @task(name="pause", persist_result=False)
    def pause(seconds: float) -> None:
        time.sleep(seconds)

    @flow(name="bench-orchestration", persist_result=False)
    def tasks_of(seconds: float, number: int, window: int) -> None:
        for _ in in_window(
            range(number),
            submit=lambda _: pause.submit(seconds),
            first_done=_first_done,
            result=lambda future: future.result(),
            window=window,
        ):
            pass

    return tasks_of


def _first_done(running: Iterable[Any]) -> Any:
    from prefect.futures import as_completed

    return next(iter(as_completed(list(running))))


def recorded() -> int:
    """Return how many task runs the server shows as completed."""
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        answer = client.request(
            "POST",
            "/task_runs/count",
            json={"task_runs": {"state": {"type": {"any_": ["COMPLETED"]}}}},
        )
    return int(answer.json())


def until_recorded(number: int) -> float:
    """Return the seconds until the server shows so many task runs.

    Raises:
        RuntimeError: it does not within ten minutes.
    """
    started = time.perf_counter()
    while (found := recorded()) < number:
        if time.perf_counter() - started > _RECORDS_S:
            raise RuntimeError(f"the server shows {found} task runs of {number} after ten minutes")
        time.sleep(0.5)
    return time.perf_counter() - started


def database_bytes() -> int:
    """Return what rows and indices take in the database of our private server."""
    place = Path(os.environ["PREFECT_HOME"]) / "prefect.db"
    with contextlib.closing(sqlite3.connect(f"file:{place}?mode=ro", uri=True)) as database:
        pages, free, size = (
            database.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
    return int((pages - free) * size)


def server() -> int:
    """Return the process number of our private server: the child that serves."""
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((place / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and SERVER[-1].encode() in (place / "cmdline").read_bytes():
                return int(place.name)
        except OSError:
            continue
    raise RuntimeError("PREFECT_API_URL is set: unset it, so that a server of our own is measured")


def cores_of_server(seconds: float) -> float:
    """Return the cores that the waiting server keeps busy."""
    before = cpu_s(server())
    time.sleep(seconds)
    return (cpu_s(server()) - before) / seconds


def cpu_s(pid: int) -> float:
    """Return the processor seconds that a process has taken so far."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def megabytes(pid: int) -> float:
    """Return the resident memory of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


WINDOW = 8
RENDERING, WAITING = (1, 2, 4), (1, 2, 4, 8, 16)
"""Numbers of workers."""
VIEWS = 4
"""Views of a scene of `smoke`."""
TASKS_EACH = 4
"""Sleeping tasks of each worker."""
_IDLE_S = 30.0


def _flow(workshop: Workshop) -> Callable[[float, int, int], None]:
    """Return a flow of sleeping tasks: seconds of each, their number and the window."""
    return workshop.kept("flow", lambda: sleeping_flow(workshop))


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
        "cores": cores_of_server(seconds),
        "mb": megabytes(server()),
    }


def _sleeping(flow: Any, asked: tuple[float, int]) -> Figures:
    sleep_s, count = asked
    before_s = cpu_s(os.getpid())
    took_s = _timed(lambda: flow(sleep_s, count, WINDOW))
    return {
        "seconds_a_task": took_s / count,
        "overhead": 100 * (took_s / (sleep_s * count / WINDOW) - 1),
        "cores": (cpu_s(os.getpid()) - before_s) / took_s,
        "mb": megabytes(os.getpid()),
    }


def _empty(flow: Any, count: int) -> Figures:
    before, bytes_before = recorded(), database_bytes()
    took_s = _timed(lambda: flow(0.0, count, WINDOW))
    recorded_s = until_recorded(before + count)
    return {
        "seconds_a_task": took_s / count,
        "recorded_s": recorded_s,
        "kb": (database_bytes() - bytes_before) / count / 1000,
        "mb": megabytes(server()),
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
        about=(
            "Views per hour of N workers of one core each, which render four views of 64 x 64 "
            "pixels for each scene; and of tasks that only wait, N at a time, each in place of "
            "a scene."
        ),
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
