"""Flows: forms of every setting, who makes a dataset's parts, and what is shown of a run."""

import base64
import contextlib
import dataclasses
import io
import json
import logging
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
from PIL import Image
from prefect.exceptions import ParameterTypeError
from prefect.utilities.schema_tools.validation import is_valid_schema

from infra.serving.train_model import train_model
from pipeline.executors.registry import find_executor
from pipeline.executors.slurm_and_kubernetes import (
    ArrayJob,
    DatasetByArray,
    KubernetesOptions,
    options_from_environment,
)
from pipeline.flows import flow_executors, prefect_flows, prefect_runner
from pipeline.flows.forms import DatasetInRuns, DatasetOverrides, changed_values, options_of_form
from pipeline.flows.prefect_flows import (
    build_dataset,
    generate_scenes,
    make_by_array,
    prepare_assets,
)
from pipeline.flows.prefect_runner import (
    PrefectRunner,
    RunPage,
    is_retryable,
    make_with_page,
    report_url,
    small_picture,
    usd_per_core_hour,
)
from pipeline.flows.prefect_server import GPU_LIMIT, run_to_end
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import TaskResult, shard_ranges
from pipeline.presets.settings import DatasetSettings
from storage.dataset.progress import read_status
from storage.errors import EnvironmentFailure, TrilightError
from tests.for_each import case, for_each
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

CANARY = "CANARY-7f3a"
FLOWS = {
    "prepare-assets": prepare_assets,
    "generate-scenes": generate_scenes,
    "build-dataset": build_dataset,
    "make-by-array": make_by_array,
    "train-model": train_model,
}


def _parameters(kind: Any = GenerateOptions, **given: Any) -> dict[str, Any]:
    """Return the parameters of a flow that takes the options of a class."""
    plain = {name: getattr(kind(), name) for name in kind.__dataclass_fields__}
    return {**plain, "changes": None, **given}


@for_each("name", FLOWS)
def test_every_parameter_has_a_sentence_and_a_default(name: str) -> None:
    flow = FLOWS[name]
    assert flow.name == name
    assert flow.parameters.properties
    for parameter, schema in flow.parameters.properties.items():
        assert len(schema["description"]) > 10, parameter
        assert "default" in schema, parameter
    assert not flow.parameters.required
    is_valid_schema(flow.parameters.model_dump())  # as the server asks when it is deployed


def test_the_forms_within_have_every_setting_of_a_build_and_its_range() -> None:
    schema = generate_scenes.parameters.model_dump()
    groups = schema["definitions"]
    renders = groups["RenderSettingsChanges"]["properties"]
    assert renders["max_spp"]["description"].startswith("The cap")
    assert renders["denoiser"]["anyOf"][0]["enum"] == ["high", "fast", "off"]
    settings = groups["DatasetSettingsChanges"]["properties"]
    assert set(settings) == set(DatasetSettings.__dataclass_fields__)
    # As declared at the fields, but for what no form can hold exactly.
    shown = schema["properties"]
    assert shown["scenes"]["anyOf"][0] == {"type": "integer", "minimum": 1, "maximum": 10**9}
    assert shown["seed"]["anyOf"][0] == {"type": "integer", "minimum": 0}
    assert (shown["failure_budget"]["minimum"], shown["failure_budget"]["maximum"]) == (0, 1)
    cameras = schema["definitions"]["CameraSettingsChanges"]["properties"]
    assert cameras["fov_deg"]["anyOf"][0]["items"] == {
        "type": "number", "minimum": 1, "maximum": 170,
    }  # fmt: skip
    assert train_model.parameters.properties["processes"]["maximum"] == 1024


def test_changes_become_dotted_names() -> None:
    form = DatasetOverrides(**{"renders": {"max_spp": 64}, "storage": {"profile": "lossless"}})
    expected = {"renders.max_spp": 64, "storage.profile": "lossless"}
    assert changed_values(form) == expected
    order = options_of_form(_parameters(scenes=3, changes=form), GenerateOptions)
    assert order == GenerateOptions(scenes=3, changes=expected)
    assert options_of_form(_parameters(), GenerateOptions) == GenerateOptions()


