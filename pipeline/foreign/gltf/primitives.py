"""The triangles of glTF primitives in the space of the world, and of a whole file as an object."""

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.gltf.document import GltfDocument, Rows, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import (
    FAN,
    POINTS_AND_LINES,
    STRIP,
    TRIANGLES,
    PlacedNode,
    entry,
    placed_meshes,
)
from pipeline.foreign.material import MOST_UV_SETS, TexturedMesh
from pipeline.foreign.mesh import TriangleMesh, join_meshes
from pipeline.foreign.numbers import read_count, read_number
from storage.errors import Rejected


class PlacedPrimitive:
    """The triangles of a primitive, deformed by its weighted morph targets."""

    def __init__(
        self, document: GltfDocument, primitive: dict[str, Any], weights: Sequence[float]
    ) -> None:
        """Read positions and faces.

        Raises:
            Rejected: index_range where a corner is no vertex, or as `GltfDocument.values`.
        """
        self._document = document
        self._primitive = primitive
        self._weights = weights
        attributes = primitive["attributes"]
        count = read_count(entry(document.tree, "accessors", attributes["POSITION"]), "count")
        order = (
            document.indices(primitive["indices"]) if "indices" in primitive else np.arange(count)
        )
        if order.size and order.max() >= count:
            raise Rejected("index_range", f"a face names vertex {order.max()} of {count}")
        self.faces = _faces(order, primitive.get("mode", TRIANGLES))
        """[T, 3] rows of `positions`."""
        self._rows: Rows = slice(None)
        if count > self.faces.size:  # of a large accessor, each primitive reads its own rows
            self._rows, faces = np.unique(self.faces, return_inverse=True)
            self.faces = faces.reshape(-1, 3)
        self.positions = self._read_attribute("POSITION", (3,))
        """[V, 3] in the space of the node, or of the world."""
        self._normal_matrix = np.eye(3)
        self._linear = np.eye(3)

    def place(self, to_world: NDArray[np.float64]) -> "PlacedPrimitive":
        """Return an instance in the world by a matrix [4, 4]; mirrored corners change order."""
        instance = copy.copy(self)
        linear = to_world[:3, :3]
        with np.errstate(invalid="ignore", over="ignore"):
            winding = -1 if np.linalg.det(linear) < 0 else 1
            instance.positions = np.einsum("ij,vj->vi", linear, self.positions) + to_world[:3, 3]
            instance._linear = linear
            instance._normal_matrix = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]]) * winding
        instance.faces = self.faces[:, ::winding]
        return instance

    @property
    def material(self) -> int | None:
        """Return the index of the material; None is glTF's default material."""
        number = self._primitive.get("material")
        if number is not None:
            entry(self._document.tree, "materials", number)
        return number

    def coordinates(self, number: int) -> NDArray[np.float64] | None:
        """Return a set of texture coordinates [T, 3, 2], v up; None where there is none."""
        name = f"TEXCOORD_{number}"
        if name not in self._primitive["attributes"]:
            return None
        may_be_whole = "KHR_mesh_quantization" in self._document.tree.get("extensionsUsed", ())
        uv = self._read_attribute(name, (2,), is_unit=None if may_be_whole else True)
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)[self.faces]

    @property
    def colors(self) -> NDArray[np.float64] | None:
        """Linear colors [T, 3, 3] of the corners; None where there are none."""
        if "COLOR_0" not in self._primitive["attributes"]:
            return None
        return self._read_attribute("COLOR_0", (3, 4), is_unit=True)[self.faces, :3]

    @property
    def normals(self) -> NDArray[np.float64] | None:
        """Normals [T, 3, 3] of the corners, of any length; None where there are none."""
        if "NORMAL" not in self._primitive["attributes"]:
            return None
        normals = self._read_attribute("NORMAL", (3,))[self.faces]
        return np.einsum("ij,tcj->tci", self._normal_matrix, normals)

    @property
    def tangents(self) -> NDArray[np.float64] | None:
        """Tangents of the corners and the signs of their bitangents [T, 3, 4].

        None where there are none, or where they are morphed.
        """
        targets = self._primitive.get("targets", ())
        is_morphed = any("TANGENT" in target for target in targets)
        if "TANGENT" not in self._primitive["attributes"] or is_morphed:
            return None
        tangents = self._read_attribute("TANGENT", (4,))[self.faces]
        with np.errstate(invalid="ignore", over="ignore"):
            hand = np.sign(np.linalg.det(self._linear)) * tangents[..., 3:]
            along = np.einsum("ij,tcj->tci", self._linear, tangents[..., :3])
        return np.concatenate([along, hand], axis=-1)

    def _read_attribute(
        self, name: str, widths: tuple[int, ...], *, is_unit: bool | None = None
    ) -> NDArray[np.float64]:
        """Return an attribute [V, K] of the vertices, with weighted morph targets added."""
        number = self._primitive["attributes"][name]
        values = self._document.values(number, widths, self._rows, is_unit=is_unit)
        targets = self._primitive.get("targets", ())
        for weight, target in zip(self._weights, targets, strict=False):
            if weight and name in target:
                morph = self._document.values(target[name], widths, self._rows, is_unit=is_unit)
                with np.errstate(invalid="ignore", over="ignore"):
                    values = values + read_number(weight, "weights") * morph
        return values


