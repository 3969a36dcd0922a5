"""The documented production path, word for word: one dataset by all executors has one digest.

In a bucket too, by two machines and a flow; and no secret gets anywhere.
"""

import base64
import json
import os
import shlex
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model.inference import NeuralRenderer
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.end_to_end.conftest import kill_one
from tests.end_to_end.production_kit import (
    FEW_SAMPLES,
    FEW_SAMPLES_CHANGES,
    START,
    STOP,
    Postgres,
    call,
    dask_cluster,
    documented_run,
    documented_serving,
    postgres,
    served,
)
from tests.http_server import serve
from tests.pipeline.assets.meshes_by_hand import knot, write_obj
from tests.pipeline.documents.dataset_by_hand import files_of
from tests.pipeline.generation.bucket_kit import empty_bucket
from tests.s3_server import control

SCENES = 8
"""Two shards of four: a range for each of two workers."""
SMALL: dict[str, Any] = {
    "objects": "builtin:24", "scenes": SCENES, "resolution": 64,
    "changes": json.dumps(FEW_SAMPLES_CHANGES),
}  # fmt: skip
"""Tiny scenes, as wide as the smoke run's pictures."""
OPTIONS = ("--objects", "builtin:24", "--resolution", "64", *FEW_SAMPLES)
CANARY = "CANARY-51b2"
"""Part of every secret; nothing that is written or said may contain it."""
RUN_S = 900
"""A run takes a minute; on busy machines many times that."""


def _generate(out: Path, *more: str) -> None:
    size = (*OPTIONS, "--scenes", str(SCENES))
    call(["-m", "trilight", "generate", "smoke", *size, "--out", str(out), *more],
         dict(os.environ), RUN_S)  # fmt: skip


def _verified(out: Path) -> str:
    assert verify_dataset(out).problems == []
    assert (out / "report.html").exists()
    return open_dataset(str(out)).digest


def test_the_readme_serves_runs_and_stops_as_is_done_here() -> None:
    """`served` runs what `make serve` and `make stop` run; the line between is run below."""
    serve, run, submit, stop = documented_serving()
    assert run.startswith("prefect deployment run generate-scenes/local ")
    assert submit.startswith("trilight submit generate-scenes tiny --scenes 64 --out ")
    for line, last in ((serve, START), (stop, STOP)):
        # under `make test` a make that is called says in which folder it works
        make = ["make", "--dry-run", "--no-print-directory", "--old-file", "setup"]
        make += shlex.split(line)[1:]
        done = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1].split() == ["python", *last]
    assert (
        documented_run("build-dataset", scenes=1, out="a", flow_runs=2)[4] == "build-dataset/local"
    )


@pytest.mark.slow("servers")
@pytest.mark.timeout(3600)
def test_all_executors_give_one_digest(tmp_path: Path) -> None:
    _generate(tmp_path / "plain")
    digests = {"plain": _verified(tmp_path / "plain")}
    base = with_a_cluster(tmp_path)
    with postgres() as database, served(tmp_path, database.url, 2, base) as environment:
        several = documented_run("build-dataset", **SMALL, out=tmp_path / "two", flow_runs=2)
        call(several, environment, RUN_S)
        digests["two workers"] = _verified(tmp_path / "two")
        _wait_for_both_workers(environment)
        # what is there already is asked for: the run finds it whole, and its summary arrives here
        words = ("submit", "generate-scenes", "tiny", *OPTIONS, "--scenes", str(SCENES), "--json")
        text = call(["-m", "trilight", *words, "--out", str(tmp_path / "two")], environment, RUN_S)
        told = json.loads(text)
        summary = ("Completed", digests["two workers"])
        assert (told["state"], told["summary"]["dataset digest"]) == summary
        _trains(tmp_path, environment)
        _refuses_secrets(tmp_path, environment, database)
        require_an_array_outlives_its_flow(tmp_path, environment)
    with dask_cluster(tmp_path, 2) as address:
        _generate(tmp_path / "dask", "--runner", "dask", "--address", address)
        digests["dask"] = _verified(tmp_path / "dask")
    logs = [path.read_text() for path in (tmp_path / "dask" / "logs").glob("*.jsonl")]
    makers = {json.loads(line)["pid"] for text in logs for line in text.splitlines()}
    assert len(makers) >= 2
    assert len(set(digests.values())) == 1, digests


