"""Costs of this machine win where they are whole and its own; else a sentence says why not."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from infra.rendering.way_table import (
    MEASURE,
    PictureCosts,
    keep_machine_costs,
    known_costs,
    machine_costs_path,
    machine_name,
    shipped_table,
)
from pipeline.renders.variant import Variant
from storage.settings.described import settings_record
from tests.for_each import case

VARIANT = Variant(name="llvm_ad_rgb", libllvm="", note="")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    return tmp_path


def costs_of_here() -> PictureCosts:
    shipped = shipped_table().costs
    slower = [dataclasses.replace(row, serial_s=row.serial_s + 1) for row in shipped.rows]
    return PictureCosts(machine=machine_name(VARIANT), rows=tuple(slower))


def test_without_a_file_costs_are_shipped() -> None:
    found = known_costs(VARIANT)
    assert found.costs == shipped_table().costs
    assert f"costs as shipped: `{MEASURE}` measures this machine" == found.source


def test_costs_that_were_measured_here_win(cache: Path) -> None:
    path = keep_machine_costs(costs_of_here())
    assert path == machine_costs_path() and path.is_relative_to(cache)
    found = known_costs(VARIANT)
    assert found.costs == costs_of_here()
    assert found.source == "costs as measured here"


def test_costs_of_another_machine_are_not_used() -> None:
    keep_machine_costs(dataclasses.replace(costs_of_here(), machine="another, 128 cores"))
    found = known_costs(VARIANT)
    assert found.costs == shipped_table().costs
    assert "is of another machine (another, 128 cores)" in found.source
    keep_machine_costs(costs_of_here())
    card = dataclasses.replace(VARIANT, name="cuda_ad_rgb")
    assert "of another machine" in known_costs(card).source, "a graphics card is another machine"


def _record(**changes: Any) -> bytes:
    return json.dumps(settings_record(costs_of_here()) | changes).encode()


DAMAGED = [
    (b"", "Expecting value"),
    (b"\xff\xfe", ""),
    (b"[1, 2]", "expected"),
    (_record()[:-40], ""),
    (_record(rows=[]), "is missing; expected each part at each width"),
    (_record(rows=[{"part": "scene"}]), "is missing"),
    (_record().replace(b'"width": 64', b'"width": 63.5', 1), "expected a whole number"),
    (_record().replace(b'"serial_s": 1', b'"serial_s": -1', 1), "expected a number from 0"),
    (_record().replace(b'"serial_s": 1.0,', b'"serial_s": NaN,', 1), "expected"),
    (_record(more=1), "does not exist"),
]


def test_damaged_costs_are_not_used() -> None:
    for data, said in DAMAGED:
        with case(said):
            path = machine_costs_path()
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            found = known_costs(VARIANT)
            assert found.costs == shipped_table().costs
            assert f"since {path} cannot be used" in found.source and said in found.source
            assert f"`{MEASURE}` writes it anew" in found.source
            assert "\n" not in found.source


def test_a_folder_in_the_place_of_the_file_is_not_used() -> None:
    machine_costs_path().mkdir(parents=True)
    assert "cannot be used" in known_costs(VARIANT).source
