"""Checked access to prims that Trilight may have written, and that may have been edited since.

Each function returns a value of the layer. It raises `Changed`, LookupError, TypeError or
ValueError where the layer is not as export writes it.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

_PLAIN_INFO = {"specifier", "typeName", "apiSchemas", "documentation", "comment", "displayName"}
"""Metadata that does not change how a prim looks."""


class Changed(Exception):
    """The layer is not as export wrote it."""


def drop_absent(prim: Any, properties: Mapping[str, T], added: set[str]) -> dict[str, T]:
    """Return the expected properties without missing ones that older Trilights did not write."""
    return {
        name: value
        for name, value in properties.items()
        if name not in added or name in prim.properties
    }


def children_by_row(folder: Any, name: Callable[[int], str]) -> list[Any]:
    """Return the children of a prim in the order of their rows; look-ups by name are quadratic."""
    prims = {prim.name: prim for prim in folder.nameChildren}
    return [prims[name(row)] for row in range(len(prims))]


def require_children(prim: Any, expected: set[str]) -> Any:
    require(set(prim.nameChildren.keys()) == expected)
    return prim.nameChildren


def require_plain(prim: Any, properties: set[str]) -> None:
    """Require that a prim has exactly these properties and no composition or visibility."""
    require(set(prim.properties.keys()) == properties)
    require(set(prim.ListInfoKeys()) <= _PLAIN_INFO)


def read_integers(prim: Any, name: str) -> NDArray[np.int64]:
    attribute = prim.attributes[name]
    values = np.array(attribute.default, np.int64)
    require(values.ndim == 1 and not attribute.HasInfo("timeSamples"))
    return values


def read_vectors(prim: Any, name: str) -> NDArray[np.float32]:
    attribute = prim.attributes[name]
    values = np.array(attribute.default, np.float32).reshape(-1, 3)
    require(not attribute.HasInfo("timeSamples"))
    return values


def require(condition: Any) -> None:
    if not condition:
        raise Changed
