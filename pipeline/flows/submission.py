"""Submits a flow run to a Prefect server and polls its state and artifacts.

The deployment is found by the flow's name alone, while Prefect needs FLOW/DEPLOYMENT. Prefect shows
only states; the progress of a run is in its artifacts (pipeline.flows.prefect_runner).
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
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
from prefect.client.schemas.objects import WorkerStatus
from prefect.settings import get_current_settings
from prefect.states import Pending

from pipeline.flows.prefect_server import prefect_client
from storage.errors import TrilightError
from storage.remote.url import safe_text
from storage.settings.fields import describe_fields

POLL_S = 1.0
"""Seconds between two polls of a run."""


@dataclass(frozen=True, kw_only=True)
class SubmittedRun:
    """A flow run that the server has accepted."""

    id: UUID
    name: str
    """Name of the flow run, as the page shows it."""
    deployment: str
    """Name of the deployment in the form FLOW/DEPLOYMENT."""
    pool: str
    """Work pool whose workers execute the run."""
    page: str


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """State and artifacts of a run at one moment."""

    state: str
    """State of the flow run, such as Scheduled, Late, Running or Completed."""
    message: str
    """Prefect's message on that state."""
    percent: float
    """Finished shards in percent, 0 to 100."""
    tables: Mapping[str, Sequence[tuple[str, str]]]
    """Rows of the artifact `progress` and, at the end, of `summary`."""
    is_completed: bool
    """True if the run ended without an error."""


def server() -> AbstractContextManager[SyncPrefectClient]:
    """Return a block with a client of the configured Prefect server.

    Raises:
        TrilightError: none is configured, or it refuses, or does not answer.
    """
    if not get_current_settings().api.url:
        raise TrilightError(
            "submit: no Prefect server is set; expected one that serves Trilight's flows. Run make "
            "serve in the checkout, or set PREFECT_API_URL (and PREFECT_API_AUTH_STRING)."
        )
    return prefect_client()


def parameters(options: Any) -> dict[str, Any]:
    """Return the preset and all fields that are not defaults, in the layout of the flow's form."""
    kind: type = type(options)
    values: dict[str, Any] = {}
    for field in describe_fields(kind):
        value = getattr(options, field.name)
        if field.name == "build" or value not in (field.default, {}):
            values[field.name] = _nest_groups(value) if isinstance(value, Mapping) else value
    return dict(json.loads(json.dumps(values)))


def submit(
    client: SyncPrefectClient, flow: str, deployment: str | None, values: Mapping[str, Any]
) -> SubmittedRun:
    """Create a flow run; return as soon as the server has accepted it.

    Args:
        deployment: name of its deployment; None: the only one, or the one that make serve makes.

    Raises:
        TrilightError: the flow is not served there, or not by such a deployment.
    """
    deployments = client.read_deployments(flow_filter=FlowFilter(name=FlowFilterName(any_=[flow])))
    by_name = {one.name: one for one in deployments}
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
    run = client.create_flow_run_from_deployment(chosen.id, parameters=dict(values))
    base = str(get_current_settings().ui_url or client.api_url).removesuffix("/api/")
    return SubmittedRun(
        id=run.id,
        name=run.name,
        deployment=f"{flow}/{name}",
        pool=chosen.work_pool_name or "",
        page=f"{base.rstrip('/')}/runs/flow-run/{run.id}",
    )


def workers_online(client: SyncPrefectClient, pool: str) -> int:
    workers = client.read_workers_for_work_pool(pool) if pool else []
    return sum(worker.status == WorkerStatus.ONLINE for worker in workers)


def poll_run(
    client: SyncPrefectClient, run: UUID, sleep: Callable[[float], None] = time.sleep
) -> Iterator[RunStatus]:
    """Poll a flow run; yield its status until it has ended."""
    of_run = ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run]))
    while True:
        state = client.read_flow_run(run).state or Pending()
        artifacts = client.read_artifacts(artifact_filter=of_run)
        percent = 0.0
        tables: dict[str, Sequence[tuple[str, str]]] = {}
        for artifact in sorted(artifacts, key=lambda artifact: str(artifact.updated)):
            data: Any = artifact.data
            if artifact.type == "progress":
                percent = float(str(data))
            elif artifact.type == "table" and artifact.key:
                rows = json.loads(data) if isinstance(data, str) else data or []
                tables[artifact.key] = [
                    (str(row["what"]), str(row["value"]))
                    for row in rows
                    if {"what", "value"} <= set(row)  # others are not ours
                ]
        yield RunStatus(
            state=state.name or state.type.value,
            message=safe_text(state.message or ""),
            percent=percent,
            tables=tables,
            is_completed=state.is_completed(),
        )
        if state.is_final():
            return
        sleep(POLL_S)


def _nest_groups(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Convert dotted names to the nested groups of the flow's form."""
    nested: dict[str, Any] = {}
    for name, value in changes.items():
        *groups, last = name.split(".")
        level = nested
        for group in groups:
            level = level.setdefault(group, {})
        level[last] = value
    return nested
