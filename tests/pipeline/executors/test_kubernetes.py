"""An indexed Job of Kubernetes: what falls to a task, and its manifest by the schema."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors import array_job as arrays
from pipeline.executors.array_job import ArrayJob
from pipeline.executors.kubernetes import PLACE, shards_of_place
from pipeline.executors.kubernetes_array import KubernetesOptions, job_manifest
from pipeline.executors.registry import find_executor
from pipeline.generation.generate_options import GenerateOptions
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.generation.tiny_scenes_kit import tiny_order

GIVEN = {"TASKS": "0-1,7", "SHARDS_PER_TASK": "4"}


def test_a_place_is_a_task_that_is_missing() -> None:
    shares = [shards_of_place({**GIVEN, PLACE: str(place)}) for place in range(3)]
    assert shares == ["0:4", "4:8", "28:32"]


@for_each(
    ("environment", "message"),
    [
        ({}, "TASKS is not set; expected .* as trilight submit kubernetes makes it"),
        (GIVEN, f"{PLACE} is not set"),
        ({**GIVEN, PLACE: "3"}, f"{PLACE} is 3; expected a place below 3"),
        ({**GIVEN, PLACE: "\N{SUPERSCRIPT TWO}"}, "expected a number from 0"),
        ({**GIVEN, PLACE: "0", "SHARDS_PER_TASK": "0"}, "SHARDS_PER_TASK is '0'; .* from 1"),
        ({**GIVEN, PLACE: "0", "TASKS": "0,,2"}, "TASKS is '0,,2'; expected numbers of tasks"),
        ({**GIVEN, PLACE: "0", "TASKS": "0-999999999"}, "at most 100000"),
    ],
)
def test_what_is_no_array_is_named(environment: dict[str, str], message: str) -> None:
    with pytest.raises(TrilightError, match=f"--runner kubernetes: .*{message}"):
        shards_of_place(environment)


def test_a_range_of_ones_own_is_refused(tmp_path: Path) -> None:
    order = tiny_order(out=str(tmp_path), scenes=20, shards="0:2")
    with pytest.raises(TrilightError, match="--shards is 0:2; expected none with"):
        find_executor("kubernetes", None, None).make(order, None)


IMAGE = "registry.example/trilight@sha256:1"
MISSING = [0, 1, 5, 8]
"""Shards, two to a task: tasks 0, 2 and 4."""
Made = Callable[..., dict[str, Any]]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    """Make the manifest of an array of MISSING in a bucket, or of other shards."""

    def make(missing: list[int] = MISSING, **options: Any) -> dict[str, Any]:
        monkeypatch.setattr(arrays, "_is_begun", lambda place: True)
        monkeypatch.setattr(arrays, "missing_shards", lambda place, scenes: missing)
        order = GenerateOptions(
            build="smoke", scenes=64, out="s3://sets/mine", objects="builtin:", seed=7
        )
        job = arrays.array_job(order, per_task=2, at_once=None, on="kubernetes")
        return job_manifest(job, KubernetesOptions(**{"image": IMAGE, **options}))

    return make


def test_every_place_makes_what_is_missing_and_nothing_else(made: Made) -> None:
    manifest = made()
    spec = manifest["spec"]
    (container,) = spec["template"]["spec"]["containers"]
    environment = {row["name"]: row["value"] for row in container["env"]}
    places = range(spec["completions"])
    shares = [shards_of_place({**environment, PLACE: str(place)}) for place in places]
    assert shares == ["0:2", "4:6", "8:10"]
    assert container["command"] == [
        *("trilight", "generate", "smoke", "--objects", "builtin:", "--scenes", "64"),
        *("--seed", "7", "--out", "s3://sets/mine", "--runner", "kubernetes"),
    ]
    assert environment["TRILIGHT_CORES"] == "8" and environment["HOME"] == "/tmp"
    assert made() == manifest
    assert made([0])["metadata"]["name"] != manifest["metadata"]["name"]


def test_kubernetes_takes_the_job(made: Made) -> None:
    schemas = pytest.importorskip("kubernetes_validate", reason="make setup-all")
    manifest = made(account="trilight-flow", machine_type="c7i.2xlarge", tries=4)
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
    pod = made()["spec"]["template"]["spec"]
    (ours,), (other,) = pod["containers"], theirs["containers"]
    assert pod["securityContext"] == theirs["securityContext"]
    for name in ("securityContext", "resources", "envFrom", "imagePullPolicy"):
        assert ours[name] == other[name], name
    assert {mount["mountPath"] for mount in ours["volumeMounts"]} == {
        mount["mountPath"] for mount in other["volumeMounts"]
    }
    assert not pod["automountServiceAccountToken"]


def test_an_image_is_needed(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRILIGHT_IMAGE", raising=False)
    with pytest.raises(TrilightError, match="submit kubernetes: --image is not given"):
        made(image=None)


@for_each(
    ("asked", "message"),
    [
        ({"out": "data/mine"}, "--out is data/mine; expected a bucket"),
        ({"objects": "chairs"}, "--objects is chairs, a folder of this machine"),
        ({"objects": "builtin:", "skies": "file:///skies"}, "--skies is file:///skies, a folder"),
        ({"build": "mine.py:sunsets"}, "mine.py:sunsets, a file of this machine"),
    ],
)
def test_files_of_this_machine_are_refused(asked: dict[str, str], message: str) -> None:
    given: dict[str, Any] = {"scenes": 8, "out": "gs://sets/mine", **asked}
    order = GenerateOptions(**given | {"build": "smoke"})
    object.__setattr__(order, "build", asked.get("build", "smoke"))  # --extend has loaded it
    job = ArrayJob(options=order, tasks=[0], per_task=1, at_once=1)
    with pytest.raises(TrilightError, match=f"submit kubernetes: .*{message}"):
        job_manifest(job, KubernetesOptions(image=IMAGE))
