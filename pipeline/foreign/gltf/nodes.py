"""The nodes of a glTF scene with their transforms to world space: meters, +Z up."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.numbers import Malformed, read_count
from storage.errors import Rejected

INSTANCING = "EXT_mesh_gpu_instancing"

_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""glTF has +Y up and +Z towards the viewer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedNode:
    """A node with its world transform."""

    node: dict[str, Any]
    """JSON object of the node."""
    to_world: NDArray[np.float64]
    """[4, 4] matrix for column vectors, to meters with +Z up."""
    is_visible: bool
    """True where the node's meshes and lights are shown (KHR_node_visibility)."""


def entry(tree: Mapping[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """Return an entry of a list of the tree; raises Malformed for an index out of range."""
    rows = tree.get(kind, ())
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(rows):
        raise Malformed(f"{kind} {index!r:.20} of {len(rows)}")
    row = rows[index]
    if not isinstance(row, dict):
        raise Malformed(f"{kind} {index} is no object")
    return row


def extension(row: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an entry; empty where it has none."""
    value = row.get("extensions", {}).get(name, {})
    return value if isinstance(value, dict) else {}


def placed_nodes(tree: Mapping[str, Any]) -> Iterator[PlacedNode]:
    """Yield the nodes of the default scene, or else of the first one, parents before children.

    All nodes count in a file without scenes.

    Raises:
        Rejected: scene_cycle.
    """
    seen: set[int] = set()
    waiting = [(index, _TO_Z_UP, True) for index in reversed(_roots(tree))]
    while waiting:
        index, above, is_visible = waiting.pop()
        node = entry(tree, "nodes", index)
        if index in seen:
            raise Rejected(
                "scene_cycle", f"node {index} is reached twice; glTF demands a strict tree"
            )
        seen.add(index)
        to_world = np.einsum("ij,jk->ik", above, _local(node))
        is_visible &= extension(node, "KHR_node_visibility").get("visible", True) is not False
        yield PlacedNode(node=node, to_world=to_world, is_visible=is_visible)
        children = reversed(node.get("children", ()))
        waiting += [(child, to_world, is_visible) for child in children]


def placed_meshes(tree: Mapping[str, Any]) -> Iterator[PlacedNode]:
    """Yield visible nodes with a mesh; raises Rejected nonfinite_vertices or scene_cycle."""
    for placed in placed_nodes(tree):
        if "mesh" in placed.node and placed.is_visible:
            if not np.isfinite(placed.to_world).all():
                fields = ("matrix", "translation", "rotation", "scale", "name")
                stated = {name: placed.node[name] for name in fields if name in placed.node}
                raise Rejected(
                    "nonfinite_vertices", f"a node or one above it has a place {stated!r:.120}"
                )
            yield placed


def _roots(tree: Mapping[str, Any]) -> list[int]:
    if tree.get("scenes"):
        return list(entry(tree, "scenes", tree.get("scene", 0)).get("nodes", ()))
    nodes = tree.get("nodes", ())
    below = {child for node in nodes for child in node.get("children", ())}
    return [index for index in range(len(nodes)) if index not in below]


def _local(node: Mapping[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column by column
    return transforms(
        *(
            np.array(node.get(name, default), np.float64).reshape(1, len(default))
            for name, default in _TRS
        )
    )[0]


_TRS = (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))


def transforms(
    translation: NDArray[np.float64], rotation: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return matrices [N, 4, 4] of translations [N, 3], quaternions [N, 4] and scales [N, 3]."""
    x, y, z, w = rotation.T
    length = x * x + y * y + z * z + w * w
    twice = np.divide(2, length, out=np.zeros_like(length), where=length > 0)
    rows: Any = [
        [1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)],
        [twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)],
        [twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)],
    ]
    rotations = np.moveaxis(np.array(rows, np.float64), 2, 0)
    matrices = np.tile(np.eye(4), (len(x), 1, 1))
    matrices[:, :3, :3] = rotations * scale[:, None]
    matrices[:, :3, 3] = translation
    return matrices


def num_instances(tree: Mapping[str, Any], node: Mapping[str, Any]) -> int:
    """Return the number of instances of a node; raises Malformed where attributes disagree."""
    attributes = extension(node, INSTANCING).get("attributes", {})
    counts = {
        read_count(entry(tree, "accessors", number), "count") for number in attributes.values()
    }
    if len(counts) > 1:
        raise Malformed(f"the instances of a node have attributes of {sorted(counts)} values")
    return counts.pop() if counts else 1
