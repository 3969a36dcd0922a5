"""The part of a page that a program writes."""

from pathlib import Path

import pytest

from infra.bench.pages import read_block, write_block
from storage.errors import TrilightError
from tests.for_each import case

BEGIN, END = "<!-- kind:begin -->", "<!-- kind:end -->"


def test_what_a_person_wrote_around_it_stays(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nof yesterday\n{END}\nafter\n")
    write_block(page, "kind", "of today\n")
    assert page.read_text() == f"before\n{BEGIN}\nof today\n{END}\nafter\n"
    assert read_block(page, "kind") == "of today\n"


def test_a_page_without_both_marks_is_left_alone(tmp_path: Path) -> None:
    for text in ["", f"{BEGIN}\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{END}\n" * 2]:
        with case(text):
            page = tmp_path / "page.md"
            page.write_text(text)
            with pytest.raises(TrilightError, match="expected one line"):
                write_block(page, "kind", "of today\n")
            assert page.read_text() == text