def _wait_for_both_workers(environment: dict[str, str]) -> None:
    """Wait until the run of the second range has ended well, also if it had nothing left to make.

    The first worker makes what nobody has claimed, and may be done before the second one starts.
    """
    query: dict[str, Any] = {
        "flow_runs": {"state": {"type": {"any_": ["COMPLETED"]}}},
        "flows": {"name": {"any_": ["generate-scenes"]}},
    }
    credentials = base64.b64encode(environment["PREFECT_API_AUTH_STRING"].encode()).decode()
    request = urllib.request.Request(
        environment["PREFECT_API_URL"] + "/flow_runs/filter",
        json.dumps(query).encode(),
        {"Content-Type": "application/json", "Authorization": f"Basic {credentials}"},
    )

    def ranges() -> set[str | None]:
        with urllib.request.urlopen(request, timeout=120) as answer:
            return {run["parameters"].get("shards") for run in json.load(answer)}

    deadline = time.monotonic() + RUN_S
    while not {"0:1", "1:2"} <= ranges():
        assert time.monotonic() < deadline
        time.sleep(0.5)


def _trains(tmp_path: Path, environment: dict[str, str]) -> None:
    """Learn from what the flows made, as a flow."""
    ones = ("warmup_steps", "scenes_per_step", "views_per_scene", "validation_scenes")
    run = documented_run(
        "train-model",
        data=json.dumps([str(tmp_path / "two")]),
        out=tmp_path / "run",
        steps=4,
        changes=json.dumps(dict.fromkeys(ones, 1)),
    )
    call(run, environment, RUN_S)
    assert NeuralRenderer.load(tmp_path / "run").trained.resolution == 64


def _refuses_secrets(tmp_path: Path, environment: dict[str, str], database: Postgres) -> None:
    """Neither the database, its log nor ours ever sees what was refused, and the rest names it."""
    with pytest.raises(AssertionError, match="Validation failed for field 'objects'"):
        secret = f"https://me:{CANARY}@host/folder"
        call(
            documented_run(**{**SMALL, "objects": secret}, out=tmp_path / "no"), environment, RUN_S
        )
    rows = database.dump()
    assert str(tmp_path / "two") in rows  # parameters are in what is looked through, and so are
    assert "packed, 4 scenes" in rows  # the lines of logs
    assert CANARY not in rows
    assert CANARY not in (database.folder / "log").read_text()
    for place in (tmp_path / "state", tmp_path / "prefect"):
        for path in place.rglob("*"):
            assert not path.is_file() or CANARY.encode() not in path.read_bytes(), path


CLUSTER = f"""#!{sys.executable}
# A cluster of one node: takes an array, says its number, and runs the tasks one after another.
import os, subprocess, sys
words = sys.argv[1:]
array = next(word for word in words if word.startswith("--array=")).removeprefix("--array=")
script, *rest = [word for word in words if not word.startswith("--array=") and word != "--parsable"]
with open(os.environ["FAKE_ASKED"], "a") as asked:
    asked.write(array + "\\n")
loop = 'for task in $TASKS; do SLURM_ARRAY_TASK_ID=$task bash "$@" >> "$FAKE_LOG" 2>&1; done'
spans = [part.split("-") for part in array.partition("%")[0].split(",")]
tasks = [task for span in spans for task in range(int(span[0]), int(span[-1]) + 1)]
subprocess.Popen(["bash", "-c", loop, "loop", script, *rest], start_new_session=True,
                 env={{**os.environ, "TASKS": " ".join(map(str, tasks))}},
                 stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print("4711;fake")
"""
ORDER = (
    "make-by-array smoke --objects builtin:6 --scenes 8 --quiet-hours 0.2 --resolution 16 "
    "--set renders.min_spp=16 --set renders.max_spp=16 --set scenes.num_views=1"
).split()


