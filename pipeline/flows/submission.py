"""Finds a deployment of a Prefect server, and polls the state and artifacts of a run.

The deployment is found by the flow's name alone, while Prefect needs FLOW/DEPLOYMENT. Prefect shows
only states; the progress of a run is in its artifacts (pipeline.flows.prefect_runner).
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import (
    ArtifactFilter,
    ArtifactFilterFlowRunId,
    FlowFilter,
    FlowFilterName,
)
from prefect.client.schemas.objects import State, WorkerStatus
from prefect.client.schemas.responses import DeploymentResponse
from prefect.settings import get_current_settings
from prefect.states import Pending

from pipeline.flows.prefect_server import prefect_client
from storage.errors import TrilightError
from storage.settings.fields import describe_fields

POLL_S = 1.0
"""Seconds between two polls of a run."""


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


def find_deployment(client: SyncPrefectClient, flow: str, name: str | None) -> DeploymentResponse:
    """Return a deployment of a flow; without a name the only one, or that of make serve.

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
    usual = next(iter(by_name)) if len(by_name) == 1 else "local"
    if (chosen := by_name.get(name or usual)) is None:
        raise TrilightError(
            f"submit: --deployment is {name!r}; expected one of {', '.join(sorted(by_name))}."
        )
    return chosen


def page_of(client: SyncPrefectClient, run: UUID) -> str:
    """Return the URL of the page of a flow run."""
    base = str(get_current_settings().ui_url or client.api_url).removesuffix("/api/")
    return f"{base.rstrip('/')}/runs/flow-run/{run}"


def workers_online(client: SyncPrefectClient, pool: str) -> int:
    workers = client.read_workers_for_work_pool(pool) if pool else []
    return sum(worker.status == WorkerStatus.ONLINE for worker in workers)


def poll_run(
    client: SyncPrefectClient, run: UUID, sleep: Callable[[float], None] = time.sleep
) -> Iterator[tuple[State, float, Mapping[str, Mapping[str, str]]]]:
    """Poll a flow run until it has ended.

    Yields:
        Its state, its finished shards in percent, 0 to 100, and the rows of its artifacts by key:
        `progress`, and at the end `summary`.
    """
    of_run = ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run]))
    while True:
        state = client.read_flow_run(run).state or Pending()
        artifacts = client.read_artifacts(artifact_filter=of_run)
        percent = 0.0
        tables: dict[str, Mapping[str, str]] = {}
        for artifact in sorted(artifacts, key=lambda artifact: str(artifact.updated)):
            data: Any = artifact.data
            if artifact.type == "progress":
                percent = float(str(data))
            elif artifact.type == "table" and artifact.key:
                rows = json.loads(data) if isinstance(data, str) else data or []
                tables[artifact.key] = {
                    str(row["what"]): str(row["value"])
                    for row in rows
                    if {"what", "value"} <= set(row)  # others are not ours
                }
        yield state, percent, tables
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
