"""Rows on disk: read again, known by what decides them, and never of another set."""

from pathlib import Path

import pytest

from infra.leaderboard.rows import UNKNOWN_MACHINE, BoardRow, BoardRows, RowKey
from storage.errors import TrilightError
from tests.for_each import case

KEY = RowKey(width=64, scene="000000001", view=0, name="somebody", digest="d")
ROW = BoardRow(scores={"psnr_log_db": 30.0, "lpips": None}, first_s=0.5, further_s=0.25)


def test_rows_come_back_and_the_later_of_two_counts(tmp_path: Path) -> None:
    path = tmp_path / "board/rows.jsonl"
    rows = BoardRows(path, "set a")
    rows.add(KEY, BoardRow(scores={"psnr_log_db": 29.0}))
    rows.add(KEY, ROW)
    again = BoardRows(path, "set a")
    assert again.get(KEY) == rows.get(KEY) == ROW
    assert (
        again.get(RowKey(width=64, scene="000000001", view=0, name="somebody", digest="e")) is None
    )
    assert len(path.read_text().splitlines()) == 3
    # written before rows named their machine: a price of nowhere
    assert rows.price(KEY, "somewhere") is None and again.machines() == {UNKNOWN_MACHINE}


def test_a_line_that_a_kill_cut_short_is_judged_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    BoardRows(path, "set a").add(KEY, ROW)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"width": 64, "sce')
    rows = BoardRows(path, "set a")
    assert rows.get(KEY) == ROW and path.read_bytes() == whole
    path.write_bytes(whole[: whole.index(b"\n") + 20])
    assert BoardRows(path, "set a").get(KEY) is None
    assert path.read_bytes() == whole[: whole.index(b"\n") + 1]


OTHERS = [
    ('{"set": "another"}\n', r"are of the set another, and SOURCE is set a.*another --out"),
    ("nothing\n", "not the rows of a leaderboard.*another --out, or delete the file"),
    ('{"set": "set a"}\n{"width": 64}\n', "not the rows of a leaderboard"),
]


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    for text, said in OTHERS:
        with case(text):
            (tmp_path / "rows.jsonl").write_text(text)
            with pytest.raises(TrilightError, match=said):
                BoardRows(tmp_path / "rows.jsonl", "set a")
