"""What the manifests of Kubernetes say, for tests."""

import json
from typing import Any

import yaml

from tests.conftest import ROOT

IMAGES, MANIFESTS = ROOT / "infra" / "images", ROOT / "infra" / "kubernetes"


def documents() -> list[dict[str, Any]]:
    files = sorted(MANIFESTS.glob("*.yaml"))
    return [row for path in files for row in yaml.safe_load_all(path.read_text())]


def containers() -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Return name, pod and container of everything that runs, the flows' jobs last."""
    found = [
        (row["metadata"]["name"], pod, container)
        for row in documents()
        if row["kind"] in ("Deployment", "Job")
        for pod in [row["spec"]["template"]["spec"]]
        for container in pod["containers"]
    ]
    pod = job_template()["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    return [*found, ("job template", pod, pod["containers"][0])]


def job_template() -> Any:
    row = next(row for row in documents() if row["kind"] == "ConfigMap")
    return json.loads(row["data"]["job.json"])