def with_a_cluster(folder: Path) -> dict[str, str]:
    """Return an environment in which `sbatch` is that of CLUSTER."""
    sbatch = folder / "bin" / "sbatch"
    sbatch.parent.mkdir()
    sbatch.write_text(CLUSTER)
    sbatch.chmod(0o755)
    return {
        **os.environ,
        "PATH": f"{sbatch.parent}:{os.environ['PATH']}",
        "FAKE_ASKED": str(folder / "asked"),
        "FAKE_LOG": str(folder / "tasks.log"),
        "PYTHONUNBUFFERED": "1",
    }


def require_an_array_outlives_its_flow(folder: Path, environment: dict[str, str]) -> None:
    """Kill the flow that asked for an array; its next run ends what the array has made."""
    words = ["submit", *ORDER, "--out", str(folder / "by-array")]
    mark = f"TRILIGHT_SERVED={(Path(environment['TRILIGHT_STATE']) / 'mark').read_text()}"
    with subprocess.Popen(
        [sys.executable, "-m", "trilight", *words], cwd=ROOT, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as watched:  # fmt: skip
        waited_s = 0.0
        while not (folder / "asked").exists() and waited_s < RUN_S and watched.poll() is None:
            time.sleep(0.1)
            waited_s += 0.1
        killed = kill_one("prefect.engine", mark, np.random.default_rng(0))
        told, _ = watched.communicate(timeout=RUN_S)
    assert killed, told
    assert watched.returncode == 1 and "ended as Crashed" in told, told
    ended = json.loads(
        call(["-m", "trilight", *words, "--scheduler", "none", "--json"], environment, RUN_S)
    )
    assert (ended["state"], ended["summary"]["shards"]) == ("Completed", "2 of 2"), (
        folder / "tasks.log"
    ).read_text()
    assert verify_dataset(str(folder / "by-array")).problems == []
    assert (folder / "asked").read_text() == "0-1\n", "the second run asked for nothing"


SECRETS = (
    "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "PREFECT_API_KEY", "HF_TOKEN", "GITHUB_TOKEN",
    "GOOGLE_API_KEY", "DATABASE_PASSWORD",
)  # fmt: skip
BUCKET_OPTIONS = (
    "--objects", "env:TRILIGHT_SOURCE_TEST", "--scenes", "12", "--resolution", "32",
    *FEW_SAMPLES,
)  # fmt: skip
"""Three shards of four tiny scenes."""
FLOW = f"""
from pipeline.flows import prefect_server as private
private.quiet_prefect()
with private.prefect_server():
    from pipeline.flows.prefect_flows import generate_scenes
    generate_scenes(objects="env:TRILIGHT_SOURCE_TEST", scenes=12, resolution=32,
                    changes={FEW_SAMPLES_CHANGES!r}, out="s3://shards/flow")
"""


@pytest.fixture
def driver(moto: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with empty_bucket(moto, monkeypatch) as bucket:
        bucket.port = moto
        yield bucket


@pytest.fixture
def environment(driver: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An environment full of secrets, and objects behind a URL with three of them."""
    (tmp_path / "objects").mkdir()
    for number in range(8):  # the first six have all three splits
        write_obj(tmp_path / "objects" / f"knot{number}.obj", knot(segments=30 + number, sides=6))
    with serve(None) as site:
        for path in (tmp_path / "objects").iterdir():
            site.put(f"objects/{path.name}", path.read_bytes())
        site.needed_query = f"key={CANARY}"
        address = site.url.removeprefix("http://")
        yield {
            **{name: value for name, value in os.environ.items() if name != "PREFECT_API_URL"},
            **{name: f"{CANARY}-{name.lower()}" for name in SECRETS},
            "TRILIGHT_SOURCE_TEST": f"http://me:{CANARY}@{address}/objects/?key={CANARY}",
            "PYTHONPATH": str(ROOT),
            "NO_PROXY": "127.0.0.1",
            "PREFECT_HOME": str(tmp_path / "prefect"),
            "PREFECT_LOGGING_LEVEL": "DEBUG",
            "PREFECT_LOGGING_EXTRA_LOGGERS": "trilight",
        }


def _words(out: Path | str, *more: str) -> list[str]:
    command = ["-m", "trilight", "generate", "smoke", *BUCKET_OPTIONS]
    return [*command, "--out", str(out), *more]


@pytest.mark.slow("servers")
@pytest.mark.timeout(3600)
def test_a_bucket_as_output_from_two_machines_and_a_flow(
    driver: Any, environment: dict[str, str], tmp_path: Path
) -> None:
    plain, said = tmp_path / "plain", []
    reader = {**environment, "TRILIGHT_CACHE": str(tmp_path / "one")}
    said.append(call(_words(plain), reader, RUN_S))
    runs = [
        subprocess.Popen(
            [sys.executable, *_words("s3://shards/set", "--shards", shards)],
            cwd=ROOT, env={**environment, "TRILIGHT_CACHE": str(tmp_path / cache)}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )
        for cache, shards in (("two", "0:2"), ("three", "1:3"))
    ]  # fmt: skip
    for run in runs:
        said.append(run.communicate(timeout=RUN_S)[0])
        assert run.returncode == 0, said[-1]
    said.append(call(["-c", FLOW], reader, RUN_S))  # its meshes are made
    _same_files(driver, plain, "shards/set")
    _same_files(driver, plain, "shards/flow")
    for name in ("verify", "status", "inspect"):
        said += [call(["-m", "trilight", name, "s3://shards/set"], reader, RUN_S)]
    assert "finished" in said[-2] and "12 of 12" in said[-2]
    said += _refused(environment, driver.port)
    _no_canary(driver, tmp_path, said)


def _same_files(driver: Any, plain: Path, prefix: str) -> None:
    """Compare all that is a dataset; logs and what is beside it are not."""
    driver.invalidate_cache()
    found = {path.removeprefix(f"{prefix}/"): driver.cat_file(path) for path in driver.find(prefix)}
    aside = (".staging/", "logs/")
    assert {name: data for name, data in found.items() if not name.startswith(aside)} == {
        name: data for name, data in files_of(plain).items() if not name.startswith(aside)
    }


def _refused(environment: dict[str, str], port: int) -> list[str]:
    """Return what is said where access is refused, and where a secret stands in the URL."""
    control(port, "reset-auth", b"0")
    refused = []
    for out in ("s3://shards/set", f"s3://me:{CANARY}@shards/set", f"s3://shards/set?k={CANARY}"):
        done = run_program([sys.executable, *_words(out)], env=environment, status=1)
        assert "trilight: out 's3://shards/set" in done.stderr.strip().splitlines()[-1]
        refused.append(done.stdout + done.stderr)
    control(port, "reset-auth", b"inf")
    return refused


def _no_canary(driver: Any, tmp_path: Path, said: list[str]) -> None:
    """Look through what was said, every file, every object of the bucket, and Prefect's records."""
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    records = b"".join(path.read_bytes() for path in files if "prefect.db" in path.name)
    assert b"s3://shards/flow/report.html" in records  # the artifacts are in what is looked through
    assert not [text for text in said if CANARY in text]
    assert not [path for path in files if CANARY.encode() in path.read_bytes()]
    assert not [path for path in driver.find("shards") if CANARY.encode() in driver.cat_file(path)]
