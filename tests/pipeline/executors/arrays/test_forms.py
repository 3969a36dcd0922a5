"""Files of an array as schedulers take them, by their schemas where these are installed.

Google's and SkyPilot's are not.
"""

import json
import shlex
from collections.abc import Callable
from typing import Any

import pytest
import yaml

from pipeline.executors.array_task import shards_of_place
from pipeline.executors.arrays import job as arrays
from pipeline.executors.arrays.form import ArrayForm
from pipeline.executors.arrays.forms import FORMS
from pipeline.executors.arrays.job import ArrayJob
from pipeline.executors.arrays.machines import ArrayMachines
from pipeline.executors.registry import EXECUTORS, INDEX_VARIABLES
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from tests.for_each import for_each

IMAGE = "registry.example/trilight@sha256:1"
WHERE = {"aws-batch": "spot-queue", "google-batch": "us-central1", "sky": "aws"}
AT_ONCE = {"google-batch": 2, "sky": 2}
MISSING = [0, 1, 5, 8]
"""Shards, two to a task: tasks 0, 2 and 4."""
Made = Callable[..., tuple[ArrayJob, ArrayForm]]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    """Make the form of an array of MISSING in a bucket, or of other shards."""

    def make(
        on: str, missing: list[int] = MISSING, at_once: int | None = None, **machines: Any
    ) -> tuple[ArrayJob, ArrayForm]:
        monkeypatch.setattr(arrays, "_is_begun", lambda place: True)
        monkeypatch.setattr(arrays, "missing_shards", lambda place: missing)
        order = DatasetOrder(
            build="smoke", scenes=64, out="s3://sets/mine", objects="builtin:", seed=7
        )
        at_once = at_once or AT_ONCE.get(on)
        job = arrays.array_job(order, per_task=2, at_once=at_once, on=on)
        given = {"image": IMAGE, "where": WHERE.get(on), **machines}
        return job, FORMS[on](job, ArrayMachines(**given))

    return make


def _container(on: str, form: ArrayForm) -> tuple[list[str], dict[str, str], int]:
    """Return command, environment and number of the tasks."""
    if on == "kubernetes":
        spec = yaml.safe_load(form.files["job.yaml"])["spec"]
        (container,) = spec["template"]["spec"]["containers"]
        given = {row["name"]: row["value"] for row in container["env"]}
        return container["command"], given, spec["completions"]
    if on == "aws-batch":
        container = json.loads(form.files["definition.json"])["containerProperties"]
        given = {row["name"]: row["value"] for row in container["environment"]}
        job = json.loads(form.files["job.json"])
        return container["command"], given, job.get("arrayProperties", {"size": 1})["size"]
    if on == "google-batch":
        (group,) = json.loads(form.files["job.json"])["taskGroups"]
        (runnable,) = group["taskSpec"]["runnables"]
        variables = group["taskSpec"]["environment"]["variables"]
        return runnable["container"]["commands"], variables, int(group["taskCount"])
    words = shlex.split(yaml.safe_load(form.files["job.yaml"])["run"])
    at, options = words.index(IMAGE), [word for word in words if "=" in word]
    (launch,) = (words for words in form.commands if "launch" in words)
    number = int(launch[launch.index("--num-jobs") + 1])
    return words[at + 1 :], dict(option.split("=", 1) for option in options), number


@for_each("on", FORMS)
def test_every_place_makes_what_is_missing_and_nothing_else(made: Made, on: str) -> None:
    assert FORMS.keys() == INDEX_VARIABLES.keys()
    _, form = made(on)
    words, environment, number = _container(on, form)
    shares = [
        shards_of_place({**environment, INDEX_VARIABLES[on]: str(place)}, on)
        for place in range(number)
    ]
    assert shares == ["0:2", "4:6", "8:10"]
    assert words == [
        *("trilight", "generate", "smoke", "--objects", "builtin:", "--scenes", "64"),
        *("--seed", "7", "--out", "s3://sets/mine", "--runner", on),
    ]
    assert on in EXECUTORS
    assert environment["TRILIGHT_CORES"] == "8" and environment["HOME"] == "/tmp"
    assert made(on)[1] == form
    assert made(on, [0])[1].name != form.name
    words, environment, number = _container(on, made(on, [5])[1])
    assert (number, shards_of_place(environment, on)) == (1, "4:6")


def test_kubernetes_takes_the_job(made: Made) -> None:
    schemas = pytest.importorskip("kubernetes_validate", reason="make setup-all")
    _, form = made("kubernetes", account="trilight-flow", machine_type="c7i.2xlarge", tries=4)
    manifest = yaml.safe_load(form.files["job.yaml"])
    schemas.validate(manifest, "1.37", strict=True)
    spec = manifest["spec"]
    # what Kubernetes demands beside its schema of indices that are tried again one by one
    assert spec["completionMode"] == "Indexed" and spec["backoffLimitPerIndex"] == 3
    assert spec["parallelism"] == spec["completions"] == 3
    pod = spec["template"]["spec"]
    assert pod["restartPolicy"] == "Never"
    (container,) = pod["containers"]
    rules = spec["podFailurePolicy"]["rules"]
    assert [rule["action"] for rule in rules] == ["Ignore", "FailIndex"]
    assert rules[1]["onExitCodes"]["containerName"] == container["name"]
    assert manifest["metadata"]["namespace"] == "trilight"


