"""The triangles of a glTF primitive in our world, with its normals, or flat ones."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.gltf.document import GltfDocument
from storage.errors import TrilightError

_STRIP = 5
_SMALLEST_DOUBLE_AREA = 1e-12


class GltfTriangles:
    """The triangles of a primitive that have an area."""

    def __init__(
        self, document: GltfDocument, primitive: dict[str, Any], to_world: NDArray[np.float64]
    ) -> None:
        """Read them in their place.

        Raises:
            TrilightError: a corner that is no vertex, or values that are not finite.
        """
        self._document, self._attributes = document, primitive["attributes"]
        points = document.accessor(self._attributes["POSITION"]).astype(np.float64)
        if not np.isfinite(points).all():
            raise TrilightError(f"{document.name}: positions are not finite.")
        self._corners = _corners(document, primitive, len(points))
        turn = to_world[:3, :3]
        if np.linalg.det(turn) < 0:
            self._corners = self._corners[:, ::-1]
        world = np.einsum("ij,vj->vi", turn, points) + to_world[:3, 3]
        self.positions = world[self._corners].astype(np.float32)
        """[T, 3, 3]"""
        cross = _cross(self.positions)
        kept = np.linalg.norm(cross, axis=1) > _SMALLEST_DOUBLE_AREA
        self.without_area = int((~kept).sum())
        self.positions, self._corners = self.positions[kept], self._corners[kept]
        self.normals = self._normals(cross[kept], turn)
        """[T, 3, 3] unit."""

    def coordinates(self, number: int) -> NDArray[np.float32] | None:
        """Return a set of texture coordinates [T, 3, 2], or None where there is none.

        Raises:
            TrilightError: they are not finite.
        """
        accessor = self._attributes.get(f"TEXCOORD_{number}")
        if accessor is None:
            return None
        values = self._document.accessor(accessor).astype(np.float32)
        if values.shape[1] != 2 or not np.isfinite(values).all():
            raise TrilightError(
                f"{self._document.name}: TEXCOORD_{number} holds no finite pairs of numbers."
            )
        self._require_vertices(len(values))
        return values[self._corners]

    def _normals(
        self, cross: NDArray[np.float64], turn: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        flat = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        if "NORMAL" not in self._attributes:
            return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        stated = self._document.accessor(self._attributes["NORMAL"]).astype(np.float64)
        self._require_vertices(len(stated))
        turned = np.einsum("ij,tcj->tci", np.linalg.inv(turn).T, stated[self._corners])
        length = np.linalg.norm(turned, axis=2, keepdims=True)
        usable = np.isfinite(length) & (length > 0)
        unit = np.where(usable, turned / np.where(usable, length, 1), flat[:, None])
        return np.asarray(unit, np.float32)

    def _require_vertices(self, count: int) -> None:
        if self._corners.size and self._corners.max() >= count:
            raise TrilightError(
                f"{self._document.name}: an attribute has {count} values; expected one for each "
                "vertex."
            )


def _corners(document: GltfDocument, primitive: dict[str, Any], count: int) -> NDArray[np.int64]:
    if "indices" in primitive:
        order = document.accessor(primitive["indices"]).astype(np.int64).ravel()
    else:
        order = np.arange(count)
    if order.size and not (order.min() >= 0 and order.max() < count):
        raise TrilightError(f"{document.name}: a face names vertex {order.max()} of {count}.")
    if primitive.get("mode", 4) != _STRIP:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    windows = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    windows[1::2] = windows[1::2][:, [1, 0, 2]]
    return windows


def _cross(positions: NDArray[np.float32]) -> NDArray[np.float64]:
    wide = positions.astype(np.float64)
    return np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
