"""What is shown of a run: where the report is, an honest rate, and never the end of the run."""

import base64
import io
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from pipeline.flows import watching
from pipeline.flows.prefect_runner import PrefectRunner
from pipeline.flows.watching import Watched, report_url, small_picture, usd_per_core_hour
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.run import TaskOutcome
from storage.errors import TrilightError
from tests.for_each import for_each


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


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, str]]]:
    """Key and rows of each table that is shown; there is no server."""
    shown: list[tuple[str, dict[str, str]]] = []

    def table(rows: list[dict[str, str]], key: str, description: str) -> None:
        shown.append((key, {row["what"]: row["value"] for row in rows}))

    monkeypatch.setattr(watching, "create_table_artifact", table)
    monkeypatch.setattr(watching, "create_progress_artifact", lambda *args, **named: "id")
    monkeypatch.setattr(watching, "update_progress_artifact", lambda *args: None)
    monkeypatch.setattr(watching, "get_run_logger", lambda: logging.getLogger("trilight.test"))
    return shown


def _task(scenes: int, seconds: float) -> TaskOutcome:
    return TaskOutcome(shards=(), scenes=scenes, seconds=seconds, core_s=seconds)


def test_a_page_that_cannot_be_shown_does_not_end_the_run(
    tables: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def gone(*args: object, **named: object) -> None:
        raise ConnectionError("gone")

    monkeypatch.setattr(watching, "create_progress_artifact", gone)
    monkeypatch.setattr(watching, "create_table_artifact", gone)
    watched = Watched(DatasetOrder(out=str(tmp_path)))
    watched.task_done(None, _task(1, 1.0))  # type: ignore[arg-type]
    watched.failed(ValueError("x"))
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_the_rate_begins_with_the_first_scene(
    tables: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An hour of preparing objects, then 4 scenes in 20 s."""
    now = 0.0
    monkeypatch.setattr(watching.time, "monotonic", lambda: now)
    watched = Watched(DatasetOrder(out=str(tmp_path)))
    assert watched.scenes_per_s() == 0
    now = 3620.0
    watched.task_done(None, _task(4, 20.0))  # type: ignore[arg-type]
    assert watched.scenes_per_s() == 4 / 20


def test_a_page_shows_the_scenes_and_where_their_report_is(
    tables: list[tuple[str, dict[str, str]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[str] = []
    monkeypatch.setattr(
        watching, "create_image_artifact", lambda url, **named: pictures.append(url)
    )
    monkeypatch.delenv("TRILIGHT_PUBLIC_URL", raising=False)
    out = tmp_path / "set"
    out.mkdir()
    Image.effect_noise((1200, 800), 80).save(out / "contact_sheet.png")
    statistics = SimpleNamespace(lines=lambda: [("views", "16")])
    outcome: Any = SimpleNamespace(
        num_shards=1, num_shards_planned=1, digest="d", statistics=statistics
    )
    Watched(DatasetOrder(out=str(out))).finished(outcome)
    ((_, rows),) = tables
    assert (rows["report"], rows["views"]) == (f"{out}/report.html", "16")
    (url,) = pictures
    assert url == small_picture(out / "contact_sheet.png")
    kind, _, data = url.partition(",")
    with Image.open(io.BytesIO(base64.b64decode(data))) as shown:
        assert (kind, shown.format, shown.size) == (
            "data:image/jpeg;base64", "JPEG", (1024, 683)
        )  # fmt: skip


def test_a_run_that_fails_says_so_in_its_summary(
    tables: list[tuple[str, dict[str, str]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise TrilightError("the disk is full of https://me:secret@host/x")

    monkeypatch.setattr(watching, "make_dataset", full)
    with pytest.raises(TrilightError):
        watching.make_watched(DatasetOrder(out=str(tmp_path)), PrefectRunner())
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
        Watched(DatasetOrder())
