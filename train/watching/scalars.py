"""A row of the log as single numbers with names, as TensorBoard and others show them."""

from collections.abc import Mapping
from typing import Any

from train.watching.rows import LAYER_COLUMNS

_GROUPED = ("validation", "time_s", "memory_mb")


def scalars(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a row by `group/name`; what is no number is left out."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if name in _GROUPED:
            found |= {f"{name}/{inner}": number for inner, number in (value or {}).items()}
        elif name == "layers":
            for layer, figures in value.items():
                found |= {
                    f"{column}/{layer}": figure
                    for column, figure in zip(LAYER_COLUMNS, figures, strict=True)
                }
        elif name == "own_s":
            found |= {f"own_s/process {rank}": seconds for rank, seconds in enumerate(value)}
        elif name not in ("step", "spike"):
            found[f"train/{name}"] = value
    return {
        name: value
        for name, value in found.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
