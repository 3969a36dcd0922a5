"""A flow run of whoever serves the flow: the deployment is found by the flow's name, and watched.

Prefect itself wants FLOW/DEPLOYMENT, and shows states alone; what a run has made so far it keeps in
artifacts (pipeline.flows.watching), which are read here.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import (
    ArtifactFilter,
    ArtifactFilterFlowRunId,
    FlowFilter,
    FlowFilterName,
)
from prefect.client.schemas.objects import FlowRun, WorkerStatus
from prefect.settings import get_current_settings

from pipeline.flows.prefect_server import prefect_client
from storage.errors import TrilightError
from storage.remote.safe_url import safe_text
from storage.settings.described import described

POLL_S = 1.0
"""Between two looks at a run."""


@dataclass(frozen=True, kw_only=True)
class Submitted:
    """A flow run that the server knows of."""

    id: UUID
    """Of the flow run."""
    name: str
    """Of the flow run, as the page shows it."""
    deployment: str
    """FLOW/DEPLOYMENT."""
    pool: str
    """Pool whose workers take it up."""
    page: str
    """URL of its page."""


@dataclass(frozen=True, kw_only=True)
class SeenRun:
    """What is known of a run at one moment."""

    state: str
    """Of the flow run, such as Scheduled, Late, Running or Completed."""
    message: str
    """What Prefect says of that state."""
    percent: float
    """Of the shards that are there."""
    tables: Mapping[str, Sequence[tuple[str, str]]]
    """Rows of `progress` and, at the end, of `summary`."""
    is_final: bool
    """Whether nothing will change any more."""
    is_completed: bool
    """Whether it ended as it should."""


@contextmanager
def server() -> Iterator[SyncPrefectClient]:
    """Provide a client of the server that is set for this folder or account.

    Raises:
        TrilightError: none is set, or it refuses, or does not answer.
    """
    if not get_current_settings().api.url:
        raise TrilightError(
            "submit: no Prefect server is set; expected one that serves Trilight's flows. Run make "
            "serve in the checkout, or set PREFECT_API_URL (and PREFECT_API_AUTH_STRING)."
        )
    with prefect_client() as client:
        yield client


def parameters(order: Any) -> dict[str, Any]:
    """Return the build of an order and what it asks beside its defaults, as its flow's form has it.

    Args:
        order: of a class of settings whose fields are the flow's parameters.
    """
    kind: type = type(order)
    given: dict[str, Any] = {}
    for field in described(kind):
        value = getattr(order, field.name)
        if field.name == "build" or value not in (field.default, {}):
            given[field.name] = _nested(value) if isinstance(value, Mapping) else value
    plain: dict[str, Any] = json.loads(json.dumps(given))
    return plain


def submit(
    client: SyncPrefectClient, flow: str, deployment: str | None, given: Mapping[str, Any]
) -> Submitted:
    """Ask for a flow run; return it as soon as the server has it.

    Args:
        client: of the server.
        flow: its name.
        deployment: its deployment's name; None: the only one, or the one that make serve makes.
        given: its parameters.

    Raises:
        TrilightError: the flow is not served there, or not by such a deployment.
    """
    found = client.read_deployments(flow_filter=FlowFilter(name=FlowFilterName(any_=[flow])))
    by_name = {one.name: one for one in found}
    if not by_name:
        raise TrilightError(
            f"submit: the server knows no deployment of the flow {flow}. Run make serve, which "
            "makes them, or python -m infra.serving.deployments in the checkout."
        )
    name = deployment or ("local" if "local" in by_name else next(iter(by_name)))
    if name not in by_name or (deployment is None and len(by_name) > 1 and name != "local"):
        raise TrilightError(
            f"submit: --deployment is {deployment!r}; expected one of {', '.join(sorted(by_name))}."
        )
    chosen = by_name[name]
    run = client.create_flow_run_from_deployment(chosen.id, parameters=dict(given))
    base = str(get_current_settings().ui_url or client.api_url).removesuffix("/api/")
    return Submitted(
        id=run.id,
        name=run.name,
        deployment=f"{flow}/{name}",
        pool=chosen.work_pool_name or "",
        page=f"{base.rstrip('/')}/runs/flow-run/{run.id}",
    )


def workers_online(client: SyncPrefectClient, pool: str) -> int:
    """Return how many workers of a pool are there to take runs up."""
    workers = client.read_workers_for_work_pool(pool) if pool else []
    return sum(worker.status == WorkerStatus.ONLINE for worker in workers)


def looks(
    client: SyncPrefectClient, run: UUID, sleep: Callable[[float], None] = time.sleep
) -> Iterator[SeenRun]:
    """Yield what is known of a run until it has ended."""
    while True:
        look = _look(client, client.read_flow_run(run))
        yield look
        if look.is_final:
            return
        sleep(POLL_S)


def _look(client: SyncPrefectClient, run: FlowRun) -> SeenRun:
    state = run.state
    is_final = state is not None and state.is_final()
    shown = client.read_artifacts(
        artifact_filter=ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run.id]))
    )
    in_order = sorted(shown, key=lambda artifact: str(artifact.updated))
    bars = [artifact for artifact in in_order if artifact.type == "progress"]
    tables = {
        artifact.key: rows
        for artifact in in_order
        if artifact.type == "table" and artifact.key and (rows := _rows(artifact.data))
    }
    return SeenRun(
        state=state.name or state.type.value if state else "Pending",
        message=safe_text(state.message or "") if state else "",
        percent=float(str(bars[-1].data)) if bars else 0.0,
        tables=tables,
        is_final=is_final,
        is_completed=state is not None and state.is_completed(),
    )


def _rows(data: Any) -> list[tuple[str, str]]:
    """Return the rows of a table of names and values; none of one with other columns."""
    rows = json.loads(data) if isinstance(data, str) else data or []
    return [(str(row["what"]), str(row["value"])) for row in rows if {"what", "value"} <= set(row)]


def _nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as the groups of the flow's form."""
    nested: dict[str, Any] = {}
    for name, value in changes.items():
        *groups, last = name.split(".")
        place = nested
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
    return nested
