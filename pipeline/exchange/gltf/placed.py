"""The nodes of a glTF scene with their places in our world: metres, +Z up."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError

_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""glTF has +Y up and +Z towards the viewer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedNode:
    """A node in its place."""

    node: dict[str, Any]
    """Its JSON."""
    to_world: NDArray[np.float64]
    """[4, 4] for column vectors, into our world."""


def placed_nodes(tree: dict[str, Any]) -> Iterator[PlacedNode]:
    """Yield the nodes of the default scene, parents before children.

    The tree has no circle: pipeline.foreign.gltf_tree has looked.

    Raises:
        TrilightError: a place that is not finite.
    """
    scenes, nodes = tree.get("scenes", ()), tree.get("nodes", ())
    roots = scenes[tree.get("scene", 0)].get("nodes", ()) if scenes else ()
    waiting = [(index, _TO_Z_UP) for index in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = nodes[index]
        to_world = np.einsum("ij,jk->ik", above, _local(node))
        if not np.isfinite(to_world).all():
            raise TrilightError(f"node {index}: its place is not finite.")
        yield PlacedNode(node=node, to_world=to_world)
        waiting += [(child, to_world) for child in reversed(node.get("children", ()))]


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column by column
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    length = x * x + y * y + z * z + w * w
    twice = 2 / length if length > 0 else 0.0
    turn = np.array(
        [
            [1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)],
            [twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)],
            [twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)],
        ]
    )
    place = np.eye(4)
    place[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    place[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    return place
