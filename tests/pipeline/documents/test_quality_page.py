"""The page of assets, filters of a gallery, figures, HTML: no markup from outside."""

import base64
import dataclasses
import io
import json
import re
import shlex

import matplotlib
import numpy as np
from PIL import Image

from pipeline.documents.figures import (
    drawing,
    encode_figure,
    histogram,
    panels,
    rose,
    short_label,
    stacked_bars,
)
from pipeline.documents.gallery_controls import (
    CardFacts,
    card_attributes,
    card_facts,
    gallery_controls,
)
from pipeline.documents.html import (
    Markup,
    element,
    escape,
    image,
    join_markup,
    outside_link,
    page,
    png_uri,
    table,
)
from pipeline.documents.quality_page import Pair, encode_quality_page
from storage.conventions import preview_gain, preview_srgb8
from storage.records.asset import AssetRow
from storage.records.objects import Failure
from storage.records.skin import OwnMaterials
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


def test_text_from_outside_stays_text() -> None:
    tags = quality_page([HARMFUL], [failure(HARM, HARM)], pairs=pairs(HARMFUL))
    assert not {"script", "iframe", "link", "a", "object"} & set(tags.tags)
    assert not any(name.startswith("on") for name in tags.names)
    # uid in picture and table, licence in summary and table, item and message of the failure
    assert "".join(tags.text).count(HARM) == 6


def test_whose_materials_an_object_has_is_told_where_it_was_asked() -> None:
    lost = row("a", materials=OwnMaterials(reason="texture_missing"))
    for rows, told in (([lost, row("b")], "drawn: texture_missing"), ([row("b")], "")):
        text = "".join(quality_page(rows, []).text)
        assert told in text and ("materials" in text) == bool(told)


def test_a_scene_is_shown_so_dark_that_few_pixels_are_white() -> None:
    """Most are shown as they are."""
    pictures = np.random.default_rng(0).uniform(0, 1, (2, 16, 16, 3)).astype(np.float32)
    assert preview_gain(pictures) == 1
    shown = preview_srgb8(50 * pictures * preview_gain(50 * pictures))
    assert 0 < (shown == 255).any(axis=-1).mean() < 0.1 and np.median(shown) > 60


def test_nothing_is_loaded_from_elsewhere() -> None:
    shown = pairs(HARMFUL)
    data = encode_quality_page([HARMFUL, row()], [failure()], shown, budget=1400, target="x")
    assert not re.search(rb"https?:|javascript:|<script|@import|url\(", data)
    links = read(data).links
    assert len(links) == 3
    assert all(link.startswith("data:image/png;base64,") for link in links)


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
    for failures in ([], [failure("bad0"), failure("bad1")]):
        tags = quality_page([], failures)
        text = text_of(tags)
        assert "0 objects accepted, 0 of them repaired" in text
        assert f"0 watertight; {len(failures)} rejected" in text
        assert "Licences: none" in text
        assert "img" not in tags.tags
        assert ("Rejected" in text) == bool(failures)
    tags = quality_page([row(str(k), method="meshoptimizer") for k in range(3)], [])
    assert tags.tags.count("img") == 1
    assert "Rejected" not in " ".join(tags.text)


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


def test_each_choice_has_a_button_and_no_choice_has_none() -> None:
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
    # Such as those of scene files: no command selects them, and none claims to.
    markup = gallery_controls([card("train", name) for name in ("", "plane", "room")])
    layouts = [value for name, value, _ in buttons(markup) if name == "layout"]
    assert layouts == ["", "plane", "room"]
    for cards in ([], [card("train", "plane")]):
        assert buttons(gallery_controls(cards)) == []
        assert len(card_attributes(cards)) == len(cards)


def test_each_card_bears_its_choices_and_ranks_and_equals_stay() -> None:
    attributes = card_attributes(CARDS)
    assert [each["data-layout"] for each in attributes] == ["plane", "room", "plane"]
    assert [json.loads(each["data-ranks"]) for each in attributes] == [[2, 0], [0, 2], [1, 1]]
    same = card_attributes([card("train", "plane", floor=float("inf"))] * 3)
    assert [json.loads(each["data-ranks"])[0] for each in same] == [0, 1, 2]


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


