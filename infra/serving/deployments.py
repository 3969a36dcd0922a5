"""The deployments of prefect.yaml, with the pool and the limits that they need, at a server.

    python -m infra.serving.deployments NAME TEMPLATE

makes the pool NAME as the file TEMPLATE says, the limits of flows, and each deployment of that
name; what is there already is replaced, and keeps its schedules. The server is the one that
Prefect's settings name. A flow takes a slot of a limit while it writes documents, and while it uses
a GPU; a limit that does not exist limits nothing, so the limits come first. Prefect's own commands
do the same in three processes, where `prefect deploy` executes a flow's file anew for each
deployment: 19 processor seconds and not 4.
"""

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from pipeline.flows.prefect_server import DISK_LIMIT, GPU_LIMIT, load_prefect, prefect_client
from pipeline.renders.mitsuba_variant import visible_gpus
from storage.errors import TrilightError
from storage.installation import FILES_ROOT

_KINDS = {"local": "process"}
"""Kinds of workers, by pools that are not named after theirs."""

_DISK_SLOTS = 2
"""Number of runs that may write documents at the same time: each reads its whole dataset."""

_MOST_CARDS = 100_000


def deploy(name: str, template: Path) -> None:
    """Make the pool, the limits and the deployments of a name.

    Raises:
        TrilightError: the server refuses or does not answer, or TRILIGHT_CARDS is no number.
    """
    slots = limits()
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

    return list(yaml.safe_load((FILES_ROOT / "prefect.yaml").read_text())["deployments"])


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


def limits() -> dict[str, int]:
    """Return the number of slots by limit, at least 1: a limit of 0 would block every flow.

    The variable TRILIGHT_CARDS is the number of GPUs of all workers, if these have others than this
    machine.

    Raises:
        TrilightError: TRILIGHT_CARDS is no number of GPUs.
    """
    cards = whole_number("TRILIGHT_CARDS", len(visible_gpus()) or 1, _MOST_CARDS)
    return {DISK_LIMIT: _DISK_SLOTS, GPU_LIMIT: cards}


def whole_number(name: str, default: int, most: int) -> int:
    """Return the number of an environment variable; raises TrilightError for other text."""
    text = os.environ.get(name, str(default))
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= most:
        raise TrilightError(f"{name} is {text!r}; expected a whole number from 1 to {most}.")
    return int(text)


if __name__ == "__main__":
    try:
        deploy(sys.argv[1], Path(sys.argv[2]))
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")
