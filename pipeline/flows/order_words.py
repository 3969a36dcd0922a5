"""A `DatasetOrder` as the command line says it, so that a command can be repeated."""

import json
from collections.abc import Iterator
from typing import Any

from pipeline.flows.order import DatasetOrder
from storage.safe_url import safe_url

_OPTIONS = {
    "objects": "--objects",
    "scenes": "--scenes",
    "seed": "--seed",
    "resolution": "--resolution",
    "noise_floor_db": "--noise-floor",
    "licence": "--licence",
    "failure_budget": "--failure-budget",
    "scenes_from": "--scenes-from",
    "views": "--views",
    "albedo_over_one": "--albedo-over-one",
}
"""Options of one value by the field that they fill."""


def generate_words(order: DatasetOrder) -> list[str]:
    """Return the words of `generate` for what an order asks beside its defaults, without `--out`.

    Which part of the dataset this machine makes, and with how many processes, is left out.
    """
    usual = DatasetOrder()
    words = ["generate", order.build]
    for field, option in _OPTIONS.items():
        value = getattr(order, field)
        if value != getattr(usual, field):
            words += [option, safe_url(value) if isinstance(value, str) else str(value)]
    for licence in order.allow_licences:
        words += ["--allow-licence", licence]
    if order.accept_environment:
        words.append("--accept-environment")
    return [*words, *_changes(order)]


def _changes(order: DatasetOrder) -> Iterator[str]:
    for name, value in order.changes.items():
        yield from ("--set", f"{name}={_json_or_word(value)}")


def _json_or_word(value: Any) -> str:
    """Return a value as `--set` reads it: a word that is no JSON stands for itself."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except json.JSONDecodeError:
            return value
    return json.dumps(value)