def test_wrong_values_are_refused_by_name() -> None:
    rows: list[tuple[dict[str, Any], str]] = [
        ({"build": "nonsense"}, "build"),
        ({"scenes": "many"}, "scenes"),
        ({"scenes": 0}, "scenes"),
        (
            {"changes": {"scenes": {"cameras": {"fov_deg": [30, 171]}}}},
            "fov_deg: expected numbers from 1 to 170 degrees",
        ),
        ({"changes": {"renders": {"most_spp": 4}}}, "changes.renders.most_spp"),
        ({"changes": {"renders": {"denoiser": "best"}}}, "changes.renders.denoiser"),
    ]
    for parameters, message in rows:
        with case(parameters), pytest.raises(ParameterTypeError, match=message):
            generate_scenes.validate_parameters(parameters)


def test_secrets_are_refused_before_a_run_exists() -> None:
    """The server checks the same schema when a run is made, so that it never stores one."""
    for source in (
        f"https://user:{CANARY}@host/folder",
        f"https://host/folder?token={CANARY}",
        "env:PATH",
        "env:AWS_SECRET_ACCESS_KEY",
        "env:TRILIGHT_SOURCE_A/x",
    ):
        with case(source), pytest.raises(ParameterTypeError, match="objects"):
            generate_scenes.validate_parameters({"objects": source})
        for parameter, given in (("data", [source]), ("begin_with", source), ("lpips", source)):
            with case(source), pytest.raises(ParameterTypeError, match=parameter):
                train_model.validate_parameters({parameter: given})
    known = (
        "builtin:500",
        "procedural:5",
        "https://host/folder",
        "s3://b/f",
        "env:TRILIGHT_SOURCE_A",
        "a/b c",
    )
    for harmless in (*known, None):
        generate_scenes.validate_parameters({"objects": harmless})


@for_each("name", ["prepare-assets", "generate-scenes", "build-dataset"])
def test_a_place_to_write_to_holds_no_secret(name: str) -> None:
    for out in (f"s3://me:{CANARY}@bucket/set", f"s3://bucket/set?key={CANARY}"):
        with pytest.raises(ParameterTypeError, match="out"):
            FLOWS[name].validate_parameters({"out": out})
    for out in ("data/set", "/d/2026-01-01T10:30/a", "a:/b", "C:", "s3://bucket/a b/set", "gs://b"):
        FLOWS[name].validate_parameters({"out": out})


def test_only_what_can_pass_is_tried_again_documents_too() -> None:
    errors = (EnvironmentFailure("disk"), OSError("gone"), TrilightError("wrong"), KeyError())
    for error, again in zip(errors, (True, True, False, False), strict=True):
        ended: Any = Future()
        ended.set_exception(error)
        assert is_retryable(cast(Any, None), cast(Any, None), ended) == again
    task = cast(Any, prefect_runner.write_documents_task)
    assert task.retries == cast(Any, prefect_runner.make_scenes).retries > 0
    assert task.retry_condition_fn is prefect_runner.is_retryable


def test_so_many_flow_runs_are_so_many_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str | None] = []

    def started(deployment: str, *, parameters: dict[str, Any], **options: Any) -> None:
        made.append(f"{deployment} {parameters['shards']}")

    for name, stand_in in (
        ("prepare_assets", lambda **given: None),
        ("read_status", lambda out: SimpleNamespace(shards_planned=10)),
        ("run_deployment", started),
        ("generate_scenes", lambda **given: made.append(given["shards"])),
    ):
        monkeypatch.setattr(prefect_flows, name, stand_in)
    flow: Any = prefect_flows.build_dataset
    flow.fn(**_parameters(DatasetInRuns, flow_runs=3, deployment="d/x"))
    assert made == ["d/x 3:6", "d/x 6:10", "0:3", None]
    made.clear()
    flow.fn(**_parameters(DatasetInRuns))
    assert made == [None]
    assert shard_ranges(2, 5) == ["0:1", "1:2"], "no more ranges than shards"


