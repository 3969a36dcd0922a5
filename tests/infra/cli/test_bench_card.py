"""`trilight bench card FILES --write-docs`: files are kept, and the page tells of all of them."""

import json
from pathlib import Path
from typing import Any

import pytest

from infra.bench import machine
from infra.bench.pages import read_block
from infra.cli.bench_card import BLOCK, PAGE, RECEIVED
from tests.command_line import trilight
from tests.conftest import ROOT


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a checkout with nothing but the page, before anything was received."""
    root = tmp_path / "checkout"
    (root / PAGE).parent.mkdir(parents=True)
    block = f"<!-- {BLOCK}:begin -->\nNobody has sent one yet.\n<!-- {BLOCK}:end -->"
    (root / PAGE).write_text(f"# A card\n\n{block}\n\nEnd.\n")
    monkeypatch.setattr(machine, "ROOT", root)
    return root


def received(path: Path, card: str, step_ms: float, date: str = "2026-11-25") -> Path:
    run: dict[str, Any] = {"run": "hits", "scenes": 16, "asked_scenes": 16, "step_ms": [step_ms]}
    record = {"schema": "trilight-card", "version": 1, "date": date, "card": {"name": card}}
    path.write_text(json.dumps({**record, "runs": [run]}))
    return path


def written(*paths: Path) -> Any:
    return trilight(["bench", "card", *map(str, paths), "--write-docs"])


def test_files_are_kept_and_the_page_tells_of_all_that_are_there(
    checkout: Path, tmp_path: Path
) -> None:
    first = received(tmp_path / "a.json", "Card A/1", 41.0)
    assert written(first).exit_code == 0
    kept = checkout / RECEIVED / "card-a-1-2026-11-25.json"
    assert kept.read_bytes() == first.read_bytes()
    done = written(kept, received(tmp_path / "b.json", "Card B", 17.0))
    assert done.exit_code == 0 and f"2 files in {RECEIVED}" in done.stdout
    rows = read_block(checkout / PAGE, BLOCK).splitlines()[2:]
    cells = [[cell.strip() for cell in row.split("|")[1:5]] for row in rows]
    assert cells == [["Card A 1", "hits", "16", "41"], ["Card B", "hits", "16", "17"]]
    page = (checkout / PAGE).read_text()
    assert page.startswith("# A card\n") and page.endswith("\n\nEnd.\n") and "Nobody" not in page


def test_a_kept_file_is_not_replaced_by_another_of_its_name(checkout: Path, tmp_path: Path) -> None:
    assert written(received(tmp_path / "a.json", "Card", 41.0)).exit_code == 0
    page = (checkout / PAGE).read_text()
    refused = written(received(tmp_path / "b.json", "Card", 17.0))
    assert refused.exit_code == 1 and "is there already" in str(refused.exception)
    assert json.loads((checkout / RECEIVED / "card-2026-11-25.json").read_text())["runs"][0][
        "step_ms"
    ] == [41.0]
    assert (checkout / PAGE).read_text() == page


def test_the_page_of_the_project_has_its_block() -> None:
    assert read_block(ROOT / PAGE, BLOCK)
