"""The files of containers keep the rules, and each rule finds the file that breaks it."""

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
import yaml

from tests.for_each import case
from tests.infra.setup.hardening_rules import (
    faults_of_manifests,
    faults_of_services,
    unpinned_images,
)
from tests.infra.setup.manifests_kit import IMAGES, documents, job_template


@pytest.fixture(scope="module")
def compose() -> Any:
    return yaml.safe_load((IMAGES / "compose.yaml").read_text())


def _pod(rows: list[dict[str, Any]], name: str) -> Any:
    (row,) = (
        row for row in rows if row["metadata"]["name"] == name and row["kind"] in "Deployment Job"
    )
    return row["spec"]["template"]["spec"]


def _worker(rows: Any) -> Any:
    return _pod(rows, "trilight-worker")["containers"][0]


def _without(kind: str) -> Callable[[Any], None]:
    def change(rows: Any) -> None:
        rows[:] = [row for row in rows if row["kind"] != kind]

    return change


BROKEN_MANIFESTS: dict[str, Callable[[Any], Any]] = {
    "may be root": lambda rows: _pod(rows, "trilight-deploy")["securityContext"].pop("runAsUser"),
    "no seccomp profile": lambda rows: _pod(rows, "trilight-worker")["securityContext"].update(
        seccompProfile={"type": "Unconfined"}
    ),
    "keeps capabilities": lambda rows: _worker(rows)["securityContext"].pop("capabilities"),
    "may gain privileges": lambda rows: _worker(rows)["securityContext"].pop(
        "allowPrivilegeEscalation"
    ),
    "writes to its image": lambda rows: _worker(rows)["securityContext"].update(
        readOnlyRootFilesystem=False
    ),
    "no limits": lambda rows: _worker(rows)["resources"]["limits"].pop("memory"),
    "nothing asks": lambda rows: _worker(rows).pop("livenessProbe"),
    "host's namespaces": lambda rows: _pod(rows, "prefect-server").update(hostNetwork=True),
    "host's files": lambda rows: _pod(rows, "prefect-server")["volumes"].append(
        {"name": "x", "hostPath": {"path": "/"}}
    ),
    "no quota": _without("ResourceQuota"),
    "open to the network": _without("NetworkPolicy"),
}

BROKEN_SERVICES: dict[str, Callable[[Any], Any]] = {
    "store: keeps capabilities": lambda row: row["store"].pop("cap_drop"),
    "database: writes to its image": lambda row: row["database"].pop("read_only"),
    "worker: may gain privileges": lambda row: row["worker"].pop("security_opt"),
    "server: no seccomp profile": lambda row: row["server"]["security_opt"].append(
        "seccomp:unconfined"
    ),
    "worker: holds the socket": lambda row: row["worker"]["volumes"].append("/run/docker.sock:/x"),
    "server: shares the host": lambda row: row["server"].update(network_mode="host"),
}


def test_manifests_and_services_keep_the_rules(compose: Any) -> None:
    assert list(faults_of_manifests(documents(), job_template())) == []
    assert list(faults_of_services(compose)) == []


def test_a_broken_manifest_is_found() -> None:
    for fault in BROKEN_MANIFESTS:
        with case(fault):
            rows = copy.deepcopy(documents())
            BROKEN_MANIFESTS[fault](rows)
            assert any(fault in said for said in faults_of_manifests(rows, job_template()))


def test_a_broken_job_template_is_found() -> None:
    broken = json.loads(json.dumps(job_template()).replace("RuntimeDefault", "Unconfined"))
    said = list(faults_of_manifests(documents(), broken))
    assert said == ["job template: no seccomp profile"]


def test_a_broken_service_is_found(compose: Any) -> None:
    for fault in BROKEN_SERVICES:
        with case(fault):
            broken = copy.deepcopy(compose)
            BROKEN_SERVICES[fault](broken["services"])
            assert any(said.startswith(fault) for said in faults_of_services(broken))


def test_images_of_others_have_a_digest(compose: Any) -> None:
    texts = {path.name: path.read_text() for path in IMAGES.glob("*.Dockerfile")}
    assert unpinned_images(texts, compose) == set()
    mutated = {**texts, "x": "FROM debian:13 AS build\nFROM build\nFROM a@sha256:0 AS b"}
    assert unpinned_images(mutated, compose) == {"debian:13"}
