"""The flow `make-by-array`: asks for what is missing alone, shows it, and ends with the dataset."""

import dataclasses
import json
import logging
import threading
from pathlib import Path
from typing import Any

import pytest

from pipeline.executors.array_job import ArrayJob, DatasetByArray
from pipeline.executors.kubernetes_array import KubernetesOptions, options_here
from pipeline.executors.registry import find_executor
from pipeline.flows import array_flow
from pipeline.flows.array_flow import make_by_array
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

Shown = list[tuple[str, dict[str, str]]]


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """Key and rows of each table; there is no server, and the dataset is looked at all the time."""
    tables: Shown = []

    def table(rows: list[dict[str, str]], key: str, description: str) -> None:
        tables.append((key, {row["what"]: row["value"] for row in rows}))

    monkeypatch.setattr(array_flow, "create_table_artifact", table)
    monkeypatch.setattr(array_flow, "create_progress_artifact", lambda *args, **named: "id")
    monkeypatch.setattr(array_flow, "update_progress_artifact", lambda *args: None)
    monkeypatch.setattr(array_flow, "create_image_artifact", lambda *args, **named: None)
    monkeypatch.setattr(array_flow, "get_run_logger", lambda: logging.getLogger("trilight.test"))
    monkeypatch.setattr(array_flow, "LOOK_S", 0.01)
    return tables


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The tasks of each array; a thread works on them, as a cluster would."""
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.slurm.ThreadRunner", Undocumented)
    arrays: list[list[int]] = []

    def submit(job: ArrayJob) -> str:
        def work() -> None:
            for task in job.tasks:
                monkeypatch.setenv("SHARDS_PER_TASK", str(job.per_task))
                monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
                find_executor("slurm", None, None).make(job.order, None)
            Path(job.order.place, "README.md").write_text("# A set")  # the last document

        arrays.append(list(job.tasks))
        threading.Thread(target=work).start()
        return "4711"

    monkeypatch.setattr(array_flow, "submit_array", submit)
    return arrays


def run(**given: Any) -> None:
    plain = {
        each.name: getattr(tiny_order(), each.name) for each in dataclasses.fields(DatasetOrder)
    }
    own = {name: DatasetByArray.__dataclass_fields__[name].default for name in _OWN}
    flow: Any = make_by_array
    checked = flow.validate_parameters(
        {**plain, **own, "changes": {"scenes": {"num_views": 2}}, **given}
    )
    flow.fn(**checked)


_OWN = set(DatasetByArray.__dataclass_fields__) - set(DatasetOrder.__dataclass_fields__)


def test_what_is_missing_is_asked_for_and_shown_to_the_end(
    shown: Shown, cluster: list[list[int]], tmp_path: Path
) -> None:
    out = str(tmp_path / "set")
    run(out=out, scenes=20, shards_per_task=2)
    assert cluster == [[0, 1, 2]]
    key, summary = shown[-1]
    assert key == "summary" and summary["shards"] == "5 of 5" and len(summary["dataset digest"]) > 8
    assert all(key == "progress" for key, _ in shown[:-1])
    run(out=out, scenes=20, shards_per_task=2)
    assert len(cluster) == 1, "nothing is missing"
    (tmp_path / "set" / "train-000003.tar").unlink()
    run(out=out, scenes=20, shards_per_task=2)
    assert cluster[1:] == [[1]], "the task of the shard that is gone"
    assert (tmp_path / "set" / "train-000003.tar").exists()


def test_who_watches_alone_asks_for_nothing_and_waits_so_long(
    shown: Shown, cluster: list[list[int]], tmp_path: Path
) -> None:
    with pytest.raises(TrilightError, match=r"no new scene for 0\.0001 hours \(none made\)"):
        run(out=str(tmp_path / "set"), scheduler="none", quiet_hours=0.0001)
    assert cluster == [] and shown == []


def test_a_page_that_cannot_be_shown_does_not_end_the_run(
    shown: Shown,
    cluster: list[list[int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def gone(*args: object, **named: object) -> None:
        raise ConnectionError("gone")

    monkeypatch.setattr(array_flow, "create_progress_artifact", gone)
    monkeypatch.setattr(array_flow, "create_table_artifact", gone)
    run(out=str(tmp_path / "set"), scenes=4)
    assert [record.levelname for record in caplog.records].count("WARNING") == 1


def test_machines_are_those_of_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who may start a run chooses neither an image nor an account."""
    assert not _OWN & set(KubernetesOptions.__dataclass_fields__)
    assert options_here() == KubernetesOptions()
    stated = tmp_path / "machines.json"
    monkeypatch.setenv("TRILIGHT_MACHINES", str(stated))
    stated.write_text(json.dumps({"where": "a-namespace", "cores": 4}))
    assert options_here() == KubernetesOptions(where="a-namespace", cores=4)
    for text, message in (
        ("{", "cannot be read"),
        ('{"core": 4}', "core"),
        ('{"on_demand": true}', "removed since"),
    ):
        stated.write_text(text)
        with pytest.raises(TrilightError, match=message):
            options_here()
