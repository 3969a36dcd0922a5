"""Writes each object of a scene as a mesh with normals and a subset for each material.

The origin of a mesh is the center of its bounding box, since other programs rotate and scale an
object about its origin; points are relative to it. Where center plus point in float32 differs from
the position, an attribute holds the exact position.

An emitter is emissive geometry and a light: its material emits, and `MeshLightAPI` with its default
`materialGlowTintsLight` and a white intensity of 1 emits the radiance of the material.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import (
    Attributes,
    add_attributes,
    add_prim,
    add_relationship,
)
from pipeline.exchange.usd.prim_names import (
    EXACT_POSITIONS,
    EXACT_ROWS,
    FACE_ROWS,
    INDEX,
    OBJECT_TEXTS,
    VERTEX_ROWS,
    VISIBLE_TO_CAMERA,
    material_name,
)
from pipeline.exchange.usd.write_textures import ST
from storage.records.scene import Scene

BINDING = "material:binding"
LIGHT: Attributes = {
    "inputs:intensity": ("float", 1.0),
    "inputs:exposure": ("float", 0.0),
    "inputs:color": ("color3f", (1.0, 1.0, 1.0)),
    "inputs:normalize": ("bool", False),
    "light:materialSyncMode": ("uniform token", "materialGlowTintsLight"),
}
MESH: Attributes = {
    "doubleSided": ("uniform bool", True),
    "orientation": ("uniform token", "rightHanded"),
    "subdivisionScheme": ("uniform token", "none"),
    "subsetFamily:materialBind:familyType": ("uniform token", "partition"),
}
CENTER = "xformOp:translate"
"""Name of the transform to the center, which USD's common API sets."""

SUBSET: Attributes = {
    "elementType": ("uniform token", "face"),
    "familyName": ("uniform token", "materialBind"),
}


def add_objects(layer: Any, folder: str, scene: Scene, materials: str) -> None:
    """Write a prim for each object below `folder`; the materials are below `materials`."""
    add_prim(layer, folder, "Scope")
    order = np.argsort(scene.object_index, kind="stable")
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    starts = np.concatenate([[0], np.cumsum(counts)])
    for row, name in enumerate(prim_names(scene)):
        faces = order[starts[row] : starts[row + 1]]
        _add_object(layer, f"{folder}/{name}", scene, row, faces, materials)


def prim_names(scene: Scene) -> list[str]:
    """Return a unique and valid USD name for each object."""
    from pxr import Tf

    taken: set[str] = set()
    names = []
    for row, entry in enumerate(scene.objects):
        name = Tf.MakeValidIdentifier(entry.name or "object")
        while name in taken:
            name = f"{name}_{row}"
        taken.add(name)
        names.append(name)
    return names


def object_attributes(scene: Scene, row: int) -> Attributes:
    """Return the attributes of an object's prim other than its arrays."""
    entry = scene.objects[row]
    return {
        INDEX: ("int", row),
        **{name: ("string", getattr(entry, field)) for field, name in OBJECT_TEXTS.items()},
        VISIBLE_TO_CAMERA: ("bool", entry.kind != "emitter"),
        **(LIGHT if entry.kind == "emitter" else {}),
    }


def _add_object(
    layer: Any, path: str, scene: Scene, row: int, faces: NDArray[np.intp], materials: str
) -> None:
    emits = scene.objects[row].kind == "emitter"
    if len(faces) == 0:
        empty = add_prim(layer, path, "Xform")
        add_attributes(empty, object_attributes(scene, row))
        return
    schemas = ["MaterialBindingAPI", *(["MeshLightAPI"] if emits else [])]
    prim = add_prim(layer, path, "Mesh", schemas)
    add_attributes(prim, {**object_attributes(scene, row), **MESH})
    _add_arrays(prim, scene, faces)
    index = scene.material_index[faces]
    used = np.unique(index)
    add_relationship(prim, BINDING, f"{materials}/{material_name(used[0])}")
    for material in used:
        name = material_name(material)
        subset = add_prim(layer, f"{path}/{name}", "GeomSubset", ["MaterialBindingAPI"])
        chosen = np.flatnonzero(index == material).astype(np.int32)
        add_attributes(subset, {**SUBSET, "indices": ("int[]", chosen)})
        add_relationship(subset, BINDING, f"{materials}/{name}")


def center_points(
    positions: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the center [3] of positions [V, 3] as float32 values, and points relative to it."""
    wide = positions.astype(np.float64)
    middle = (wide.min(axis=0) + wide.max(axis=0)) / 2
    center = middle.astype(np.float32).astype(np.float64)
    return center, (wide - center).astype(np.float32)


def sum_positions(center: NDArray[np.float64], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the float32 positions of points [V, 3] about a center."""
    return (points.astype(np.float64) + center).astype(np.float32)


def position_attributes(
    center: NDArray[np.float64], points: NDArray[np.float32], positions: NDArray[np.float32]
) -> Attributes:
    """Return the center of a mesh, and exact positions where center plus point differs."""
    same = sum_positions(center, points).view(np.uint32) == positions.view(np.uint32)
    rows = np.flatnonzero(~same.all(axis=1))
    return {
        CENTER: ("double3", center.tolist()),
        "xformOpOrder": ("uniform token[]", (CENTER,)),
        EXACT_ROWS: ("int[]", rows.astype(np.int32)),
        EXACT_POSITIONS: ("point3f[]", positions[rows]),
    }


def _add_arrays(prim: Any, scene: Scene, faces: NDArray[np.intp]) -> None:
    rows, corners = np.unique(scene.faces[faces], return_inverse=True)
    center, points = center_points(scene.vertex_positions[rows])
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    add_attributes(
        prim,
        {
            **position_attributes(center, points, scene.vertex_positions[rows]),
            "faceVertexCounts": ("int[]", np.full(len(faces), 3, np.int32)),
            "faceVertexIndices": ("int[]", corners.ravel().astype(np.int32)),
            "points": ("point3f[]", points),
            "normals": ("normal3f[]", scene.vertex_normals[rows]),
            "extent": ("float3[]", extent),
            VERTEX_ROWS: ("int[]", rows.astype(np.int32)),
            FACE_ROWS: ("int[]", faces.astype(np.int32)),
        },
    )
    prim.attributes["normals"].SetInfo("interpolation", "vertex")
    if scene.uv is not None:
        corner_uv = np.ascontiguousarray(scene.uv.reshape(-1, 3, 2)[faces].reshape(-1, 2))
        add_attributes(prim, {ST: ("texCoord2f[]", corner_uv)})
        prim.attributes[ST].SetInfo("interpolation", "faceVarying")
