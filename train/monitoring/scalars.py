"""Rows of the log as named scalars, for TensorBoard and Weights & Biases."""

from collections.abc import Mapping
from typing import Any

from train.monitoring.rows import LAYER_COLUMNS

_GROUPED = ("validation", "time_s", "memory_mb")


def scalars(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a row by `group/name`; other values are left out."""
    numbers: dict[str, Any] = {}
    for name, value in row.items():
        if name in _GROUPED:
            numbers |= {f"{name}/{inner}": number for inner, number in (value or {}).items()}
        elif name == "layers":
            for layer, figures in value.items():
                numbers |= {
                    f"{column}/{layer}": figure
                    for column, figure in zip(LAYER_COLUMNS, figures, strict=True)
                }
        elif name == "own_s":
            numbers |= {f"own_s/process {rank}": seconds for rank, seconds in enumerate(value)}
        elif name not in ("step", "spike"):
            numbers[f"train/{name}"] = value
    return {
        name: value
        for name, value in numbers.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
