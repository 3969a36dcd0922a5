"""Pools: who may start a run, or make a deployment, chooses nothing of what runs it."""

import asyncio
import json
import uuid
from typing import Any

import pytest
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.schema_tools import ValidationError, validate

from tests.conftest import ROOT
from tests.infra.setup.manifests_kit import IMAGES, MANIFESTS, containers, job_template

TEMPLATES = {
    "process": ROOT / "infra" / "serving" / "pool.json",
    "docker": IMAGES / "pool.json",
    "kubernetes": MANIFESTS / "pool.yaml",
}
WISHES: dict[str, Any] = {
    "command": "/usr/bin/touch EVIL", "image": "EVIL", "env": {"LD_PRELOAD": "EVIL"},
    "env.LD_PRELOAD": "EVIL", "working_dir": "/EVIL", "service_account_name": "EVIL",
    "namespace": "EVIL", "name": "EVIL", "labels": {"EVIL": "EVIL"}, "volumes": ["/:/EVIL"],
    "privileged": True, "network_mode": "EVIL", "job_manifest": {"EVIL": 1},
    "cluster_config": {"EVIL": 1}, "container_create_kwargs": {"privileged": True},
}  # fmt: skip
"""What somebody who starts a run, or makes a deployment, may ask of the machine that runs it."""


def _template(kind: str) -> Any:
    return job_template() if kind == "kubernetes" else json.loads(TEMPLATES[kind].read_text())


@pytest.mark.parametrize("kind", TEMPLATES)
def test_pools_let_nobody_choose_what_runs(kind: str) -> None:
    """The server refuses what is asked for, and a worker that got it all the same ignores it."""
    template = _template(kind)
    schema = template["variables"]
    assert (schema["properties"], schema["additionalProperties"]) == ({}, False)
    for name, value in WISHES.items():
        with pytest.raises(ValidationError, match="Additional properties are not allowed"):
            validate({name: value}, schema, raise_on_error=True, preprocess=True)
    assert "{{" not in json.dumps(template)
    plain, asked = (_prepared(kind, template, values) for values in ({}, WISHES))
    assert asked == plain and "EVIL" not in asked


def _prepared(kind: str, template: Any, values: dict[str, Any]) -> str:
    """Return the job that a worker makes of a pool's template and of what it was asked for."""
    module = {
        "process": "prefect.workers.process",
        "docker": "prefect_docker.worker",
        "kubernetes": "prefect_kubernetes.worker",
    }[kind]
    worker = pytest.importorskip(module, reason="make setup-all")
    names = {"process": "Process", "docker": "DockerWorker", "kubernetes": "KubernetesWorker"}
    configuration = getattr(worker, f"{names[kind]}JobConfiguration")
    made = asyncio.run(configuration.from_template_and_values(template, values, client=None))
    made.prepare_for_flow_run(FlowRun(id=uuid.UUID(int=1), flow_id=uuid.UUID(int=2), name="x"))
    return str(made.model_dump_json())


def test_prefect_takes_thejob_template() -> None:
    """Its worker makes a job of it for each flow run, and refuses one that lacks anything."""
    worker = pytest.importorskip("prefect_kubernetes.worker", reason="make setup-all")
    kind = worker.KubernetesWorkerJobConfiguration
    made = asyncio.run(kind.from_template_and_values(job_template(), {}, client=None))
    made.prepare_for_flow_run(FlowRun(flow_id=uuid.uuid4(), name="x"))
    (container,) = made.job_manifest["spec"]["template"]["spec"]["containers"]
    ours = containers()[-1][2]
    kept = ("image", "imagePullPolicy", "envFrom", "workingDir", "resources", "volumeMounts")
    assert {name: container[name] for name in kept} == {name: ours[name] for name in kept}
    assert container["args"] == ["prefect", "flow-run", "execute"]
    assert {"name": "HOME", "value": "/tmp"} in container["env"]
    assert made.job_manifest["metadata"]["generateName"] == "x-"