def test_text_is_escaped_once_and_attributes_cells_and_titles_cannot_be_left() -> None:
    assert escape("<&'\">") == "&lt;&amp;&#x27;&quot;&gt;"
    assert escape(escape("<")) == "&lt;"
    assert join_markup(["<", Markup("<br>")]) == "&lt;\n<br>"
    tags = read(element("p", HARM, id=HARM, class_="a").encode())
    assert (tags.tags, tags.names, tags.ids) == (["p"], {"id", "class"}, {HARM})
    assert read(image("data:,", HARM).encode()).tags == ["img"]
    tags = read(page(HARM, table((HARM, "n"), [(HARM, 1), ("b", 2)], numbers=1)))
    assert tags.tags.count("td") == 4
    assert "".join(tags.text).count(HARM) == 3
    assert not {"script", "iframe"} & set(tags.tags)
    assert b"?" in page("x", "\ud800")


def test_only_the_script_of_a_page_runs() -> None:
    text = page("x", "y", script="show()").decode()
    assert "<script>show()</script>" in text
    # sha256 of "show()", as openssl dgst -binary | base64 gives it
    assert "script-src 'sha256-bZcXq6A55386WOhnm+CkmXOdvD/gkjsQT5fkz6gxfg8='\"" in text


def test_only_the_last_columns_are_numbers() -> None:
    assert str(table(("a", "b"), [("x", 1)], numbers=1)).count('class="n"') == 2
    assert "class" not in table((), [("x", "y")])
    assert "<th>" not in table((), [("x", "y")])
    assert table((), []) == "<table></table>"


def test_addresses_become_links_and_all_else_stays_text() -> None:
    for url in ["https://example.org/a?b=c&d", "http://localhost:80/x", "HTTPS://E.org"]:
        tags = read(outside_link(url).encode())
        assert (tags.tags, tags.links, "".join(tags.text)) == (["a"], [url], url)
    for url in [
        "", "javascript:alert(1)", " https://example.org", "java\nscript:alert(1)",
        "data:text/html,x", "//example.org", "https://", "https://me:secret@example.org",
        "https://[broken", "https://e.org/\u202egro", HARM,
    ]:  # fmt: skip
        tags = read(outside_link(url).encode())
        assert (tags.tags, "".join(tags.text)) == ([], url)


def test_equal_pictures_give_equal_addresses() -> None:
    picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert png_uri(picture) == png_uri(picture.copy())
    assert png_uri(picture).startswith("data:image/png;base64,")


def picture(markup: Markup) -> Image.Image:
    data = str(markup).split("base64,")[1].split('"')[0]
    return Image.open(io.BytesIO(base64.b64decode(data)))


VALUES: dict[str, list[float]] = {
    "none": [],
    "one": [3.5],
    "equal": [2.5] * 9,
    "whole": [1, 2, 2, 5],
    "wide": [1e-9, 1e30],
    "not finite": [np.nan, np.inf, 1.0],
    "all not finite": [np.nan],
    "many": list(np.linspace(0, 1, 1000)),
}


def test_any_values_can_be_drawn() -> None:
    marks = {"a": 3.0, "b": None, "c": np.nan}
    with drawing():
        figure, axes = panels(len(VALUES) + 4, polar=(0, 1, 2, 3))
        for axis, name in zip(axes, ("none", "equal", "wide", "not finite"), strict=False):
            rose(axis, VALUES[name], "directions")
        for axis, (name, values) in zip(axes[4:], VALUES.items(), strict=True):
            histogram(axis, values, name, ylabel="y", marks=marks)
        drawn = picture(encode_figure(figure, "alt"))
    assert drawn.size[0] > 800
    assert len(drawn.getcolors(1 << 24) or []) > 20


def test_bars_hold_every_value_and_names_from_outside_are_labels() -> None:
    """Heights of the bars add up to the values, and whole numbers have a bar each."""
    with drawing():
        _, (axes, other) = panels(2)
        histogram(axes, [1, 2, 2, 5], "x")
        histogram(other, np.linspace(0, 1, 1000), "x")
    heights = [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]
    assert heights == [1, 2, 0, 0, 1]
    total = sum(patch.get_height() for patch in other.patches)  # type: ignore[attr-defined]
    assert total == 1000
    assert short_label("a\n b\x07\u202e") == "a b"
    assert len(short_label("x" * 99)) == 26
    names = ["$\\frac{$", "高 \ud800", "", "x" * 99]
    with drawing():
        figure, _ = stacked_bars(names, {name: [1, 2, 3, 4] for name in names}, xlabel="n")
        assert picture(encode_figure(figure, "alt")).size[0] > 800


def test_the_readers_settings_do_not_matter() -> None:
    def drawn() -> str:
        with drawing():
            figure, (axes,) = panels(1)
            histogram(axes, [1.5, 2.5], "x")
            return encode_figure(figure, "alt")

    plain = drawn()
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert drawn() == plain
        assert matplotlib.rcParams["font.size"] == 30
