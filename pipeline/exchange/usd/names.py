"""Paths of a scene in a USD stage, and attributes for what USD has no word for.

    /Scene                        Xform, the default prim: provenance and digest
    /Scene/Materials/material_<m> one per material row: UsdPreviewSurface, and OpenPBR or textures
    /Scene/Objects/<name>         one Mesh per object, about its center, with a subset per material
    /Scene/Cameras/camera_<c>     one per camera
    /Scene/Environment            a DomeLight, where there is an environment

Programs that know nothing of Trilight keep attributes of prims, but not of shaders, and no arrays:
materials also say what their textures are, and the scene what its sky is.

A shard is `/Scenes` with a variant set `scene`: one variant per sample, named by its key, each with
a `/Scenes/Scene` as above. Everything under the namespace `trilight:` is exact; the rest of a prim
says the same as well as USD can.
"""

import dataclasses

from storage.digests import canonical_json
from storage.records.texture import MapSource

NAMESPACE = "trilight:"
ROOT = "/Scene"
SHARD_ROOT = "/Scenes"
VARIANT_SET = "scene"

VERSION = NAMESPACE + "schemaVersion"
DIGEST = NAMESPACE + "sceneSha256"
PROVENANCE = NAMESPACE + "provenance"
UNUSED_ROWS = NAMESPACE + "unusedVertexRows"
UNUSED_POSITIONS = NAMESPACE + "unusedPositions"
UNUSED_NORMALS = NAMESPACE + "unusedNormals"
"""Attributes of `/Scene`, which also keeps the vertices that belong to no triangle."""

INDEX = NAMESPACE + "index"
VERTEX_ROWS = NAMESPACE + "vertexRows"
FACE_ROWS = NAMESPACE + "faceRows"
VISIBLE_TO_CAMERA = NAMESPACE + "visibleToCamera"
OBJECT_TEXTS = {
    "name": NAMESPACE + "name",
    "kind": NAMESPACE + "kind",
    "uid": NAMESPACE + "uid",
    "licence": NAMESPACE + "licence",
    "attribution": NAMESPACE + "attribution",
    "source_url": NAMESPACE + "sourceUrl",
}
"""Attributes of a mesh: row of its object, rows of vertices and faces, fields of SceneObject."""

MAP_TEXTS = {
    "name": NAMESPACE + "name",
    "licence": NAMESPACE + "licence",
    "attribution": NAMESPACE + "attribution",
    "source_url": NAMESPACE + "sourceUrl",
}
"""Attributes of a dome and of a texture: fields of MapSource."""

SKY_ROWS = tuple(f"{NAMESPACE}skyRotationRow{row}" for row in range(3))
SKY_VISIBLE = NAMESPACE + "skyVisibleToCamera"
SKY_SOURCE = NAMESPACE + "skySource"
"""Attributes of `/Scene` where there is an environment: its rotation in rows, whether it is seen,
and its map (format_map). Blender makes a world of a dome, which keeps no attribute of its prim."""

TEXTURE_ROW = NAMESPACE + "textureRow"
"""Attribute of a texture's shader: its row among the textures of the scene."""

EXACT_ROWS = NAMESPACE + "exactRows"
EXACT_POSITIONS = NAMESPACE + "exactPositions"
"""Attributes of a mesh: its vertices whose position is not the sum of center and point, in single
precision, and where they are."""

_TEXTURE_SOURCE = NAMESPACE + "texture:"
"""Prefix of the attribute of a textured column of a material: its texture (format_map)."""

MATERIAL_ATTRIBUTES = {
    "diffuse": NAMESPACE + "diffuseAlbedo",
    "specular": NAMESPACE + "specularAlbedo",
    "roughness": NAMESPACE + "roughness",
    "emission": NAMESPACE + "emittedRadiance",
}
"""Attributes of a material, by the names of its columns (storage.records.material)."""

_ADDED_COLUMN = NAMESPACE + "column:"
"""Prefix of the attribute of a column that was added to the published ones."""

ADDED_COLUMNS = NAMESPACE + "columns"
"""Attribute of a material: names of its added columns, since programs may keep texts alone."""

FOV_DEG = NAMESPACE + "fovDeg"
"""Attribute of a camera; its pose is the transform, in doubles that hold floats exactly."""


def column_attribute(column: str) -> str:
    """Return the attribute of a material column; of an added one it ends in the column's name."""
    return MATERIAL_ATTRIBUTES.get(column, _ADDED_COLUMN + column)


def added_column(attribute: str) -> str | None:
    """Return the column beyond the published ones whose attribute this is; None for any other."""
    column = attribute.removeprefix(_ADDED_COLUMN)
    return None if column == attribute else column


def texture_attribute(column: str) -> str:
    """Return the attribute of a material that says which texture stands for a column."""
    return _TEXTURE_SOURCE + column


def format_map(sha256: str, source: MapSource) -> str:
    """Return one line for a texture or a map: the digest of its content, its name and rights."""
    return canonical_json({"sha256": sha256, **dataclasses.asdict(source)}).decode()


def material_name(row: int) -> str:
    """Return the name of the prim of a material row."""
    return f"material_{row}"


def camera_name(row: int) -> str:
    """Return the name of the prim of a camera."""
    return f"camera_{row}"


def parse_camera_row(name: str) -> int | None:
    """Return the row of the camera of a prim's name; None where it is no such name."""
    row = name.removeprefix("camera_")
    return int(row) if row.isdecimal() and camera_name(int(row)) == name else None
