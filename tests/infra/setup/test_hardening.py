"""The files of containers keep the rules, and pools let nobody choose what runs."""

import asyncio
import json
import uuid
from typing import Any

import pytest
import yaml
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.schema_tools import ValidationError, validate

from tests.conftest import ROOT
from tests.for_each import case
from tests.infra.setup.manifests_kit import IMAGES, MANIFESTS, containers, documents, job_template

USER = {"runAsNonRoot": True, "runAsUser": 10001, "seccompProfile": {"type": "RuntimeDefault"}}
CONFINED = {
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
}
CLOSED = {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}


@pytest.fixture(scope="module")
def services() -> Any:
    return yaml.safe_load((IMAGES / "compose.yaml").read_text())["services"]


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [row for row in documents() if row["kind"] == kind]


def test_containers_of_manifests_are_confined() -> None:
    serving = {row["metadata"]["name"] for row in of_kind("Deployment")}
    for name, pod, container in containers():
        with case(name):
            assert pod["securityContext"].items() >= USER.items()
            assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod)
            assert not any("hostPath" in volume for volume in pod["volumes"])
            assert container["securityContext"] == CONFINED
            for kind in ("requests", "limits"):
                assert set(container["resources"][kind]) >= {"cpu", "memory"}, kind
            assert "livenessProbe" in container or name not in serving


def test_the_namespace_is_bounded_and_closed() -> None:
    (quota,) = (row["spec"]["hard"] for row in of_kind("ResourceQuota"))
    assert {"limits.cpu", "limits.memory", "pods"} <= set(quota)
    policies = [row["spec"] for row in of_kind("NetworkPolicy")]
    assert CLOSED in policies
    for policy in policies:
        for rule in (*policy.get("ingress", ()), *policy.get("egress", ())):
            assert rule.get("ports"), "a rule of the network names its ports"


def test_services_are_confined(services: Any) -> None:
    for name, service in services.items():
        with case(name):
            assert service["cap_drop"] == ["ALL"] and service["read_only"]
            assert service["security_opt"] == ["no-new-privileges:true"]
            assert not {"privileged", "network_mode", "pid"} & set(service)
            assert not any("docker.sock" in volume for volume in service.get("volumes", ()))


def test_images_of_others_have_a_digest(services: Any) -> None:
    """Of each FROM that names no stage before it, and of services."""
    named = {row["image"] for row in services.values() if "trilight" not in row["image"]}
    for path in IMAGES.glob("*.Dockerfile"):
        lines = [line.split() for line in path.read_text().splitlines() if line[:5] == "FROM "]
        named |= {words[1] for words in lines} - {words[-1] for words in lines if "AS" in words}
    assert len(named) > 2 and [image for image in named if "@sha256:" not in image] == []


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


def test_prefects_worker_starts_the_container_of_the_manifests() -> None:
    job = json.loads(_prepared("kubernetes", _template("kubernetes"), {}))["job_manifest"]
    (container,) = job["spec"]["template"]["spec"]["containers"]
    ours = containers()[-1][2]
    kept = ("image", "imagePullPolicy", "envFrom", "workingDir", "resources", "volumeMounts")
    assert {name: container[name] for name in kept} == {name: ours[name] for name in kept}
    assert container["args"] == ["prefect", "flow-run", "execute"]
    assert {"name": "HOME", "value": "/tmp"} in container["env"]


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
