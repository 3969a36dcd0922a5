"""Executors are peers; arrays by the variables and the schema of their schedulers; `submit`."""

import contextlib
import dataclasses
import os
import shlex
import subprocess
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pipeline.executors import slurm_and_kubernetes as arrays
from pipeline.executors.registry import EXECUTORS, find_executor
from pipeline.executors.slurm_and_kubernetes import (
    MAX_TASKS,
    ArrayJob,
    KubernetesOptions,
    array_job,
    job_manifest,
    submit_slurm_array,
)
from pipeline.executors.threads import PLACE, shards_of_place, shards_of_task
from pipeline.generation.generate_options import GenerateOptions
from storage.dataset.dataset import open_dataset
from storage.dataset.progress import missing_shards
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.number_ranges import number_ranges, numbers_of
from tests.command_line import expect_json, trilight
from tests.for_each import case
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering
from tests.pipeline.programs import printed_by


def _array(task: int, first: int, last: int, count: int, **more: str) -> dict[str, str]:
    numbers = {"ID": task, "MIN": first, "MAX": last, "COUNT": count}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in numbers.items()} | more


GIVEN = {"TASKS": "0-1,7", "SHARDS_PER_TASK": "4"}


def test_the_tasks_of_an_array_have_equal_shares_and_are_written_as_ranges() -> None:
    assert [shards_of_task(_array(k, 0, 3, 4), lambda: 10) for k in range(4)] == [
        "0:2", "2:5", "5:7", "7:10",
    ]  # fmt: skip
    by_two = [shards_of_task(_array(k, 1, 5, 3), lambda: 6) for k in (1, 3, 5)]  # --array=1-5:2
    assert by_two == ["0:2", "2:4", "4:6"]
    assert shards_of_task(_array(7, 7, 7, 1), lambda: 6) == "0:6"
    shares = [shards_of_task(_array(k, 0, 4, 5), lambda: 2) for k in range(5)]
    assert shares == ["0:1", "1:2", "0:1", "1:2", "0:1"], "more tasks than shards"

    unknown = Mock()
    alone = {"SLURM_ARRAY_TASK_ID": "2", "SHARDS_PER_TASK": "4"}
    assert shards_of_task(alone, unknown) == "8:12"
    assert not unknown.called, "nobody needs to know: the dataset need not even be begun"
    shares = [shards_of_place({**GIVEN, PLACE: str(place)}) for place in range(3)]
    assert shares == ["0:4", "4:8", "28:32"], "a place is a task that is missing"
    for text, numbers in ("", []), ("4", [4]), ("0-3,7", [3, 2, 1, 0, 7, 7]), ("0,2-3", [0, 2, 3]):
        assert number_ranges(numbers) == text
        assert numbers_of(text) == sorted(set(numbers))


def test_what_is_no_array_is_named() -> None:
    rows: list[tuple[str, dict[str, str], str]] = [
        ("slurm", {}, "SLURM_ARRAY_TASK_ID is not set; expected a task of an array, .* Submit"),
        ("slurm", _array(3, 3, 7, 2, SHARDS_PER_TASK="0"), "SHARDS_PER_TASK is '0'; .* from 1"),
        ("slurm", _array(0, 0, 0, 1) | {"SLURM_ARRAY_TASK_ID": "x"}, "ID is 'x'; .* from 0"),
        ("slurm", _array(3, 0, 7, 3), r"3 tasks between 0 and 7, .* Or set SHARDS_PER_TASK"),
        ("slurm", _array(2, 0, 9, 4), r"4 tasks between 0 and 9, with gaps"),  # 0, 2, 5, 9
        ("kubernetes", {}, "TASKS is not set; expected .* as trilight submit kubernetes makes it"),
        ("kubernetes", GIVEN, f"{PLACE} is not set"),
        ("kubernetes", {**GIVEN, PLACE: "3"}, f"{PLACE} is 3; expected a place below 3"),
        ("kubernetes", {**GIVEN, PLACE: "\N{SUPERSCRIPT TWO}"}, "expected a number from 0"),
        ("kubernetes", {**GIVEN, PLACE: "0", "SHARDS_PER_TASK": "0"}, "_TASK is '0'; .* from 1"),
        ("kubernetes", {**GIVEN, PLACE: "0", "TASKS": "0,,2"}, "TASKS is '0,,2'; expected numbers"),
        ("kubernetes", {**GIVEN, PLACE: "0", "TASKS": "0-999999999"}, "at most 100000"),
    ]
    for on, environment, message in rows:
        with case(message), pytest.raises(TrilightError, match=f"--runner {on}: .*{message}"):
            if on == "slurm":
                shards_of_task(environment, lambda: 8)
            shards_of_place(environment)