def test_the_pod_has_the_rights_of_the_other_manifests(made: Made) -> None:
    from tests.infra.setup.manifests_kit import job_template

    manifest = job_template()["job_configuration"]["job_manifest"]
    theirs = manifest["spec"]["template"]["spec"]
    _, form = made("kubernetes")
    pod = yaml.safe_load(form.files["job.yaml"])["spec"]["template"]["spec"]
    (ours,), (other,) = pod["containers"], theirs["containers"]
    assert pod["securityContext"] == theirs["securityContext"]
    for name in ("securityContext", "resources", "envFrom", "imagePullPolicy"):
        assert ours[name] == other[name], name
    assert {mount["mountPath"] for mount in ours["volumeMounts"]} == {
        mount["mountPath"] for mount in other["volumeMounts"]
    }
    assert not pod["automountServiceAccountToken"]


@for_each("missing", [MISSING, [3]])
def test_aws_takes_definition_and_job(made: Made, missing: list[int]) -> None:
    session = pytest.importorskip("botocore.session", reason="make setup-all")
    validate = pytest.importorskip("botocore.validate", reason="make setup-all")
    service = session.get_session().get_service_model("batch")
    _, form = made("aws-batch", missing, account="arn:aws:iam::123456789012:role/r")
    for action, name in (("RegisterJobDefinition", "definition"), ("SubmitJob", "job")):
        shape = service.operation_model(action).input_shape
        asked = json.loads(form.files[f"{name}.json"])
        assert validate.ParamValidator().validate(asked, shape).generate_report() == ""
    definition = json.loads(form.files["definition.json"])
    assert asked["jobDefinition"] == definition["jobDefinitionName"]
    assert asked.get("arrayProperties", {}).get("size") != 1  # refused: 2 to 10,000
    names = [row["name"] for row in definition["containerProperties"]["environment"]]
    assert not [name for name in names if name.startswith("AWS_BATCH")]  # refused as well


def test_google_takes_the_job(made: Made) -> None:
    _, form = made("google-batch", machine_type="c3-standard-8", on_demand=True)
    config = json.loads(form.files["job.json"])
    (group,) = config["taskGroups"]
    assert int(group["parallelism"]) == 2 <= int(group["taskCount"])
    assert 0 <= group["taskSpec"]["maxRetryCount"] <= 10
    assert group["taskSpec"]["maxRunDuration"] == "43200s"
    (instance,) = config["allocationPolicy"]["instances"]
    assert instance["policy"]["provisioningModel"] == "STANDARD"
    assert form.name.islower() and len(form.name) <= 63 and form.name[0].isalpha()


def test_sky_takes_pool_and_job(made: Made) -> None:
    _, form = made("sky")
    pool, job = (yaml.safe_load(form.files[f"{name}.yaml"]) for name in ("pool", "job"))
    assert pool["pool"] == {"workers": 2} and "run" not in pool  # refused in a pool
    assert not {"setup", "workdir", "file_mounts"} & job.keys()  # refused in a job of a pool
    assert job["resources"].items() >= pool["resources"].items()
    assert pool["resources"]["use_spot"] is True
    assert form.afterwards == [["sky", "jobs", "pool", "down", "--yes", form.name]]


@for_each(
    ("on", "machines", "message"),
    [
        ("kubernetes", {"image": None}, "--image is not given"),
        ("kubernetes", {"on_demand": True}, "--on-demand is True; expected it left out"),
        ("aws-batch", {"where": None}, "--where is not given; expected the name of a job queue"),
        ("aws-batch", {"at_once": 3}, "--at-once is 3; expected it left out"),
        ("aws-batch", {"machine_type": "c7i.large"}, "--machine-type is c7i.large"),
        ("google-batch", {"where": None}, "--where is not given; expected a location"),
        ("sky", {"account": "a"}, "--account is a; expected it left out"),
    ],
)
def test_what_a_scheduler_lacks_is_named(
    made: Made, on: str, machines: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TRILIGHT_IMAGE", raising=False)
    with pytest.raises(TrilightError, match=f"submit {on}: {message}"):
        made(on, **machines)


@for_each(
    ("asked", "message"),
    [
        ({"out": "data/mine"}, "--out is data/mine; expected a bucket"),
        ({"objects": "chairs"}, "--objects is chairs, a folder of this machine"),
        ({"objects": "builtin:", "skies": "file:///skies"}, "--skies is file:///skies, a folder"),
    ],
)
@for_each("on", FORMS)
def test_files_of_this_machine_are_refused(on: str, asked: dict[str, str], message: str) -> None:
    given: dict[str, Any] = {"scenes": 8, "out": "gs://sets/mine", **asked}
    order = DatasetOrder(**given)
    job = ArrayJob(order=order, tasks=[0], per_task=1, at_once=1)
    with pytest.raises(TrilightError, match=f"submit {on}: .*{message}"):
        FORMS[on](job, ArrayMachines(image=IMAGE, where="x"))


def test_a_build_of_ones_own_file_is_refused() -> None:
    order = DatasetOrder(out="gs://sets/mine")
    object.__setattr__(order, "build", "mine.py:sunsets")  # as where --extend has loaded it
    job = ArrayJob(order=order, tasks=[0], per_task=1, at_once=1)
    with pytest.raises(TrilightError, match="mine.py:sunsets, a file of this machine"):
        FORMS["kubernetes"](job, ArrayMachines(image=IMAGE))
