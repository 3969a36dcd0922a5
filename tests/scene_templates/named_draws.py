"""p-values of named draws against what each name states."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from scene_templates.stated_draws import StatedDraw
from tests.scene_templates.statistics import Table, choices, share, uniform


def merged(many: Iterable[Mapping[str, StatedDraw]]) -> dict[str, StatedDraw]:
    """Return the draws of many surfaces or skies as if one had made them all."""
    found: dict[str, StatedDraw] = {}
    for made in many:
        for name, draw in made.items():
            whole = found.setdefault(name, StatedDraw(kind=draw.kind, stated=draw.stated))
            assert (whole.kind, whole.stated) == (draw.kind, draw.stated), name
            whole.values.extend(draw.values)
    return found


def stated_table(made: Mapping[str, StatedDraw]) -> Table:
    """Return a p-value for each number that was drawn, of names with at least 60 values."""
    table: dict[str, float] = {}
    for name, draw in made.items():
        if len(draw.values) >= 60:
            table |= _rows(name, draw.kind, draw.stated, draw.values)
    return table


def _rows(name: str, kind: str, stated: Any, values: list[Any]) -> Table:
    if kind == "share":
        return {name: share(values, stated)}
    if kind == "choice":
        return {name: choices(values, dict.fromkeys(stated, 1.0))}
    low, high = stated
    if kind == "whole number":
        return {name: choices(values, dict.fromkeys(range(low, high + 1), 1.0))}
    if kind == "shade":
        return {name: uniform(values, 0, 1)}
    if kind == "colour":
        columns = np.array(values).T
        return {
            f"{name} {channel}": uniform(column, *ends)
            for channel, column, *ends in zip("rgb", columns, low, high, strict=True)
        }
    if kind == "direction":
        x, y, z = np.array(values).T
        ends = np.sin(np.radians(stated))
        return {
            f"{name} height": uniform(z, *ends),
            f"{name} azimuth": uniform(np.arctan2(y, x), -np.pi, np.pi),
        }
    return {name: uniform(values, low, high)}
