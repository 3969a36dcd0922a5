"""Filters of a gallery: each choice has a button, its cards and options that select its scenes."""

import dataclasses
import json
import re
import shlex

from pipeline.documents.gallery_controls import (
    CardFacts,
    card_attributes,
    card_facts,
    gallery_controls,
)
from tests.pipeline.documents.dataset_by_hand import furnished, sample
from tests.pipeline.documents.pages_read import HARM, read


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
