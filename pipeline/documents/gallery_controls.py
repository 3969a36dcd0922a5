"""Filters and orders of a report's gallery: radio buttons, and the script that obeys them.

Without the script a page shows all cards and no button.
"""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.documents.html import Markup, element, escape
from storage.records.lights import num_lights
from storage.records.sample import Sample

_MOST_CHOICES = 12
"""Most choices of one filter; a dataset with more layouts shows the first ones by name."""

_CAPS = {False: "within the target", True: "at the cap"}

_SELECT = "trilight shards select . --out ../selected"

_OPTIONS = {"split": "--split", "layout": "--template", "views": "--where"}
"""Option that selects the scenes of a choice, by the name of its filter."""

_WHERE = {_CAPS[False]: "not any(at_cap)", _CAPS[True]: "any(at_cap)"}

CONTROLS_STYLE = """
.filters:not([hidden]) { display: flex; flex-wrap: wrap; gap: .3rem 1.6rem; margin: .8rem 0 }
.filters fieldset { border: 0; padding: 0; margin: 0; display: flex; flex-wrap: wrap;
  gap: .1rem .7rem }
.filters legend { float: left; color: var(--soft); margin-right: .5rem }
.filters label { white-space: nowrap } .filters input { margin: 0 .25rem 0 0 }
.chosen { margin: .6rem 0 }
"""

CONTROLS_SCRIPT = """
const filters = document.querySelector(".filters"), chosen = document.querySelector(".chosen");
const cards = [...document.querySelectorAll(".card")];
function show() {
  const picked = [...filters.querySelectorAll(":checked")].filter((radio) => radio.value);
  const order = picked.find((radio) => radio.name === "order")?.value;
  const choices = picked.filter((radio) => radio.name !== "order");
  for (const card of cards)
    card.hidden = choices.some(({ name, value }) => card.dataset[name] !== value);
  const rank = (card) => order ? JSON.parse(card.dataset.ranks)[order] : 0;
  document.querySelector(".cards").append(...[...cards].sort((a, b) => rank(a) - rank(b)));
  chosen.hidden = !choices.length;
  chosen.firstChild.textContent =
    [chosen.dataset.command, ...choices.map((radio) => radio.dataset.words)].join(" ");
}
filters.hidden = false;
filters.addEventListener("change", show);
addEventListener("pageshow", show);  // a browser that comes back restores the buttons
"""


@dataclass(frozen=True, kw_only=True)
class CardFacts:
    """Filter and sort values of one scene in the gallery."""

    choices: Mapping[str, str]
    """Value of the scene for each filter, by its name; empty if unknown."""
    orders: Mapping[str, float]
    """Values to sort by, by the label of the order; the least value comes first."""


def card_facts(sample: Sample, split: str) -> CardFacts:
    """Return the filter and sort values of a scene."""
    return CardFacts(
        choices={
            "split": split,
            "layout": str(sample.scene.provenance.get("template", "")),
            "views": _CAPS[any(record.at_cap for record in sample.views)],
        },
        orders={
            "least floor": min(float(record.noise_floor_db) for record in sample.views),
            "fewest triangles": sample.scene.num_triangles,
            "most triangles": -sample.scene.num_triangles,
            "most lights": -num_lights(sample.scene),
            "least coverage": min(record.coverage for record in sample.views),
        },
    )


def gallery_controls(cards: Sequence[CardFacts]) -> Markup:
    """Return buttons to filter by split, layout and cap, and to sort; none without a choice."""
    buttons = []
    for name in _OPTIONS:
        known = [card.choices[name] for card in cards if card.choices[name]]
        values = list(dict.fromkeys(sorted(known) if name == "layout" else known))[:_MOST_CHOICES]
        if len(values) > 1:
            radios = [_radio(name, value, value, _words(name, value)) for value in values]
            buttons.append(_buttons(name, "all", radios))
    if len(cards) > 1:
        radios = [_radio("order", str(row), label) for row, label in enumerate(cards[0].orders)]
        buttons.append(_buttons("order", "as made", radios))
    command = element("code", class_="command")
    where = " in the dataset's folder makes a set of them."
    chosen = Markup(
        f'<p class="chosen" hidden data-command="{_SELECT}">{command}{escape(where)}</p>'
    )
    return Markup(f'<div class="filters" hidden>{"".join(buttons)}</div>{chosen}')


def card_attributes(cards: Sequence[CardFacts]) -> list[dict[str, str]]:
    """Return the attributes of each thumbnail for the script: filters, and ranks in each order."""
    ranks: list[list[int]] = [[] for _ in cards]
    for order in cards[0].orders if cards else ():
        ordered = sorted(range(len(cards)), key=lambda card: cards[card].orders[order])
        for rank, card in enumerate(ordered):
            ranks[card].append(rank)
    return [
        {f"data-{name}": value for name, value in card.choices.items()}
        | {"data-ranks": json.dumps(of_card)}
        for card, of_card in zip(cards, ranks, strict=True)
    ]


def _buttons(name: str, unchanged: str, radios: Sequence[Markup]) -> Markup:
    return element("fieldset", element("legend", name), _radio(name, "", unchanged), *radios)


def _radio(name: str, value: str, label: str, words: str = "") -> Markup:
    checked = "" if value else " checked"
    attributes = f'name="{name}" value="{escape(value)}" data-words="{escape(words)}"{checked}'
    return element("label", Markup(f'<input type="radio" {attributes}>'), label)


def _words(name: str, value: str) -> str:
    """Return the option that selects the scenes of a choice."""
    return shlex.join([_OPTIONS[name], _WHERE[value] if name == "views" else value])
