"""Filters of a gallery: each choice has a button, a rule, its cards and a command that runs."""

import dataclasses
import re

import pytest

from pipeline.documents.gallery_controls import CardFacts, Controls, card_facts, gallery_controls
from tests.pipeline.documents.dataset_by_hand import furnished, sample
from tests.pipeline.documents.pages_read import HARM, read


def card(split: str, template: str, *, at_cap: bool = False, floor: float = 40) -> CardFacts:
    return CardFacts(
        split=split, template=template, at_cap=at_cap, orders={"least floor": floor, "few": -floor}
    )


@pytest.fixture
def controls() -> Controls:
    return gallery_controls(
        [
            card("train", "plane", floor=44),
            card("train", "room", at_cap=True, floor=38),
            card("test", "plane", floor=41),
        ]
    )


def commands(markup: str) -> set[str]:
    return set(
        re.findall(r"<code[^>]*>trilight shards select \. --out \.\./selected (.+?)<", markup)
    )


def test_each_card_bears_its_choices(controls: Controls) -> None:
    assert controls.classes == (
        "card split-1 layout-1 views-1",
        "card split-1 layout-2 views-2",
        "card split-2 layout-1 views-1",
    )


def test_each_button_has_a_rule(controls: Controls) -> None:
    ids = read(controls.markup.encode()).ids
    ruled = set(re.findall(r"#([\w-]+):checked", controls.style))
    assert ruled <= ids
    assert {name for name in ids if not name.endswith("-0")} <= ruled


def test_places_are_ranks_and_equals_stay(controls: Controls) -> None:
    assert controls.places == ("--o1: 3; --o2: 1", "--o1: 1; --o2: 3", "--o1: 2; --o2: 2")
    same = gallery_controls([card("train", "plane")] * 3)
    assert [place.split("; ")[0] for place in same.places] == ["--o1: 1", "--o1: 2", "--o1: 3"]


def test_a_command_for_each_combination(controls: Controls) -> None:
    found = commands(controls.markup)
    assert len(found) == 3 * 3 * 3 - 1
    assert "--split train" in found
    assert "--split test --template room --where &#x27;any(at_cap)&#x27;" in found
    assert "--where &#x27;not any(at_cap)&#x27;" in found


def test_scenes_of_no_layout_are_no_choice() -> None:
    """Such as those of scene files: no command selects them, and none claims to."""
    controls = gallery_controls([card("train", name) for name in ("", "plane", "room")])
    assert "layout" not in controls.classes[0] and "layout-1" in controls.classes[1]
    assert commands(controls.markup) == {"--template plane", "--template room"}
    assert len([name for name in read(controls.markup.encode()).ids if "layout" in name]) == 3


def test_no_choice_no_button() -> None:
    assert gallery_controls([]).markup == ""
    one = gallery_controls([card("train", "plane")])
    assert (one.markup, one.classes, one.places) == ("", ("card",), ("",))


def test_names_from_outside_stay_text() -> None:
    controls = gallery_controls([card("train", HARM), card("train", "a 'b'")])
    assert "<script" not in controls.markup + controls.style
    assert HARM in "".join(read(controls.markup.encode()).text)
    assert "HARM" not in controls.style and "alert" not in controls.style


def test_what_a_card_knows() -> None:
    made = sample(3, furnished(["a", "b"]))
    facts = card_facts(made, "test")
    assert facts.split == "test" and facts.template == made.scene.provenance["template"]
    assert facts.orders["fewest triangles"] == made.scene.num_triangles
    capped = [dataclasses.replace(view, at_cap=True) for view in made.views]
    assert card_facts(dataclasses.replace(made, views=tuple(capped)), "test").at_cap
