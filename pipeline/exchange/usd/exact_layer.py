"""Comparison of prims that Trilight may have written with those that export writes.

Files may have been edited since. Functions raise `Changed`, LookupError, TypeError or ValueError
where a layer is not as export writes it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd import names
from pipeline.exchange.usd.write_meshes import CENTER
from pipeline.exchange.usd.write_textures import COAT_ROUGHNESS
from storage.records.texture import TEXTURED

_PLAIN_INFO = {"specifier", "typeName", "apiSchemas", "documentation", "comment", "displayName"}
"""Metadata that does not change how a prim looks."""
_PLACED = {CENTER, "xformOpOrder", names.EXACT_ROWS, names.EXACT_POSITIONS}
_ADDED = {"inputs:ior", COAT_ROUGHNESS, "outputs:r", *map(names.texture_attribute, TEXTURED)}
_ADDED |= {names.SKY_SOURCE, names.SKY_VISIBLE, *names.SKY_ROWS, *_PLACED}
"""Properties that older Trilights did not write; their roughness textures have `outputs:r`."""


class Changed(Exception):
    """The layer is not as export wrote it."""


def require_same(stored: Any, expected: Any) -> None:
    """Require that a prim and all below it are as the prim that export writes."""
    _require_same(stored, expected, (_plain_path(stored), _plain_path(expected)))


def _require_same(stored: Any, expected: Any, roots: tuple[str, str]) -> None:
    properties = {each.name: each for each in stored.properties}
    expected_properties = {each.name: each for each in expected.properties}
    missing = expected_properties.keys() - properties.keys()
    require(properties.keys() <= expected_properties.keys() and missing <= _ADDED)
    require(stored.typeName == expected.typeName and set(stored.ListInfoKeys()) <= _PLAIN_INFO)
    is_old = CENTER in missing  # its points are positions
    for name, each in properties.items():
        if not is_old or name not in ("points", "extent"):
            _require_same_property(each, expected_properties[name], roots)
    prims = {prim.name: prim for prim in stored.nameChildren}
    require(prims.keys() == {prim.name for prim in expected.nameChildren})
    for prim in expected.nameChildren:
        _require_same(prims[prim.name], prim, roots)


def _require_same_property(stored: Any, expected: Any, roots: tuple[str, str]) -> None:
    require(type(stored) is type(expected))
    links = "targetPathList"
    if hasattr(expected, "connectionPathList"):
        links = "connectionPathList"
        require(stored.typeName == expected.typeName and stored.default == expected.default)
        require(not stored.HasInfo("timeSamples"))
        require(stored.GetInfo("interpolation") == expected.GetInfo("interpolation"))
        if not (stored.HasInfo("connectionPaths") or expected.HasInfo("connectionPaths")):
            return
    paths, expected_paths = (
        [str(path).removeprefix(root) for path in getattr(each, links).explicitItems]
        for each, root in zip((stored, expected), roots, strict=True)
    )
    require(paths == expected_paths)


def _plain_path(prim: Any) -> str:
    return str(prim.path.StripAllVariantSelections())


def list_by_row(folder: Any, name: Callable[[int], str]) -> list[Any]:
    """Return the children of a prim in the order of their rows; look-ups by name are quadratic."""
    prims = {prim.name: prim for prim in folder.nameChildren}
    return [prims[name(row)] for row in range(len(prims))]


def read_integers(prim: Any, name: str) -> NDArray[np.int64]:
    """Return an attribute as integers [N]."""
    values = np.array(prim.attributes[name].default, np.int64)
    require(values.ndim == 1)
    return values


def read_vectors(prim: Any, name: str) -> NDArray[np.float32]:
    """Return an attribute as vectors [N, 3]."""
    return np.array(prim.attributes[name].default, np.float32).reshape(-1, 3)


def require(condition: Any) -> None:
    """Raise `Changed` where a condition is not met."""
    if not condition:
        raise Changed