def placed_primitives(document: GltfDocument, placed: PlacedNode) -> Iterator[PlacedPrimitive]:
    """Yield the primitives of a node's mesh that have triangles, once for each instance."""
    mesh = entry(document.tree, "meshes", placed.node["mesh"])
    weights = placed.node.get("weights", mesh.get("weights", ()))
    primitives = [
        PlacedPrimitive(document, primitive, list(weights))
        for primitive in mesh["primitives"]
        if primitive.get("mode", TRIANGLES) not in POINTS_AND_LINES
        and "POSITION" in primitive["attributes"]
    ]
    for to_world in document.instances(placed):
        yield from (primitive.place(to_world) for primitive in primitives)


def _faces(order: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    if mode == TRIANGLES:
        if len(order) % 3:
            raise ValueError(f"{len(order)} corners make no whole triangles")
        return order.reshape(-1, 3)
    if mode == FAN:
        first = np.broadcast_to(order[:1], (max(len(order) - 2, 0),))
        return np.stack([order[1:-1], order[2:], first], axis=1)
    assert mode == STRIP, mode
    windows = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    windows[1::2] = windows[1::2][:, [1, 0, 2]]
    return windows


def gltf_mesh(document: GltfDocument) -> TriangleMesh:
    """Return the triangles of a file in meters, +Z up.

    Raises:
        Rejected: load_error, index_range, no_faces, cut_off, unsupported_accessor.
    """
    with refuse_malformed("load_error", "the glTF tree is"):
        return _join_primitives(_list_primitives(document))


def gltf_textured_mesh(document: GltfDocument, materials: GltfMaterials) -> TexturedMesh:
    """Return the same triangles with their materials.

    Raises:
        Rejected: no_materials, materials_unreadable, or as reading a picture.
    """
    with refuse_malformed("materials_unreadable", "the materials are"):
        primitives = _list_primitives(document)
        has_colors = any(instance.colors is not None for instance in primitives)
        if not document.tree.get("materials") and not has_colors:
            raise Rejected("no_materials", "the glTF has no materials")
        stated = [row for mesh in document.tree.get("meshes", ()) for row in mesh["primitives"]]
        used = {row["material"] for row in stated if "material" in row}
        known = {number: materials.material(number) for number in sorted(used)}
        rows: dict[int | None, int] = {number: row for row, number in enumerate(known)}
        numbers = [rows.get(instance.material, len(rows)) for instance in primitives]
        counts = [len(instance.faces) for instance in primitives]
        color = np.ones((sum(counts), 3, 3))
        uv = np.full((sum(counts), MOST_UV_SETS, 3, 2), np.nan)
        has_normal_maps = any(material.normal is not None for material in known.values())
        tangent = np.full((sum(counts), 3, 4), np.nan) if has_normal_maps else None
        for instance, last in zip(primitives, np.cumsum(counts), strict=True):
            span = slice(last - len(instance.faces), last)
            if (colors := instance.colors) is not None:
                color[span] = colors
            if tangent is not None and (tangents := instance.tangents) is not None:
                tangent[span] = tangents
            for number in range(MOST_UV_SETS):
                if (coordinates := instance.coordinates(number)) is not None:
                    uv[span, number] = coordinates
        return TexturedMesh(
            mesh=_join_primitives(primitives),
            material=np.repeat(numbers, counts),
            materials=(*known.values(), DEFAULT),
            uv=uv,
            tangent=tangent,
            color=None if (color == 1).all() else color,
        )


def _list_primitives(document: GltfDocument) -> list[PlacedPrimitive]:
    return [
        instance
        for placed in placed_meshes(document.tree)
        for instance in placed_primitives(document, placed)
    ]


def _join_primitives(primitives: Sequence[PlacedPrimitive]) -> TriangleMesh:
    if not any(len(instance.faces) for instance in primitives):
        raise Rejected("no_faces", "the file holds no triangles, or no node shows them")
    return join_meshes(
        [TriangleMesh(positions=each.positions, faces=each.faces) for each in primitives]
    )