def test_numbers_of_runs_and_places_that_cannot_be_are_named() -> None:
    """Before anything is begun: a flow makes its order first."""
    rows: list[tuple[type, dict[str, Any], str]] = [
        (DatasetInRuns, {"flow_runs": 0}, "flow_runs is 0; expected a whole number from 1"),
        (DatasetInRuns, {"flow_runs": 10**6}, "flow_runs is 1000000"),
        (DatasetInRuns, {"shards": "0:2"}, "shards is '0:2'; expected no range"),
        *((GenerateOptions, {"out": out}, f"^out '{out}'")
          for out in ("https://host/set", "hf://datasets/ada/set", "ftp://host/set")),
    ]  # fmt: skip
    for kind, given, message in rows:
        with case(given), pytest.raises(TrilightError, match=message):
            options_of_form(_parameters(kind, **given), kind)


@for_each(("device", "held"), [("gpu", [1]), ("cpu", [])])
def test_rendering_on_a_gpu_takes_its_limit(
    monkeypatch: pytest.MonkeyPatch, device: str, held: list[int]
) -> None:
    taken: list[int] = []

    @contextlib.contextmanager
    def limit(name: str, *, occupy: int, strict: bool) -> Iterator[None]:
        assert name == GPU_LIMIT
        taken.append(occupy)
        yield

    monkeypatch.setattr(prefect_runner, "concurrency", limit)
    monkeypatch.setattr(prefect_runner, "make_task", lambda job, pieces: (job, pieces, list(taken)))
    monkeypatch.setattr(
        prefect_runner.make_scenes, "submit", cast(Any, prefect_runner.make_scenes).fn
    )
    job, pieces = SimpleNamespace(device=device), (SimpleNamespace(shard_index=0, first=0),)
    submit = cast(Any, prefect_runner.PrefectRunner().submit)
    assert submit(pieces, job) == (job, pieces, held)


def test_a_dask_worker_that_sees_another_folder_and_a_silent_scheduler_are_named(
    tmp_path: Path,
) -> None:
    """Before any work; there are two workers, of which the second is on another machine."""
    order = GenerateOptions(out=str(tmp_path / "set"))
    client: Any = Mock()
    client.run = lambda look, *more: {"tcp://a:1": look(*more), "tcp://b:1": False}
    with pytest.raises(TrilightError, match="1 of 2 Dask workers do not see.*such as tcp://b:1"):
        flow_executors._require_shared(client, order)
    assert list((tmp_path / "set" / ".staging").iterdir()) == []
    pytest.importorskip("distributed", reason="needs the package distributed (setup-all)")
    said = "--address http://127.0.0.1:1: no Dask scheduler"
    with pytest.raises(TrilightError, match=said), flow_executors._client("http://127.0.0.1:1"):
        pass


SAVES = """
import signal, sys, time
from pathlib import Path
told = []
signal.signal(signal.SIGTERM, lambda *_: told.append(1))
print("begun", flush=True)
while not told:
    time.sleep(0.01)
print("x" * 200_000, flush=True)  # more than a pipe holds
time.sleep(0.3)
Path(sys.argv[1]).write_text(str(len(told)))
"""


class Cancelled(BaseException):
    """As Prefect raises it for a SIGTERM."""


