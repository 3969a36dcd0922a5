"""`quality.html` shows what there is, and nothing that comes from outside is markup."""

import re

import numpy as np

from pipeline.documents.quality_page import Pair, encode_quality_page
from storage.records.asset import AssetRow
from storage.records.objects import Failure
from tests.pipeline.documents.pages_read import HARM, Tags, read, text_of
from tests.pipeline.documents.rows_by_hand import row


def failure(item: str = "bad", message: str = "a sentence") -> Failure:
    return Failure(stage="assets", item=item, reason="no_faces", message=message)


def pairs(entry: AssetRow) -> dict[str, list[Pair]]:
    picture = np.full((8, 8), 128, np.uint8)
    return {"Worst": [Pair(row=entry, source=picture, result=picture)], "Best": []}


def page(rows: list[AssetRow], failures: list[Failure], **more: dict[str, list[Pair]]) -> Tags:
    shown = more.get("pairs", {})
    return read(encode_quality_page(rows, failures, shown, budget=1400, target="faithful"))


RIGHTS = {"licence": HARM, "attribution": HARM, "source_url": "javascript:alert(3)"}
HARMFUL = row(HARM, title=HARM, method="pymeshlab_collapse", **RIGHTS)


def test_text_from_outside_stays_text() -> None:
    tags = page([HARMFUL], [failure(HARM, HARM)], pairs=pairs(HARMFUL))
    assert not {"script", "iframe", "link", "a", "object"} & set(tags.tags)
    assert not any(name.startswith("on") for name in tags.names)
    # uid in picture and table, licence in summary and table, item and message of the failure
    assert "".join(tags.text).count(HARM) == 6


def test_nothing_is_loaded_from_elsewhere() -> None:
    shown = pairs(HARMFUL)
    data = encode_quality_page([HARMFUL, row()], [failure()], shown, budget=1400, target="x")
    assert not re.search(rb"https?:|javascript:|<script|@import|url\(", data)
    links = read(data).links
    assert len(links) == 3
    assert all(link.startswith("data:image/png;base64,") for link in links)


def test_counts_are_those_of_the_rows() -> None:
    tags = page([row("a"), row("b")], [failure()])
    text = text_of(tags)
    assert "2 objects accepted, 0 of them repaired" in text
    assert "2 watertight; 1 rejected" in text
    assert "CC0-1.0 (2)" in text
    assert tags.tags.count("tr") == 2 + 3


def test_a_page_without_objects() -> None:
    for failures in ([], [failure("bad0"), failure("bad1")]):
        tags = page([], failures)
        text = text_of(tags)
        assert "0 objects accepted, 0 of them repaired" in text
        assert f"0 watertight; {len(failures)} rejected" in text
        assert "Licences: none" in text
        assert "img" not in tags.tags
        assert ("Rejected" in text) == bool(failures)


def test_a_page_without_failures_and_with_decimated_objects_only() -> None:
    tags = page([row(str(k), method="meshoptimizer") for k in range(3)], [])
    assert tags.tags.count("img") == 1
    assert "Rejected" not in " ".join(tags.text)


def test_equal_rows_give_equal_pages() -> None:
    twice = [encode_quality_page([row()], [], {}, budget=9, target="x") for _ in range(2)]
    assert twice[0] == twice[1]
