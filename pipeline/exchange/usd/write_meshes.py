"""The objects of a scene as meshes: one each, with its normals, and a subset per material.

An emitter is emissive geometry and a light at once: its material glows, and `MeshLightAPI` with its
default `materialGlowTintsLight` and a white intensity of 1 emits what the material glows.
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
from pipeline.exchange.usd.names import (
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
SUBSET: Attributes = {
    "elementType": ("uniform token", "face"),
    "familyName": ("uniform token", "materialBind"),
}


def add_objects(layer: Any, folder: str, scene: Scene, materials: str) -> None:
    """Write a prim for each object below `folder`; their materials stand below `materials`."""
    add_prim(layer, folder, "Scope")
    order = np.argsort(scene.object_index, kind="stable")
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    starts = np.concatenate([[0], np.cumsum(counts)])
    for row, name in enumerate(prim_names(scene)):
        faces = order[starts[row] : starts[row + 1]]
        _add_object(layer, f"{folder}/{name}", scene, row, faces, materials)


def prim_names(scene: Scene) -> list[str]:
    """Return a name for each object that USD admits and that no other has."""
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


def _add_arrays(prim: Any, scene: Scene, faces: NDArray[np.intp]) -> None:
    rows, corners = np.unique(scene.faces[faces], return_inverse=True)
    positions = scene.vertex_positions[rows]
    extent = np.stack([positions.min(axis=0), positions.max(axis=0)])
    add_attributes(
        prim,
        {
            "faceVertexCounts": ("int[]", np.full(len(faces), 3, np.int32)),
            "faceVertexIndices": ("int[]", corners.ravel().astype(np.int32)),
            "points": ("point3f[]", positions),
            "normals": ("normal3f[]", scene.vertex_normals[rows]),
            "extent": ("float3[]", extent),
            VERTEX_ROWS: ("int[]", rows.astype(np.int32)),
            FACE_ROWS: ("int[]", faces.astype(np.int32)),
        },
    )
    prim.attributes["normals"].SetInfo("interpolation", "vertex")
    if scene.uv is not None:
        own = np.ascontiguousarray(scene.uv.reshape(-1, 3, 2)[faces].reshape(-1, 2))
        add_attributes(prim, {ST: ("texCoord2f[]", own)})
        prim.attributes[ST].SetInfo("interpolation", "faceVarying")
