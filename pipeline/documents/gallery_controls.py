"""Filters and orders of a report's gallery by style alone: a report runs no script.

Each card bears a class for every choice that it is part of and its place in every order; radio
buttons before the cards decide, through `:has()`, which are shown and in which order.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.documents.html import Markup, element, joined
from storage.records.lights import num_lights
from storage.records.sample import Sample

_MOST_CHOICES = 12
"""Of one filter; a dataset with more layouts has the first ones by name."""

_CAPS = ("within the target", "at the cap")

CONTROLS_STYLE = """
.filters { display: flex; flex-wrap: wrap; gap: .3rem 1.6rem; margin: .8rem 0 }
.filters fieldset { border: 0; padding: 0; margin: 0; display: flex; flex-wrap: wrap;
  gap: .1rem .7rem }
.filters legend { float: left; color: var(--soft); margin-right: .5rem }
.filters label { white-space: nowrap } .filters input { margin: 0 .25rem 0 0 }
.chosen { display: none; margin: .6rem 0 }
"""


@dataclass(frozen=True, kw_only=True)
class CardFacts:
    """What the gallery can be filtered and sorted by."""

    split: str
    """Of the scene."""
    template: str
    """Its layout."""
    at_cap: bool
    """Whether any of its views ended at the cap before its target."""
    orders: Mapping[str, float]
    """Values to sort by, by what a person calls them; the least value comes first."""


def card_facts(sample: Sample, split: str) -> CardFacts:
    """Return what is known of a scene's card."""
    return CardFacts(
        split=split,
        template=str(sample.scene.provenance.get("template", "")),
        at_cap=any(record.at_cap for record in sample.views),
        orders={
            "least floor": min(float(record.noise_floor_db) for record in sample.views),
            "fewest triangles": sample.scene.num_triangles,
            "most triangles": -sample.scene.num_triangles,
            "most lights": -num_lights(sample.scene),
            "least coverage": min(record.coverage for record in sample.views),
        },
    )


@dataclass(frozen=True, kw_only=True)
class Controls:
    """How a gallery is filtered and sorted."""

    markup: Markup
    """The buttons, and the command that selects what they show."""
    style: str
    """Rules that make them work."""
    classes: tuple[str, ...]
    """Of each card."""
    places: tuple[str, ...]
    """Style of each card: its place in every order."""


def gallery_controls(cards: Sequence[CardFacts]) -> Controls:
    """Return filters by split, layout and cap, and orders; where there is no choice, no button."""
    filters = {
        "split": [card.split for card in cards],
        "layout": [card.template for card in cards],
        "views": [_CAPS[card.at_cap] for card in cards],
    }
    named = {name: filter(None, values) for name, values in filters.items()}  # some have no layout
    choices = {
        name: list(dict.fromkeys(sorted(values) if name == "layout" else values))[:_MOST_CHOICES]
        for name, values in named.items()
    }
    choices = {name: values for name, values in choices.items() if len(values) > 1}
    orders = list(cards[0].orders) if len(cards) > 1 else []
    rules = [
        f"body:has(#{name}-{row}:checked) .card:not(.{name}-{row}) {{ display: none }}"
        for name, values in choices.items()
        for row in range(1, len(values) + 1)
    ]
    rules += [
        f"body:has(#order-{row}:checked) .card {{ order: var(--o{row}) }}"
        for row in range(1, len(orders) + 1)
    ]
    commands, shown = _commands(choices)
    buttons = [_buttons(name, ["all", *values]) for name, values in choices.items()]
    buttons += [_buttons("order", ["as made", *orders])] if orders else []
    return Controls(
        markup=joined([element("div", *buttons, class_="filters"), *commands] if buttons else []),
        style="\n".join([CONTROLS_STYLE, *rules, *shown, ""]),
        classes=tuple(_classes(choices, filters, row) for row in range(len(cards))),
        places=_places(cards, orders),
    )


def _buttons(name: str, labels: Sequence[str]) -> Markup:
    rows = [
        element("label", _radio(name, row), label, for_=f"{name}-{row}")
        for row, label in enumerate(labels)
    ]
    return element("fieldset", element("legend", name), *rows)


def _radio(name: str, row: int) -> Markup:
    checked = "" if row else " checked"
    return Markup(f'<input type="radio" name="{name}" id="{name}-{row}"{checked}>')


def _classes(
    choices: Mapping[str, Sequence[str]], values: Mapping[str, Sequence[str]], card: int
) -> str:
    found = [
        f"{name}-{known.index(values[name][card]) + 1}"
        for name, known in choices.items()
        if values[name][card] in known
    ]
    return " ".join(["card", *found])


def _places(cards: Sequence[CardFacts], orders: Sequence[str]) -> tuple[str, ...]:
    """Return each card's rank in every order; equal values stay as the gallery has them."""
    ranks: list[list[str]] = [[] for _ in cards]
    for number, order in enumerate(orders, 1):
        ordered = sorted(range(len(cards)), key=lambda card: cards[card].orders[order])
        for rank, card in enumerate(ordered, 1):
            ranks[card].append(f"--o{number}: {rank}")
    return tuple("; ".join(of_card) for of_card in ranks)


def _commands(choices: Mapping[str, Sequence[str]]) -> tuple[list[Markup], list[str]]:
    """Return the command for every combination of choices, and the rules that show one of them."""
    combined: list[tuple[list[str], list[str]]] = [([], [])]
    options = {"split": "--split", "layout": "--template"}
    caps = {_CAPS[False]: "not any(at_cap)", _CAPS[True]: "any(at_cap)"}
    for name, values in choices.items():
        combined = [
            (
                [*buttons, f":has(#{name}-{row}:checked)"],
                [*words, *_words(options.get(name), caps, value)],
            )
            for buttons, words in combined
            for row, value in enumerate(["", *values])
        ]
    commands, rules = [], []
    for number, (buttons, words) in enumerate(combined):
        if words:
            command = shlex.join(["trilight", "shards", "select", ".", "--out", "../selected"])
            line = element("code", f"{command} {shlex.join(words)}", class_="command")
            where = " in the dataset's folder makes a set of them."
            commands.append(element("p", line, where, class_=f"chosen chosen-{number}"))
            rules.append(f"body{''.join(buttons)} .chosen-{number} {{ display: block }}")
    return commands, rules


def _words(option: str | None, caps: Mapping[str, str], value: str) -> list[str]:
    if not value:
        return []
    return [option, value] if option else ["--where", caps[value]]
