"""The page of assets, and filters of a gallery: what there is, and no markup from outside."""

import dataclasses
import json
import re
import shlex

import numpy as np

from pipeline.documents.gallery_controls import (
    CardFacts,
    card_attributes,
    card_facts,
    gallery_controls,
)
from pipeline.documents.quality_page import Pair, encode_quality_page
from storage.records.asset import AssetRow
from storage.records.objects import Failure
from tests.pipeline.documents.dataset_by_hand import furnished, sample
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


def card(
    split: str, layout: str, *, views: str = "within the target", floor: float = 40
) -> CardFacts:
    choices = {"split": split, "layout": layout, "views": views}
    return CardFacts(choices=choices, orders={"least floor": floor, "few": -floor})


CARDS = [
    card("train", "plane", floor=44),
    card("train", "room", views="at the cap", floor=38),
    card("test", "plane", floor=41),
]


def buttons(markup: str) -> list[tuple[str, str, str]]:
    """Return name, value and option of each radio button."""
    return re.findall(r'name="([^"]*)" value="([^"]*)" data-words="([^"]*)"', markup)


def test_each_choice_has_a_button_and_what_selects_it() -> None:
    words = {value: words for _, value, words in buttons(gallery_controls(CARDS)) if words}
    assert words == {
        "train": "--split train",
        "test": "--split test",
        "plane": "--template plane",
        "room": "--template room",
        "within the target": "--where &#x27;not any(at_cap)&#x27;",
        "at the cap": "--where &#x27;any(at_cap)&#x27;",
    }
    values = [value for name, value, _ in buttons(gallery_controls(CARDS)) if name == "order"]
    assert values == ["", "0", "1"]


def test_each_card_bears_its_choices_and_ranks_and_equals_stay() -> None:
    attributes = card_attributes(CARDS)
    assert [each["data-layout"] for each in attributes] == ["plane", "room", "plane"]
    assert [json.loads(each["data-ranks"]) for each in attributes] == [[2, 0], [0, 2], [1, 1]]
    same = card_attributes([card("train", "plane", floor=float("inf"))] * 3)
    assert [json.loads(each["data-ranks"])[0] for each in same] == [0, 1, 2]


def test_scenes_of_no_layout_are_no_choice() -> None:
    """Such as those of scene files: no command selects them, and none claims to."""
    markup = gallery_controls([card("train", name) for name in ("", "plane", "room")])
    layouts = [value for name, value, _ in buttons(markup) if name == "layout"]
    assert layouts == ["", "plane", "room"]


def test_no_choice_no_button() -> None:
    for cards in ([], [card("train", "plane")]):
        assert buttons(gallery_controls(cards)) == []
        assert len(card_attributes(cards)) == len(cards)


def test_names_from_outside_stay_text() -> None:
    tags = read(gallery_controls([card("train", HARM), card("train", "a 'b'")]).encode())
    assert "script" not in tags.tags and "onerror" not in tags.names
    assert HARM in "".join(tags.text)
    quoted = [words for _, _, words in buttons(gallery_controls([card("train", HARM), *CARDS]))]
    assert f"--template {shlex.quote(HARM)}" in [html_text(words) for words in quoted]


def html_text(escaped: str) -> str:
    return "".join(read(f"<p>{escaped}</p>".encode()).text)


def test_what_a_card_knows() -> None:
    made = sample(3, furnished(["a", "b"]))
    facts = card_facts(made, "test")
    assert facts.choices == {
        "split": "test",
        "layout": made.scene.provenance["template"],
        "views": "within the target",
    }
    assert facts.orders["fewest triangles"] == made.scene.num_triangles
    capped = [dataclasses.replace(view, at_cap=True) for view in made.views]
    made = dataclasses.replace(made, views=tuple(capped))
    assert card_facts(made, "test").choices["views"] == "at the cap"
