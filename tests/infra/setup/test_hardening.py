"""The files of containers keep the rules, and pools let nobody choose what runs."""

import asyncio
import json
import uuid
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
import yaml
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.schema_tools import ValidationError, validate

from tests.conftest import ROOT
from tests.infra.setup.manifests_kit import IMAGES, MANIFESTS, containers, documents, job_template

_SERVES = {"Deployment"}


def faults_of_manifests(documents: list[dict[str, Any]], job: Mapping[str, Any]) -> Iterator[str]:
    """Say what is missing in manifests of Kubernetes, and in the template of the flows' job."""
    for row in documents:
        if row["kind"] in ("Deployment", "Job"):
            pod = row["spec"]["template"]["spec"]
            yield from _faults_of_pod(row["metadata"]["name"], pod, row["kind"] in _SERVES)
    pod = job["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    yield from _faults_of_pod("job template", pod, serves=False)
    yield from _faults_of_namespace(documents)


def _faults_of_pod(name: str, pod: Mapping[str, Any], serves: bool) -> Iterator[str]:
    mine = pod.get("securityContext", {})
    if not mine.get("runAsNonRoot") or not mine.get("runAsUser"):
        yield f"{name}: may be root"
    if mine.get("seccompProfile") != {"type": "RuntimeDefault"}:
        yield f"{name}: no seccomp profile"
    if any(pod.get(key) for key in ("hostNetwork", "hostPID", "hostIPC")):
        yield f"{name}: shares the host's namespaces"
    if any("hostPath" in volume for volume in pod.get("volumes", ())):
        yield f"{name}: mounts the host's files"
    for container in pod["containers"]:
        given = container.get("securityContext", {})
        if given.get("capabilities") != {"drop": ["ALL"]} or given.get("privileged"):
            yield f"{name}: keeps capabilities"
        if given.get("allowPrivilegeEscalation") is not False:
            yield f"{name}: may gain privileges"
        if not given.get("readOnlyRootFilesystem"):
            yield f"{name}: writes to its image"
        for kind in ("requests", "limits"):
            if set(container.get("resources", {}).get(kind, ())) < {"cpu", "memory"}:
                yield f"{name}: no {kind}"
        if serves and "livenessProbe" not in container:
            yield f"{name}: nothing asks whether it lives"


def _faults_of_namespace(documents: list[dict[str, Any]]) -> Iterator[str]:
    hard = [row["spec"]["hard"] for row in documents if row["kind"] == "ResourceQuota"]
    if not hard or not {"limits.cpu", "limits.memory", "pods"} <= set(hard[0]):
        yield "namespace: no quota"
    policies = [row["spec"] for row in documents if row["kind"] == "NetworkPolicy"]
    closed = {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    if closed not in policies:
        yield "namespace: open to the network by default"
    for policy in policies:
        for rule in (*policy.get("ingress", ()), *policy.get("egress", ())):
            if not rule.get("ports"):
                yield "namespace: a rule of the network names no port"


def faults_of_services(compose: Mapping[str, Any]) -> Iterator[str]:
    """Say what is missing in services of a compose file."""
    for name, service in compose["services"].items():
        if service.get("cap_drop") != ["ALL"] or service.get("privileged"):
            yield f"{name}: keeps capabilities"
        if not service.get("read_only"):
            yield f"{name}: writes to its image"
        options = service.get("security_opt", ())
        if "no-new-privileges:true" not in options:
            yield f"{name}: may gain privileges"
        if any("unconfined" in option for option in options):
            yield f"{name}: no seccomp profile"
        if any("docker.sock" in volume for volume in service.get("volumes", ())):
            yield f"{name}: holds the socket of Docker"
        if service.get("network_mode") == "host" or service.get("pid") == "host":
            yield f"{name}: shares the host's namespaces"


def unpinned_images(texts: Mapping[str, str], compose: Mapping[str, Any]) -> set[str]:
    """Return the foreign images without a digest: of each FROM, and of services."""
    named: set[str] = set()
    for text in texts.values():
        lines = [line.split() for line in text.splitlines() if line.startswith("FROM ")]
        stages = {words[-1] for words in lines if "AS" in words}
        named |= {words[1] for words in lines if words[1] not in stages}
    named |= {
        row["image"] for row in compose["services"].values() if "trilight" not in row["image"]
    }
    return {image for image in named if "@sha256:" not in image}


@pytest.fixture(scope="module")
def compose() -> Any:
    return yaml.safe_load((IMAGES / "compose.yaml").read_text())


def test_manifests_and_services_keep_the_rules(compose: Any) -> None:
    assert list(faults_of_manifests(documents(), job_template())) == []
    assert list(faults_of_services(compose)) == []


def test_images_of_others_have_a_digest(compose: Any) -> None:
    texts = {path.name: path.read_text() for path in IMAGES.glob("*.Dockerfile")}
    assert unpinned_images(texts, compose) == set()
    mutated = {**texts, "x": "FROM debian:13 AS build\nFROM build\nFROM a@sha256:0 AS b"}
    assert unpinned_images(mutated, compose) == {"debian:13"}


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
