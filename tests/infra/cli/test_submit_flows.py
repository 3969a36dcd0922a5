"""`trilight submit` of a flow: what is said while it runs, and at its end; the server is a toy."""

import contextlib
import json
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from pipeline.flows import submission
from pipeline.flows.submission import SeenRun, Submitted
from tests.command_line import trilight

RUN = Submitted(
    id=UUID(int=1),
    name="a-run",
    deployment="generate-scenes/local",
    pool="local",
    page="http://page",
)


def seen(state: str, **more: Any) -> SeenRun:
    plain: dict[str, Any] = {"message": "", "percent": 50.0, "tables": {}}
    ended = state in ("Completed", "Crashed")
    told = {**plain, "is_final": ended, "is_completed": state == "Completed", **more}
    return SeenRun(state=state, **told)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the server is asked for; its run is seen in `looks`, without any by default."""
    found: list[Any] = []

    def submit(client: object, flow: str, deployment: str | None, given: object) -> Submitted:
        found.append((flow, deployment, given))
        return RUN

    monkeypatch.setattr(submission, "server", contextlib.nullcontext)
    monkeypatch.setattr(submission, "submit", submit)
    monkeypatch.setattr(submission, "workers_online", lambda client, pool: 1)
    return found


def test_a_run_is_watched_to_its_end(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    looks = [seen("Pending"), seen("Running"), seen("Running")]
    looks.append(seen("Completed", tables={"summary": [("scenes", "2")]}))
    monkeypatch.setattr(submission, "looks", lambda client, run: iter(looks))
    words = ["submit", "generate-scenes", "smoke", "--scenes", "2", "--out", str(tmp_path)]
    told = trilight(words).stdout
    given = {"build": "smoke", "scenes": 2, "out": str(tmp_path)}
    assert asked == [("generate-scenes", None, given)]
    for line in ("Run a-run of generate-scenes/local: http://page", "Pending", "scenes  2"):
        assert told.count(line) == 1, told
    assert f"Next: trilight verify {tmp_path}" in told
    assert json.loads(trilight([*words, "--json"]).stdout)["summary"] == {"scenes": "2"}


def test_a_run_that_crashed_is_a_mistake_with_its_reason(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = seen("Crashed", message="it was killed.")
    monkeypatch.setattr(submission, "looks", lambda client, run: iter([ended]))
    failed = trilight(["submit", "generate-scenes", "smoke"])
    assert "ended as Crashed: it was killed. Its log is at http://page" in failed.stderr


def test_who_does_not_watch_gets_the_run(asked: list[Any]) -> None:
    words = ["submit", "generate-scenes", "smoke", "--no-watch", "--deployment", "cluster"]
    assert json.loads(trilight([*words, "--json"]).stdout)["flow_run"] == str(RUN.id)
    assert asked[0][:2] == ("generate-scenes", "cluster")


def test_a_flow_that_is_none_is_told_those_there_are() -> None:
    assert "build-dataset, make-by-array, or of slurm" in trilight(["submit", "x", "smoke"]).mistake
