"""What is shown of a run, also by an array: an honest rate, the report, and never its end."""

import base64
import dataclasses
import io
import json
import logging
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from pipeline.executors.registry import find_executor
from pipeline.executors.slurm_and_kubernetes import (
    ArrayJob,
    DatasetByArray,
    KubernetesOptions,
    options_from_environment,
)
from pipeline.flows import prefect_flows, prefect_runner
from pipeline.flows.prefect_flows import make_by_array
from pipeline.flows.prefect_runner import (
    PrefectRunner,
    RunArtifacts,
    report_url,
    small_picture,
    usd_per_core_hour,
)
from pipeline.generation.dataset_writer import DatasetProgress
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import TaskResult
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


@for_each(
    ("base", "url"),
    [
        ("", None),  # a link that leads nowhere is none
        ("https://data.example/sets/", "https://data.example/sets/mine/report.html"),
    ],
)
def test_the_link_to_the_report(
    monkeypatch: pytest.MonkeyPatch, base: str, url: str | None
) -> None:
    monkeypatch.setenv("TRILIGHT_PUBLIC_URL", base)
    assert report_url("data/mine") == url


Shown = list[tuple[str, dict[str, str]]]


def _shown(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """Key and rows of each table that is shown; there is no server."""
    shown: Shown = []

    def table(rows: list[dict[str, str]], key: str, description: str) -> None:
        shown.append((key, {row["what"]: row["value"] for row in rows}))

    module = prefect_runner
    monkeypatch.setattr(module, "create_table_artifact", table)
    monkeypatch.setattr(module, "create_progress_artifact", lambda *args, **named: "id")
    monkeypatch.setattr(module, "update_progress_artifact", lambda *args: None)
    monkeypatch.setattr(module, "create_image_artifact", lambda *args, **named: None)
    for each in (module, prefect_flows):
        monkeypatch.setattr(each, "get_run_logger", lambda: logging.getLogger("trilight.test"))
    return shown


def _cannot_show(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*args: object, **named: object) -> None:
        raise ConnectionError("gone")

    monkeypatch.setattr(prefect_runner, "create_progress_artifact", gone)
    monkeypatch.setattr(prefect_runner, "create_table_artifact", gone)


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> Shown:
    return _shown(monkeypatch)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """The dataset is looked at all the time."""
    monkeypatch.setattr(prefect_flows, "LOOK_S", 0.01)
    return _shown(monkeypatch)


def _task(scenes: int, seconds: float) -> TaskResult:
    return TaskResult(shards=(), scenes=scenes, seconds=seconds, core_s=seconds)


def test_a_page_that_cannot_be_shown_does_not_end_the_run(
    tables: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _cannot_show(monkeypatch)
    watched = RunArtifacts(GenerateOptions(out=str(tmp_path)))
    watched.record_task(None, _task(1, 1.0))  # type: ignore[arg-type]
    watched.show_failure(ValueError("x"))
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_the_rate_begins_with_the_first_scene(
    tables: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An hour of preparing objects, then 4 scenes in 20 s."""
    now = 0.0
    monkeypatch.setattr(prefect_runner.time, "monotonic", lambda: now)
    watched = RunArtifacts(GenerateOptions(out=str(tmp_path)))
    assert watched.scenes_per_s() == 0
    now = 3620.0
    watched.record_task(None, _task(4, 20.0))  # type: ignore[arg-type]
    assert watched.scenes_per_s() == 4 / 20


def test_a_page_shows_the_scenes_and_where_their_report_is(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[str] = []
    monkeypatch.setattr(
        prefect_runner, "create_image_artifact", lambda url, **named: pictures.append(url)
    )
    monkeypatch.delenv("TRILIGHT_PUBLIC_URL", raising=False)
    out = tmp_path / "set"
    out.mkdir()
    Image.effect_noise((1200, 800), 80).save(out / "contact_sheet.png")
    statistics = SimpleNamespace(lines=lambda: [("views", "16")])
    outcome: Any = SimpleNamespace(
        num_shards=1, num_shards_planned=1, digest="d", statistics=statistics
    )
    RunArtifacts(GenerateOptions(out=str(out))).show_result(outcome)
    ((_, rows),) = tables
    assert (rows["report"], rows["views"]) == (f"{out}/report.html", "16")
    (url,) = pictures
    assert url == small_picture(out / "contact_sheet.png")
    kind, _, data = url.partition(",")
    with Image.open(io.BytesIO(base64.b64decode(data))) as shown:
        assert (kind, shown.format, shown.size) == (
            "data:image/jpeg;base64", "JPEG", (1024, 683)
        )  # fmt: skip


def test_the_page_ends_with_how_far_everything_is(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prefect_runner.time, "monotonic", lambda: 0.0)
    watched = RunArtifacts(GenerateOptions(out=str(tmp_path)))
    done = DatasetProgress(shards=1, scenes=4, shards_requested=2, scenes_requested=8)
    publication = SimpleNamespace(progress=done, manifest=SimpleNamespace(num_views=2))
    run: Any = SimpleNamespace(publication=publication)
    watched.record_task(run, _task(4, 1.0))
    publication.progress = DatasetProgress(
        shards=2, scenes=8, shards_requested=2, scenes_requested=8, given_up=1
    )
    watched.record_task(run, _task(4, 1.0))  # too soon for another table
    outcome: Any = SimpleNamespace(num_shards=2, num_shards_planned=2, digest="d", statistics=None)
    watched.show_result(outcome)
    assert [key for key, _ in tables] == ["progress", "progress", "summary"]
    shown = [(rows["shards"], rows["scenes in shards"]) for _, rows in tables[:2]]
    assert shown == [("1 of 2", "4 of 8"), ("2 of 2", "7 of 8")]


def test_a_run_that_fails_says_so_in_its_summary(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise TrilightError("the disk is full of https://me:secret@host/x")

    monkeypatch.setattr(prefect_runner, "make_dataset", full)
    with pytest.raises(TrilightError):
        prefect_runner.make_with_artifacts(GenerateOptions(out=str(tmp_path)), PrefectRunner())
    ((key, rows),) = tables
    assert key == "summary"
    assert rows["failed"].startswith("TrilightError: the disk is full")
    assert "secret" not in rows["failed"]
    assert "core-hours" in rows["cost of this run"]


@for_each("text", ["cheap", "-1", "nan", "inf", ""])
def test_a_price_that_is_none_is_named_at_the_start(
    monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setenv("TRILIGHT_USD_PER_CORE_HOUR", "0.5")
    assert usd_per_core_hour() == 0.5
    monkeypatch.setenv("TRILIGHT_USD_PER_CORE_HOUR", text)
    with pytest.raises(TrilightError, match=rf"TRILIGHT_USD_PER_CORE_HOUR is '{text}'; expected"):
        RunArtifacts(GenerateOptions())


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The tasks of each array; a thread works on them, as a cluster would."""
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    arrays: list[list[int]] = []

    def submit(job: ArrayJob) -> str:
        def work() -> None:
            for task in job.tasks:
                monkeypatch.setenv("SHARDS_PER_TASK", str(job.per_task))
                monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
                find_executor("slurm", None, None).make(job.options, None)
            Path(job.options.place, "README.md").write_text("# A set")  # the last document

        arrays.append(list(job.tasks))
        threading.Thread(target=work).start()
        return "4711"

    monkeypatch.setattr(prefect_flows, "submit_slurm_array", submit)
    return arrays


def run(**given: Any) -> None:
    plain = {
        each.name: getattr(tiny_order(), each.name) for each in dataclasses.fields(GenerateOptions)
    }
    own = {name: DatasetByArray.__dataclass_fields__[name].default for name in _OWN}
    flow: Any = make_by_array
    checked = flow.validate_parameters(
        {**plain, **own, "changes": {"scenes": {"num_views": 2}}, **given}
    )
    flow.fn(**checked)


_OWN = set(DatasetByArray.__dataclass_fields__) - set(GenerateOptions.__dataclass_fields__)


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


def test_a_page_that_cannot_be_shown_does_not_end_an_array(
    shown: Shown,
    cluster: list[list[int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    _cannot_show(monkeypatch)
    run(out=str(tmp_path / "set"), scenes=4)
    assert [record.levelname for record in caplog.records].count("WARNING") == 1


def test_machines_are_those_of_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who may start a run chooses neither an image nor an account."""
    assert not _OWN & set(KubernetesOptions.__dataclass_fields__)
    assert options_from_environment() == KubernetesOptions()
    stated = tmp_path / "machines.json"
    monkeypatch.setenv("TRILIGHT_MACHINES", str(stated))
    stated.write_text(json.dumps({"where": "a-namespace", "cores": 4}))
    assert options_from_environment() == KubernetesOptions(where="a-namespace", cores=4)
    for text, message in (
        ("{", "cannot be read"),
        ('{"core": 4}', "core"),
        ('{"on_demand": true}', "removed since"),
    ):
        stated.write_text(text)
        with pytest.raises(TrilightError, match=message):
            options_from_environment()
