"""The deployments of prefect.yaml, with the pool and the limits that they need, at a server.

    python -m infra.serving.deployments NAME TEMPLATE

makes the pool NAME as the file TEMPLATE says, the limits of flows (infra.serving.limits), and each
deployment of that name; what is there already is replaced, and keeps its schedules. The server is
the one that Prefect's settings name. Prefect's own commands do the same in three processes, where
`prefect deploy` executes a flow's file anew for each deployment: 19 processor seconds and not 4.
"""

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from infra.serving.limits import limits
from pipeline.flows.prefect_server import load_prefect, prefect_client
from storage.errors import TrilightError
from storage.installation import FILES_ROOT

_KINDS = {"local": "process"}
"""Kinds of workers, by pools that are not named after theirs."""


def deploy(name: str, template: Path) -> None:
    """Make the pool, the limits and the deployments of a name.

    Raises:
        TrilightError: the server refuses or does not answer, or TRILIGHT_CARDS is no number.
    """
    slots = limits(os.environ)
    load_prefect()
    from prefect.client.schemas.actions import WorkPoolCreate

    pool = WorkPoolCreate(
        name=name,
        type=_KINDS.get(name, name),
        base_job_template=json.loads(template.read_text()),
    )
    with prefect_client() as client:
        client.create_work_pool(pool, overwrite=True)
        for limit, number in slots.items():
            client.upsert_global_concurrency_limit_by_name(limit, number)
        for row in read_deployments():
            if row["name"] == name:
                _deploy_flow(row)


def read_deployments() -> list[dict[str, Any]]:
    """Return the rows of prefect.yaml."""
    import yaml

    rows: list[dict[str, Any]] = yaml.safe_load((FILES_ROOT / "prefect.yaml").read_text())[
        "deployments"
    ]
    return rows


def _deploy_flow(row: dict[str, Any]) -> None:
    from prefect.deployments.runner import RunnerDeployment
    from prefect.runner.storage import LocalStorage
    from prefect.utilities.templating import apply_values

    file, function = row["entrypoint"].split(":")
    flow = getattr(importlib.import_module(file.removesuffix(".py").replace("/", ".")), function)
    ((_, folder),) = apply_values(row["pull"], dict(os.environ))[0].items()
    options = {key: row.get(key) for key in ("description", "tags", "parameters")}
    deployment: RunnerDeployment = flow.to_deployment(
        row["name"],
        work_pool_name=row["work_pool"]["name"],
        concurrency_limit=row.get("concurrency_limit"),
        **options,
    )
    deployment.storage = LocalStorage(folder["directory"])
    deployment.entrypoint = row["entrypoint"]
    deployment.apply()


if __name__ == "__main__":
    try:
        deploy(sys.argv[1], Path(sys.argv[2]))
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")
