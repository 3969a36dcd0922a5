"""What holds for every page: no markup from outside, nothing loaded, one script."""

import base64
import dataclasses
import hashlib
import html
import json
import re
import shlex

import numpy as np

from pipeline.documents.gallery import Card, gallery_filters, make_card
from pipeline.documents.pages import is_address, render_page
from pipeline.documents.quality_page import Pair, encode_quality_page
from storage.conventions import preview_gain, preview_srgb8
from storage.records.asset import AssetRow, OwnMaterials
from storage.records.objects import Failure
from tests.pipeline.documents.dataset_by_hand import furnished, sample
from tests.pipeline.documents.pages_read import HARM, Tags, read, text_of
from tests.pipeline.documents.rows_by_hand import row


def failure(item: str = "bad", message: str = "a sentence") -> Failure:
    return Failure(stage="assets", item=item, reason="no_faces", message=message)


def pairs(entry: AssetRow) -> dict[str, list[Pair]]:
    picture = np.full((8, 8), 128, np.uint8)
    return {"Worst": [Pair(row=entry, source=picture, result=picture)], "Best": []}


def quality_page(
    rows: list[AssetRow], failures: list[Failure], **more: dict[str, list[Pair]]
) -> Tags:
    shown = more.get("pairs", {})
    return read(encode_quality_page(rows, failures, shown, budget=1400, target="faithful"))


RIGHTS = {"licence": HARM, "attribution": HARM, "source_url": "javascript:alert(3)"}
HARMFUL = row(HARM, title=HARM, method="pymeshlab_collapse", **RIGHTS)


def test_text_from_outside_stays_text_and_nothing_is_loaded_from_elsewhere() -> None:
    shown = pairs(HARMFUL)
    failures = [failure(HARM, HARM)]
    data = encode_quality_page([HARMFUL, row()], failures, shown, budget=1400, target="x")
    plain = data.replace(html.escape(HARM).encode(), b"")
    assert not re.search(rb"https?:|javascript:|<script|@import|url\(", plain)
    tags = read(data)
    assert len(tags.links) == 3
    assert all(link.startswith("data:image/png;base64,") for link in tags.links)
    assert not {"script", "iframe", "link", "a", "object"} & set(tags.tags)
    assert not any(name.startswith("on") for name in tags.names)
    # uid in picture and table, licence in summary and table, item and message of the failure
    assert "".join(tags.text).count(HARM) == 6


def test_whose_materials_an_object_has_is_told_where_it_was_asked() -> None:
    lost = row("a", materials=OwnMaterials(reason="texture_missing"))
    for rows, told in (([lost, row("b")], "drawn: texture_missing"), ([row("b")], "")):
        text = text_of(quality_page(rows, []))
        assert told in text and ("materials" in text) == bool(told)
    assert "In their own materials: 0 of 2; the others: texture_missing (1)." in text_of(
        quality_page([lost, row("b")], [])
    )


def test_a_scene_is_shown_so_dark_that_few_pixels_are_white() -> None:
    """Most are shown as they are."""
    pictures = np.random.default_rng(0).uniform(0, 1, (2, 16, 16, 3)).astype(np.float32)
    assert preview_gain(pictures) == 1
    shown = preview_srgb8(50 * pictures * preview_gain(50 * pictures))
    assert 0 < (shown == 255).any(axis=-1).mean() < 0.1 and np.median(shown) > 60


def test_counts_are_those_of_the_rows_and_equal_rows_give_equal_pages() -> None:
    tags = quality_page([row("a"), row("b")], [failure()])
    text = text_of(tags)
    assert "2 objects accepted, 0 of them repaired" in text
    assert "2 watertight; 1 rejected" in text
    assert "CC0-1.0 (2)" in text
    assert tags.tags.count("tr") == 2 + 3
    twice = [encode_quality_page([row()], [], {}, budget=9, target="x") for _ in range(2)]
    assert twice[0] == twice[1]


def test_a_page_without_objects_or_without_failures() -> None:
    tags = quality_page([], [failure("bad0"), failure("bad1")])
    text = text_of(tags)
    assert "0 objects accepted, 0 of them repaired" in text
    assert "0 watertight; 2 rejected" in text
    assert "Licenses: none" in text and "Rejected" in text
    assert "img" not in tags.tags
    tags = quality_page([row("a", method="meshoptimizer")], [])
    assert tags.tags.count("img") == 1
    assert "Rejected" not in text_of(tags)


def test_each_choice_has_a_button_and_no_choice_has_none() -> None:
    within, capped = "within the target", "at the cap"
    cards = [card("train", "plane"), card("train", "room", capped), card("test", HARM)]
    filters = gallery_filters(cards)
    words = {value: words for name in filters for value, _, words in filters[name] if words}
    assert words == {
        "train": "--split train",
        "test": "--split test",
        HARM: f"--template {shlex.quote(HARM)}",
        "plane": "--template plane",
        "room": "--template room",
        within: "--where 'not any(at_cap)'",
        capped: "--where 'any(at_cap)'",
    }
    assert [value for value, _, _ in filters["order"]] == ["", "0", "1", "2", "3", "4"]
    # such as those of scene files: no command selects them, and none claims to
    unnamed = gallery_filters([card("train", name) for name in ("", "plane", "room")])
    assert [value for value, _, _ in unnamed["layout"]] == ["", "plane", "room"]
    assert gallery_filters([]) == gallery_filters([card("train", "plane")]) == {}


def card(split: str, layout: str, views: str = "within the target") -> Card:
    plain = make_card(sample(3, furnished(["a", "b"])), split, "x.html")
    return dataclasses.replace(plain, layout=layout, views=views)


def test_what_a_card_knows() -> None:
    made = sample(3, furnished(["a", "b"]))
    found = make_card(made, "test", "x.html")
    expected = ("test", made.scene.provenance["template"], "within the target", 2)
    assert (found.split, found.layout, found.views, found.num_objects) == expected
    assert found.orders[1] == -found.orders[2] == made.scene.num_triangles
    capped = [dataclasses.replace(view, at_cap=True, noise_floor_db=np.inf) for view in made.views]
    found = make_card(dataclasses.replace(made, views=tuple(capped)), "test", "x.html")
    assert found.views == "at the cap"
    assert json.loads(str(list(found.orders))) == list(found.orders), "the script reads it"


def test_titles_are_escaped_and_only_the_script_of_pages_runs() -> None:
    page = render_page("release.html", HARM, explained="\ud800", about=[], medians=[], scenes=[])
    tags = read(page)
    assert "".join(tags.text).count(HARM) == 2
    assert not {"script", "iframe", "img"} & set(tags.tags)
    script = render_page.__globals__["_SCRIPT"].encode()
    allowed = base64.b64encode(hashlib.sha256(script).digest()).decode()
    assert f"script-src 'sha256-{allowed}'" in page.decode()


def test_addresses_become_links_and_all_else_stays_text() -> None:
    for url in ["https://example.org/a?b=c&d", "http://localhost:80/x", "HTTPS://E.org"]:
        assert is_address(url)
    for url in [
        "", "javascript:alert(1)", " https://example.org", "java\nscript:alert(1)",
        "data:text/html,x", "//example.org", "https://", "https://me:secret@example.org",
        "https://[broken", "https://e.org/\u202egro", HARM,
    ]:  # fmt: skip
        assert not is_address(url)