def test_an_array_makes_the_dataset_that_one_process_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tasks run in any order; whoever makes the last shard finishes."""
    scenes = without_rendering(monkeypatch)
    finished = Undocumented()
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", lambda: finished)
    alone, shared = (tiny_order(out=str(tmp_path / name), scenes=12) for name in ("one", "set"))
    find_executor("threads", None, None).make(alone, None)
    finished.finished = 0
    slurm = find_executor("slurm", None, None)
    for task in (2, 0, 1):
        assert finished.finished == 0
        for name, value in _array(task, 0, 2, 3).items():
            monkeypatch.setenv(name, value)
        slurm.make(shared, None)
    assert finished.finished == 1
    assert len(scenes) == 24
    assert verify_dataset(tmp_path / "set").problems == []
    one, array = (open_dataset(str(tmp_path / name)) for name in ("one", "set"))
    assert array.digest == one.digest
    for on in ("slurm", "kubernetes"):
        with pytest.raises(TrilightError, match=f"--range is 0:2; expected none .* {on}"):
            find_executor(on, None, None).make(dataclasses.replace(shared, shards="0:2"), None)


FAKE = """#!/bin/bash
printf '%s\\n' "$@" > "$FAKE_SBATCH"
env > "$FAKE_SBATCH.env"
if [ -n "$FAKE_REFUSES" ]; then echo "sbatch: error: invalid partition" >&2; exit 1; fi
echo "4711;cluster"
"""


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an sbatch that writes down what it is asked, and is the current one."""
    program = tmp_path / "bin" / "sbatch"
    program.parent.mkdir()
    program.write_text(FAKE)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SBATCH", str(tmp_path / "asked"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_array_fits_the_cluster_and_covers_every_shard_of_what_was_ordered(
    cluster: Path,
) -> None:
    order = GenerateOptions(build="pretrain-256", scenes=2_000_000)
    job = array_job(order, per_task=None, at_once=None)
    shards = -(-2_000_000 // 256)
    assert len(job.tasks) <= MAX_TASKS
    assert job.per_task * len(job.tasks) >= shards > job.per_task * (len(job.tasks) - 1)
    changes = {"splits.scenes_per_shard": 8}  # settings that divide the dataset count
    order = GenerateOptions(build="smoke", scenes=64, changes=changes, objects="my objects")
    job = array_job(order, per_task=2, at_once=3)
    assert job.tasks == [0, 1, 2, 3]
    name, line = submit_slurm_array(job, dry_run=True)
    assert name is None
    words = shlex.split(line)
    assert {"OBJECTS=my objects", "SCENES=64"} <= set(words)
    words = words[words.index("sbatch") :]
    assert words[:3] == ["sbatch", "--parsable", "--array=0-3%3"]
    assert words[4:] == ["--set", "splits.scenes_per_shard=8"]


def test_tasks_that_died_are_all_that_is_submitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two shards a task; the second task dies, and the array that follows is it alone."""

    def killed(scene: int) -> None:
        if scene == 9 and not survives:
            raise KeyboardInterrupt

    survives = False
    without_rendering(monkeypatch, killed)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    order = tiny_order(out=str(tmp_path / "set"), scenes=20)

    def run(job: ArrayJob) -> None:
        monkeypatch.setenv("SHARDS_PER_TASK", str(job.per_task))
        for task in job.tasks:
            monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
            with contextlib.suppress(KeyboardInterrupt):
                find_executor("slurm", None, None).make(order, None)

    first = array_job(order, per_task=2, at_once=None)
    assert first.tasks == [0, 1, 2]
    run(first)
    left = missing_shards(order.place)
    assert left and set(left) <= {2, 3}
    said = trilight(["status", order.place, "--missing", "--shards-per-task", "2"])
    assert said.stdout.strip() == "1"
    survives = True
    again = array_job(order, per_task=2, at_once=None)
    assert again.tasks == [1]
    run(again)
    assert verify_dataset(order.place).problems == []
    # what is left are the documents, which these tasks do not write
    assert missing_shards(order.place) == [0]
    (tmp_path / "set" / "README.md").write_text("# A set")
    assert array_job(order, per_task=2, at_once=None).tasks == []
    assert trilight(["status", order.place, "--missing"]).stdout == ""


def test_what_no_array_can_make_is_refused_and_no_password_reaches_the_queue(cluster: Path) -> None:
    rows: list[tuple[dict[str, Any], int | None, str]] = [
        ({"objects": "http://ada:secret@host/objects/"}, None, "holds a password"),
        ({"shards": "0:1"}, None, "submit slurm: expected no"),
        ({"scenes_from": "folder"}, None, "submit slurm: expected no"),
        ({"build": "pretrain-256", "scenes": 2_000_000}, 1,
         "shards-per-task is 1: .* task 7812; .* 8 shards"),
    ]  # fmt: skip
    for given, per_task, message in rows:
        with case(given), pytest.raises(TrilightError, match=message) as refused:
            array_job(GenerateOptions(**given), per_task=per_task, at_once=None)
        assert "secret" not in str(refused.value)


def test_refusals(cluster: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_REFUSES", "1")
    words = ["submit", "slurm", "smoke", "--out", "set"]
    result = trilight(words)
    assert "sbatch refused (sbatch: error: invalid partition)" in str(result.exception)
    monkeypatch.setenv("PATH", "/nowhere")
    (cluster / "logs").rmdir()
    assert "no sbatch here; expected a login node" in str(trilight(words).exception)
    assert not (cluster / "logs").exists()
    dry = trilight([*words, "--dry-run"])
    assert dry.exit_code == 0 and "sbatch --parsable --array=0-5" in dry.stdout
    result = trilight(["submit", "generate-scenes", "smoke", "--dry-run"])
    assert result.exit_code == 2 and "'--dry-run' is unknown" in result.mistake
    alone = trilight(["status", "set", "--shards-per-task", "4"])
    assert "expected it only with --missing" in str(alone.exception)
    assert shlex.split(dry.stdout.splitlines()[-1])[4] == "OUT=set"


def test_the_printed_command_does_what_submitting_does(cluster: Path) -> None:
    words = ["submit", "slurm", "smoke", "--out", "my set", "--objects", "my objects"]
    words += ["--scenes", "24", "--sbatch=--partition=a"]
    dry = trilight([*words, "--dry-run"])
    assert dry.exit_code == 0 and not (cluster / "logs").exists()
    subprocess.run(["bash", "-c", dry.stdout.splitlines()[-1]], check=True, capture_output=True)
    assert (cluster / "logs").is_dir()
    printed = (cluster / "asked").read_text()
    asked = printed.split("\n")
    assert asked[:3] == ["--parsable", "--array=0-5", "--partition=a"]
    assert Path(asked[3]).name == "generate.sbatch"
    environment = (cluster / "asked.env").read_text().splitlines()
    assert {"OUT=my set", "OBJECTS=my objects", "SHARDS_PER_TASK=1"} <= set(environment)
    (cluster / "logs").rmdir()
    assert expect_json(*words) == {"job": "4711", "array": "0-5", "shards_per_task": 1}
    assert (cluster / "asked").read_text() == printed and (cluster / "logs").is_dir()
    environment = (cluster / "asked.env").read_text().splitlines()
    assert "SHARDS_PER_TASK=1" in environment


def test_what_an_executor_is_and_has_no_use_for() -> None:
    """Its name loads neither Prefect nor the stages: names are asked for at every tab key."""
    with pytest.raises(TrilightError, match="--workers is 2; expected none with --runner dask"):
        find_executor("dask", "tcp://127.0.0.1:1", 2)
    with pytest.raises(TrilightError, match="--address is tcp://a:1; expected .* --runner dask"):
        find_executor("slurm", "tcp://a:1", None)
    with pytest.raises(TrilightError, match="--runner is 'thread'; .*threads"):
        find_executor("thread", None, None)
    assert set(EXECUTORS) == {"threads", "slurm", "kubernetes", "prefect", "dask"}
    for name in ("executors.threads:make", "executors.threads:make_slurm",
                 "executors.threads:make_kubernetes", "flows.flow_executors:make"):  # fmt: skip
        home, _, function = name.partition(":")
        make = getattr(import_module(f"pipeline.{home}"), function)
        assert make.__code__.co_varnames[: make.__code__.co_argcount] == ("options", "address")
    code = (
        "import sys, pipeline.executors.registry;"
        "print([name for name in ('prefect', 'distributed', 'pipeline.generation.pipeline') "
        "if name in sys.modules])"
    )
    assert printed_by(code) == "[]"


IMAGE = "registry.example/trilight@sha256:1"
MISSING = [0, 1, 5, 8]
"""Shards, two to a task: tasks 0, 2 and 4."""


def _manifest(missing: list[int] = MISSING, **options: Any) -> dict[str, Any]:
    """Return the manifest of an array of what a dataset in a bucket lacks."""
    order = GenerateOptions(
        build="smoke", scenes=64, out="s3://sets/mine", objects="builtin:", seed=7
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "_is_begun", lambda place: True)
        patch.setattr(arrays, "missing_shards", lambda place, scenes: missing)
        job = array_job(order, per_task=2, at_once=None, on="kubernetes")
    return job_manifest(job, KubernetesOptions(**{"image": IMAGE, **options}))


def test_every_place_makes_what_is_missing_and_nothing_else_and_needs_an_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("TRILIGHT_IMAGE", raising=False)
    with pytest.raises(TrilightError, match="submit kubernetes: --image is not given"):
        _manifest(image=None)
    manifest = _manifest()
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
    assert _manifest() == manifest
    assert _manifest([0])["metadata"]["name"] != manifest["metadata"]["name"]


def test_kubernetes_takes_the_job_and_gives_its_pod_the_rights_of_others() -> None:
    from tests.infra.setup.manifests_kit import job_template

    schemas = pytest.importorskip("kubernetes_validate", reason="make setup-all")
    manifest = _manifest(account="trilight-flow", machine_type="c7i.2xlarge", tries=4)
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
    # Its pod has the rights of the other manifests.
    theirs = job_template()["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    pod = _manifest()["spec"]["template"]["spec"]
    (ours,), (other,) = pod["containers"], theirs["containers"]
    assert pod["securityContext"] == theirs["securityContext"]
    for name in ("securityContext", "resources", "envFrom", "imagePullPolicy"):
        assert ours[name] == other[name], name
    mounts = [{each["mountPath"] for each in one["volumeMounts"]} for one in (ours, other)]
    assert mounts[0] == mounts[1]
    assert not pod["automountServiceAccountToken"]


def test_files_of_this_machine_are_refused() -> None:
    rows: list[tuple[dict[str, str], str]] = [
        ({"out": "data/mine"}, "--out is data/mine; expected a bucket"),
        ({"objects": "chairs"}, "--objects is chairs, a folder of this machine"),
        ({"objects": "builtin:", "skies": "file:///skies"}, "--skies is file:///skies, a folder"),
        ({"build": "mine.py:sunsets"}, "mine.py:sunsets, a file of this machine"),
    ]
    for asked, message in rows:
        given: dict[str, Any] = {"scenes": 8, "out": "gs://sets/mine", **asked}
        order = GenerateOptions(**given | {"build": "smoke"})
        object.__setattr__(order, "build", asked.get("build", "smoke"))  # --extend has loaded it
        job = ArrayJob(options=order, tasks=[0], per_task=1, at_once=1)
        said = f"submit kubernetes: .*{message}"
        with case(asked), pytest.raises(TrilightError, match=said):
            job_manifest(job, KubernetesOptions(image=IMAGE))
