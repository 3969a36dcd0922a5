"""The documented production path, word for word: one dataset by all executors has one digest."""

import base64
import json
import os
import shlex
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from model.neural_renderer import NeuralRenderer
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from tests.conftest import ROOT
from tests.end_to_end.array_kit import require_an_array_outlives_its_flow, with_a_cluster
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

SCENES = 8
"""Two shards of four: a range for each of two workers."""
SMALL: dict[str, Any] = {
    "objects": "builtin:24", "scenes": SCENES, "resolution": 64,
    "changes": json.dumps(FEW_SAMPLES_CHANGES),
}  # fmt: skip
"""Tiny scenes, as wide as the smoke run's pictures."""
OPTIONS = ("--objects", "builtin:24", "--resolution", "64", *FEW_SAMPLES)
CANARY = "CANARY-51b2"
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
    assert submit.startswith("trilight submit generate-scenes smoke --scenes 64 --out ")
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
        _submits(tmp_path / "two", environment, digests["two workers"])
        _trains(tmp_path, environment)
        _refuses_secrets(tmp_path, environment, database)
        require_an_array_outlives_its_flow(tmp_path, environment)
    with dask_cluster(tmp_path, 2) as address:
        _generate(tmp_path / "dask", "--runner", "dask", "--address", address)
        digests["dask"] = _verified(tmp_path / "dask")
    assert len(_makers(tmp_path / "dask")) >= 2
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


def _submits(out: Path, environment: dict[str, str], digest: str) -> None:
    """Ask for what is there already: the run finds it whole, and its summary arrives here."""
    words = ("submit", "generate-scenes", "smoke", *OPTIONS, "--scenes", str(SCENES), "--json")
    text = call(["-m", "trilight", *words, "--out", str(out)], environment, RUN_S)
    told = json.loads(text)
    assert (told["state"], told["summary"]["dataset digest"]) == ("Completed", digest)


def _makers(out: Path) -> set[int]:
    """Return the processes that made scenes of a dataset."""
    return {
        json.loads(line)["pid"] for path in (out / "logs").glob("*.jsonl") for line in path.open()
    }


def _trains(tmp_path: Path, environment: dict[str, str]) -> None:
    """Learn from what the flows made, as a flow."""
    changes = {
        "warmup_steps": 1,
        "scenes_per_step": 1,
        "views_per_scene": 1,
        "validation_scenes": 1,
    }
    where: dict[str, Any] = {
        "data": json.dumps([str(tmp_path / "two")]),
        "out": str(tmp_path / "run"),
        "steps": 4,
        "changes": json.dumps(changes),
    }
    call(documented_run("train-model", **where), environment, RUN_S)
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
