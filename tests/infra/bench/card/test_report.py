"""The file of `bench card`: made on the processor, read again, and told whoever wrote it."""

import dataclasses
import getpass
import json
import os
import platform
from pathlib import Path
from typing import Any

import pytest
import torch

from infra.bench.card import report
from infra.bench.card.effort import PROCESSOR
from infra.bench.card.report import measured_card, read_report, write_report
from infra.bench.card.step_profile import REST
from infra.bench.card.table import RUN_NAMES, facts, markdown_of, run_rows
from infra.doctor import CHECKS, Finding
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.train.toy import write_toy_dataset

SHORT = dataclasses.replace(
    PROCESSOR, steps=1, warm_steps=0, scenes=1, picture_px=32, noise_floor_db=20.0, loader_s=0.05,
    copied_mib=1, product_width=64,
)  # fmt: skip
CPU = torch.device("cpu")


def record(patch: pytest.MonkeyPatch, data: Path) -> dict[str, Any]:
    """Return what is measured with one run, but for the slow doctor and the rendering."""
    found = Finding(name="cache", state="ok", found=f"{Path.home()}/.cache of {platform.node()}")

    def nothing(*_: object) -> None:
        raise TrilightError("renderer: none here")

    patch.setattr(report, "examine", lambda _: [found])
    patch.setattr(report, "rendered_scenes", nothing)
    return measured_card(CPU, SHORT, data=str(data), runs=["smoke"])


def test_what_is_measured_is_one_file_without_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    data = write_toy_dataset(tmp_path / "set", train=16, validation=0).folder.root
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    found = record(monkeypatch, data)
    write_report(found, path := tmp_path / "card.json")
    assert read_report(path) == json.loads(path.read_text())
    text = path.read_text()
    assert str(Path.home()) not in text and str(tmp_path) not in text
    names = {platform.node(), getpass.getuser()} - {"localhost", "root", ""}
    assert not any(name in text for name in names if len(name) > 2)
    assert found["rendering"] == {"failed": "TrilightError: renderer: none here"}
    assert [row["threads"] for row in found["reading"]] == [1, 2]
    assert all(row["samples_per_s"] > 0 for row in found["reading"])
    assert {row["network"]: row["db"] > 60 for row in found["pictures"]} == {
        "builtin:tokens": True,
        "builtin:hits": True,
    }
    (run,) = found["runs"]
    flops = found["products"]["float32"]
    assert run["least_ms"] == pytest.approx(1e15 * run["teraflop"] / flops, rel=1e-3)
    _is_of_its_steps(run)
    assert dict(facts(found))["card"] == "none"
    assert "dB to its stored twin" in dict(facts(found))["builtin:hits float32"]
    told = trilight(["bench", "card", str(path)])
    assert told.exit_code == 0 and "Steps of named runs" in told.stdout


def _is_of_its_steps(run: dict[str, Any]) -> None:
    assert (run["scenes"], run["asked_scenes"], run["skipped_steps"]) == (2, 2, 0)
    assert len(run["step_ms"]) == 1 and run["step_ms"][0] > 0 and run["peak_gib"] is None
    profile = run["profile"]
    parts = {"encoder", "decoder layers", "head", "loss", "optimiser", REST}
    assert set(profile["by_part_ms"]) == parts and min(profile["by_part_ms"].values()) >= 0
    assert sum(profile["by_kind_ms"].values()) == pytest.approx(profile["total_ms"], rel=1e-3)
    assert profile["by_kind_ms"]["product"] > 0 and profile["by_kind_ms"]["attention"] > 0
    assert profile["kernels"] > 1000


@pytest.mark.slow("benchmarks")
def test_the_command_measures_all_on_a_processor(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(report, "PROCESSOR", dataclasses.replace(SHORT, scenes=2))
    monkeypatch.setattr(report, "RUNS", Two())
    out = tmp_path / "mine.json"
    done = trilight(["bench", "card", "--out", str(out)])
    assert done.exit_code == 0, done.stderr
    assert "no card: numbers of the CPU" in done.stdout and "To send it" in done.stdout
    found = read_report(out)
    assert [row["run"] for row in found["runs"]] == ["hits", "paper-pretrain"]
    assert all("failed" not in row for row in found["runs"])
    assert found["rendering"]["views_an_hour"] > 0
    assert all(row["samples_per_s"] > 0 for row in found["reading"])
    assert len(found["doctor"]) == len(CHECKS) and "failed" not in found["pictures"]


class Two(list[str]):
    """Two runs in place of all."""

    def __init__(self) -> None:
        super().__init__(["hits", "paper-pretrain"])

    def is_ours(self, name: str) -> bool:
        return name in self


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "schema None; expected one that `trilight bench card` wrote"),
        ("[" * 100_000, "schema nothing"),
        ('{"schema": "trilight-card", "version": 9}', "version 9; expected 1"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (path := tmp_path / "x.json").write_text(text)
    with pytest.raises(TrilightError, match=message):
        read_report(path)
    with pytest.raises(TrilightError, match="No such file"):
        read_report(tmp_path / "none.json")


def test_anybodys_file_is_told_in_plain_words() -> None:
    """What a page would take for its own is not passed on, and nonsense is not a number."""
    hostile = {
        "date": "<script>|",
        "card": {"name": "H100 | <img src=x onerror=y> `a` [b](c)" + "x" * 900, "memory_gib": "no"},
        "pictures": "nothing",
        "products": {"float32": True, "a|b": 1e15},
        "reading": [{"samples_per_s": [], "threads": 1e400}, 7],
        "runs": [
            {"run": "a\nb", "scenes": 4, "asked_scenes": 16, "step_ms": [3, "x", 1], "profile": []},
            {"run": "c", "failed": "<b>|"},
            *[{}] * 200,
        ],
    }
    assert "x" * 100 not in "".join(value for _, value in facts(hostile))
    lines = list(markdown_of([hostile]))
    assert len(lines) == 2 + 100
    for line in lines[2:]:
        assert line.count("|") == len(RUN_NAMES) + 3
        assert not set("<>`[]\n") & set(line)
    first, second, *_ = run_rows(hostile)
    assert first[:3] == ["a b", "4 of 16: memory", "2"] and second[1] == "not measured: b"
