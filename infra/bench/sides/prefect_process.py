"""Prefect as a side: a private server, a flow of sleeping tasks, and what both take."""

import contextlib
import os
import sqlite3
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from infra.bench.workshop import Workshop
from pipeline.flows.prefect_server import SERVER, prefect_server, quiet_prefect
from pipeline.making.runner import in_window

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