def test_what_is_cancelled_saves_and_status_and_lines_are_passed_on(tmp_path: Path) -> None:
    cancel = Mock(side_effect=Cancelled)
    with pytest.raises(Cancelled):
        run_to_end([sys.executable, "-c", SAVES, str(tmp_path / "saved")], cancel)
    assert (tmp_path / "saved").read_text() == "1"
    lines: list[str] = []
    program = "import os, sys; print('a'); print(os.getpgid(0) == os.getpid()); sys.exit(3)"
    assert run_to_end([sys.executable, "-c", program], lines.append) == (3, "True")
    assert lines == ["a", "True"]
    ended = run_to_end([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"], lines.append)
    assert ended == (-signal.SIGKILL, "")


def test_the_link_to_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRILIGHT_PUBLIC_URL", "")
    assert report_url("data/mine") is None  # a link that leads nowhere is none
    monkeypatch.setenv("TRILIGHT_PUBLIC_URL", "https://data.example/sets/")
    assert report_url("data/mine") == "https://data.example/sets/mine/report.html"


Shown = list[tuple[str, dict[str, str]]]


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """Key and rows of each table; there is no server, and a dataset is looked at all the time."""
    shown: Shown = []

    def table(rows: list[dict[str, str]], key: str, description: str) -> None:
        shown.append((key, {row["what"]: row["value"] for row in rows}))

    module = prefect_runner
    monkeypatch.setattr(module, "create_table_artifact", table)
    monkeypatch.setattr(module, "create_progress_artifact", lambda *args, **named: "id")
    monkeypatch.setattr(module, "update_progress_artifact", lambda *args: None)
    monkeypatch.setattr(module, "create_image_artifact", lambda *args, **named: None)
    monkeypatch.setattr(prefect_flows, "LOOK_S", 0.01)
    for each in (module, prefect_flows):
        monkeypatch.setattr(each, "get_run_logger", lambda: logging.getLogger("trilight.test"))
    return shown


def test_a_page_shows_the_progress_the_scenes_and_where_their_report_is(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[str] = []
    monkeypatch.setattr(
        prefect_runner, "create_image_artifact", lambda url, **named: pictures.append(url)
    )
    monkeypatch.delenv("TRILIGHT_PUBLIC_URL", raising=False)
    without_rendering(monkeypatch)
    out = tmp_path / "set"
    make_with_page(tiny_order(out=str(out), scenes=8), Undocumented())
    assert [key for key, _ in tables] == ["progress", "summary"]  # the second task: too soon
    assert (tables[0][1]["shards"], tables[0][1]["scenes in shards"]) == ("1 of 2", "4 of 8")
    assert tables[1][1]["shards"] == "2 of 2"
    assert "core-hours" in tables[1][1]["cost"]
    (out / "README.md").write_text("# A set")  # the last document
    Image.effect_noise((1200, 800), 80).save(out / "contact_sheet.png")
    statistics: Any = SimpleNamespace(lines=lambda: [("views", "16")])
    RunPage(str(out)).show_result(statistics)
    rows = tables[-1][1]
    assert (rows["report"], rows["views"]) == (f"{out}/report.html", "16")
    assert len(rows["dataset digest"]) > 8
    url = pictures[-1]
    assert url == small_picture(out / "contact_sheet.png")
    kind, _, data = url.partition(",")
    with Image.open(io.BytesIO(base64.b64decode(data))) as shown:
        assert (kind, shown.format, shown.size) == (
            "data:image/jpeg;base64", "JPEG", (1024, 683)
        )  # fmt: skip


def test_a_run_of_a_range_shows_its_own_shards_and_cost(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rendering(monkeypatch)
    order = tiny_order(out=str(tmp_path / "set"), scenes=16)
    make_with_page(order, Undocumented())
    for log in (tmp_path / "set/logs").rglob("*.jsonl"):  # the other shards cost many hours
        rows = [json.loads(line) | {"seconds": 36000.0} for line in log.read_text().splitlines()]
        log.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    assert (read_status(order.place).core_hours or 0) > 10
    make_with_page(dataclasses.replace(order, scenes=24, shards="4:6"), Undocumented())
    (_, progress), (_, summary) = tables[-2:]
    assert (progress["shards"], progress["scenes in shards"]) == ("1 of 2", "4 of 8")
    assert summary["shards"] == "2 of 2"
    assert float(summary["cost"].split()[0]) < 0.5


def test_a_run_that_fails_says_so_in_its_summary(
    tables: Shown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Mock(side_effect=TrilightError("the disk is full of https://me:secret@host/x"))
    monkeypatch.setattr(prefect_runner, "make_dataset", full)
    with pytest.raises(TrilightError):
        make_with_page(GenerateOptions(out=str(tmp_path)), PrefectRunner())
    ((key, rows),) = tables
    assert key == "summary"
    assert rows["failed"].startswith("TrilightError: the disk is full")
    assert "secret" not in rows["failed"]
    assert rows["scenes of this run"] == "0" and "core-hours" in rows["cost of this run"]


@for_each("text", ["cheap", "-1", "nan", "inf", ""])
def test_a_price_that_is_none_is_named_at_the_start(
    monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.setenv("TRILIGHT_USD_PER_CORE_HOUR", "0.5")
    assert usd_per_core_hour() == 0.5
    monkeypatch.setenv("TRILIGHT_USD_PER_CORE_HOUR", text)
    with pytest.raises(TrilightError, match=rf"TRILIGHT_USD_PER_CORE_HOUR is '{text}'; expected"):
        RunPage("data/smoke")


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The tasks of each array; a thread works on them, as a cluster would."""
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    arrays: list[list[int]] = []

    def submit(job: ArrayJob) -> tuple[str, str]:
        def work() -> None:
            for task in job.tasks:
                monkeypatch.setenv("SHARDS_PER_TASK", str(job.per_task))
                monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
                find_executor("slurm", None, None).make(job.options, None)
            Path(job.options.place, "README.md").write_text("# A set")  # the last document

        arrays.append(list(job.tasks))
        threading.Thread(target=work).start()
        return "4711", "sbatch"

    monkeypatch.setattr(prefect_flows, "submit_slurm_array", submit)
    return arrays


def run(**given: Any) -> None:
    flow: Any = make_by_array
    tiny = {"resolution": 16, "changes": {"scenes": {"num_views": 2}}}
    flow.fn(**flow.validate_parameters(_parameters(DatasetByArray, **tiny, **given)))


def test_what_is_missing_is_asked_for_and_shown_to_the_end(
    tables: Shown, cluster: list[list[int]], tmp_path: Path
) -> None:
    with pytest.raises(TrilightError, match=r"no new scene for 0\.0001 hours \(none made\)"):
        run(out=str(tmp_path / "watched"), scheduler="none", quiet_hours=0.0001)
    assert cluster == [] and tables == [], "who watches alone asks for nothing"
    out = str(tmp_path / "set")
    run(out=out, scenes=20, shards_per_task=2)
    assert cluster == [[0, 1, 2]]
    key, summary = tables[-1]
    assert key == "summary" and summary["shards"] == "5 of 5" and len(summary["dataset digest"]) > 8
    assert all(key == "progress" for key, _ in tables[:-1])
    run(out=out, scenes=20, shards_per_task=2)
    assert len(cluster) == 1, "nothing is missing"
    (tmp_path / "set" / "train-000003.tar").unlink()
    run(out=out, scenes=20, shards_per_task=2)
    assert cluster[1:] == [[1]], "the task of the shard that is gone"
    assert (tmp_path / "set" / "train-000003.tar").exists()


@pytest.mark.usefixtures("tables", "cluster")
def test_a_page_that_cannot_be_shown_ends_neither_a_run_nor_an_array(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    gone = Mock(side_effect=ConnectionError("gone"))
    monkeypatch.setattr(prefect_runner, "create_progress_artifact", gone)
    monkeypatch.setattr(prefect_runner, "create_table_artifact", gone)
    page = RunPage(str(tmp_path))
    page.record_task(cast(Any, None), TaskResult(shards=(), scenes=1, seconds=1.0, core_s=1.0))
    page.show_failure(ValueError("x"))
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    caplog.clear()
    run(out=str(tmp_path / "set"), scenes=4)
    assert [record.levelname for record in caplog.records].count("WARNING") == 1


def test_machines_are_those_of_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who may start a run chooses neither an image nor an account."""
    own = set(DatasetByArray.__dataclass_fields__) - set(GenerateOptions.__dataclass_fields__)
    assert not own & set(KubernetesOptions.__dataclass_fields__)
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
