"""What Prefect costs: tasks that sleep, a thousand that do nothing, and a server that waits.

Sleeping tasks in windows of 8 say what share of the wall time scheduling takes: the ideal is known
exactly. A thousand tasks without work are the largest flow run that we make; the server takes in
their records after the flow has ended, and how long that takes is the limit on what it can show.
"""

import contextlib
import os
import sqlite3
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Options, Result
from pipeline.flows.pieces import MOST_TASKS
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.flows.runners import in_window

NAME = "orchestration"
WINDOW = 8
_IDLE_S = 30.0
_RECORDS_S = 600.0


@dataclass(frozen=True, kw_only=True)
class Orchestration(Result):
    """What was measured."""

    sleep_s: float
    """How long each sleeping task slept."""
    sleeping_tasks: int
    """How many there were, WINDOW at a time."""
    overhead: float
    """Wall time beyond the ideal, as a share of the ideal."""
    noop_tasks: int
    """Tasks without work, in one flow run."""
    noop_s: float
    """Wall time of that flow run."""
    recorded_s: float
    """Until the server shows all of them, after the flow's end; -1 where it never did."""
    recorded: int
    """How many of them it showed in the end."""
    server_idle_cores: float
    """Cores that the waiting server keeps busy."""
    server_mb: float
    """Its memory then."""
    flow_cores: float
    """Cores that the flow's process keeps busy while its tasks sleep, their ends included."""
    flow_mb: float
    """Memory of the flow's process after all its tasks."""
    bytes_per_task_run: float
    """What the server's database grew by with the tasks without work, over their number."""


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return 3


def run(options: Options, round_done: Callable[[], None]) -> Orchestration:
    """Measure; quickly 16 tasks of 10 s, otherwise 24 of 60 s."""
    sleep_s, count = (10.0, 2 * WINDOW) if options.quick else (60.0, 3 * WINDOW)
    quiet_prefect()
    with prefect_server():
        sleeping = sleeping_flow()
        idle_cores = _cores_of_server(_IDLE_S)
        round_done()
        sleeping(0.0, WINDOW, WINDOW)  # imports, connections
        cpu_s = _cpu_s(os.getpid())
        slept_s = timed(lambda: sleeping(sleep_s, count, WINDOW))
        flow_cores = (_cpu_s(os.getpid()) - cpu_s) / slept_s
        round_done()
        before, bytes_before = _recorded(), _database_bytes()
        noop_s = timed(lambda: sleeping(0.0, MOST_TASKS, WINDOW))
        recorded_s, recorded = _until_recorded(before + MOST_TASKS)
        round_done()
        return Orchestration(
            name=NAME,
            sleep_s=sleep_s,
            sleeping_tasks=count,
            overhead=slept_s / (sleep_s * count / WINDOW) - 1,
            noop_tasks=MOST_TASKS,
            noop_s=noop_s,
            recorded_s=recorded_s,
            recorded=recorded - before,
            server_idle_cores=idle_cores,
            server_mb=_megabytes(_server()),
            flow_cores=flow_cores,
            flow_mb=_megabytes(os.getpid()),
            bytes_per_task_run=(_database_bytes() - bytes_before) / MOST_TASKS,
        )


def sleeping_flow() -> Callable[[float, int, int], None]:
    """Return a flow of tasks that sleep, called with seconds of each, their number and the window.

    They are handed out as `PrefectRunner` does. Prefect is imported when its server is up.
    """
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


def rows(result: Orchestration) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [
        (
            "overhead",
            f"{result.overhead:.2%} of {result.sleeping_tasks} tasks of {result.sleep_s:.0f} s, "
            f"{WINDOW} at a time",
        ),
        (
            f"{result.noop_tasks} tasks without work",
            f"{result.noop_s:.0f} s, {result.noop_tasks / result.noop_s:.0f} a second",
        ),
        (
            "their records",
            f"{result.recorded} there {result.recorded_s:.0f} s after the end of the flow",
        ),
        ("idle server", f"{result.server_idle_cores:.1%} of a core, {result.server_mb:.0f} MB"),
        ("flow while tasks sleep", f"{result.flow_cores:.1%} of a core, {result.flow_mb:.0f} MB"),
        ("database", f"{result.bytes_per_task_run / 1000:.1f} kB a task run"),
    ]


def plot(result: Orchestration, path: Path) -> None:
    """Draw the share of the wall time that scheduling takes, against the length of a task."""
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    seconds = [1.0, 3.0, 10.0, 30.0, 100.0, 300.0]
    lost_s = result.overhead * result.sleep_s
    axes.loglog(seconds, [lost_s / length for length in seconds], label="from the sleeping tasks")
    axes.plot([result.sleep_s], [max(result.overhead, 1e-5)], "o", label="measured")
    axes.axhline(0.03, color="grey", linestyle="--", label="3 %")
    axes.set_xlabel("seconds of a task")
    axes.set_ylabel("wall time lost, share")
    axes.legend()
    figure.savefig(path)
    plt.close(figure)


def _first_done(running: Iterable[Any]) -> Any:
    from prefect.futures import as_completed

    return next(iter(as_completed(list(running))))


def timed(call: Callable[[], None]) -> float:
    """Return the seconds that a call takes."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def _recorded() -> int:
    """Return how many task runs the server shows as completed."""
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        answer = client.request(
            "POST",
            "/task_runs/count",
            json={"task_runs": {"state": {"type": {"any_": ["COMPLETED"]}}}},
        )
    return int(answer.json())


def _until_recorded(number: int) -> tuple[float, int]:
    started = time.perf_counter()
    while (found := _recorded()) < number:
        if time.perf_counter() - started > _RECORDS_S:
            return -1.0, found
        time.sleep(0.5)
    return time.perf_counter() - started, found


def _database_bytes() -> int:
    """Return what rows and indices take in the database of our private server."""
    place = Path(os.environ["PREFECT_HOME"]) / "prefect.db"
    with contextlib.closing(sqlite3.connect(f"file:{place}?mode=ro", uri=True)) as database:
        pages, free, size = (
            database.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
    return int((pages - free) * size)


def _server() -> int:
    """Return the process number of our private server: the child that serves."""
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((place / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid() and b"prefect_server" in (place / "cmdline").read_bytes():
                return int(place.name)
        except OSError:
            continue
    raise RuntimeError("PREFECT_API_URL is set: unset it, so that a server of our own is measured")


def _cores_of_server(seconds: float) -> float:
    before = _cpu_s(_server())
    time.sleep(seconds)
    return (_cpu_s(_server()) - before) / seconds


def _cpu_s(pid: int) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _megabytes(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
