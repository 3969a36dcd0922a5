"""Layout of a scene in a USD stage: names of its prims and attributes, and how both are written.

    /Scene                        Xform, the default prim: provenance and digest
    /Scene/Materials/material_<m> one per material row: UsdPreviewSurface, and OpenPBR or textures
    /Scene/Objects/<name>         one Mesh per object, about its center, with a subset per material
    /Scene/Cameras/camera_<c>     one per camera
    /Scene/Environment            a DomeLight, where there is an environment

Other programs keep attributes of prims, but not of shaders, and no arrays. So materials also record
their textures, and the scene its sky.

A shard is `/Scenes` with a variant set `scene`: one variant per sample, named by its key, each with
a `/Scenes/Scene` as above. Attributes in the namespace `trilight:` are exact; the rest of a
prim states the same as closely as USD can.

Prims and attributes are written straight into a layer, with a hundredth of the calls of schemas.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Sdf

from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.texture import MapSource
from storage.typed_json import read_json

NAMESPACE = "trilight:"
ROOT = "/Scene"
SHARD_ROOT = "/Scenes"
VARIANT_SET = "scene"

SAME_VALUE = 1e-5
"""Tolerance for a value that Trilight wrote: other programs compute in float32."""

VERSION = NAMESPACE + "schemaVersion"
DIGEST = NAMESPACE + "sceneSha256"
PROVENANCE = NAMESPACE + "provenance"
UNUSED_ROWS = NAMESPACE + "unusedVertexRows"
UNUSED_POSITIONS = NAMESPACE + "unusedPositions"
UNUSED_NORMALS = NAMESPACE + "unusedNormals"
"""Attributes of `/Scene`, which also stores the vertices that belong to no triangle."""

INDEX = NAMESPACE + "index"
VERTEX_ROWS = NAMESPACE + "vertexRows"
FACE_ROWS = NAMESPACE + "faceRows"
VISIBLE_TO_CAMERA = NAMESPACE + "visibleToCamera"
OBJECT_TEXTS = {
    **{name: NAMESPACE + name for name in ("name", "kind", "uid", "licence", "attribution")},
    "source_url": NAMESPACE + "sourceUrl",
}
"""Attributes of a mesh: row of its object, rows of vertices and faces, fields of SceneObject."""

MAP_TEXTS = {name: OBJECT_TEXTS[name] for name in ("name", "licence", "attribution", "source_url")}
"""Attributes of a dome and of a texture: fields of MapSource."""

SKY_ROWS = tuple(f"{NAMESPACE}skyRotationRow{row}" for row in range(3))
SKY_VISIBLE = NAMESPACE + "skyVisibleToCamera"
SKY_SOURCE = NAMESPACE + "skySource"
"""Attributes of `/Scene` where there is an environment: rotation rows, visibility, and map
(format_map). Blender converts a dome to a world and drops the attributes of its prim."""

TO_OUR_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from the axes of a dome to those of a map: X to Y, Y to Z, Z to X.

A dome has the middle of its picture towards +Z, a quarter from the left towards +X and the top
towards +Y, whatever the axis of the stage. Writing and reading both apply the rotation, so that a
scene round-trips bit for bit and other programs show the same sky.
"""

MAP_PATH = "inputs:texture:file"
"""Attribute of a dome: its map file."""

TEXTURE_ROW = NAMESPACE + "textureRow"
"""Attribute of a texture's shader: its row among the textures of the scene."""

EXACT_ROWS = NAMESPACE + "exactRows"
EXACT_POSITIONS = NAMESPACE + "exactPositions"
"""Attributes of a mesh: rows and positions of the vertices whose position differs from center plus
point in float32."""

TEXTURE_SOURCE = NAMESPACE + "texture:"
"""Prefix of the attribute that names the texture of a material column (format_map)."""

MATERIAL_ATTRIBUTES = {
    "diffuse": NAMESPACE + "diffuseAlbedo",
    "specular": NAMESPACE + "specularAlbedo",
    "roughness": NAMESPACE + "roughness",
    "emission": NAMESPACE + "emittedRadiance",
}
"""Attributes of a material, by the names of its columns (storage.records.material)."""

_ADDED_COLUMN = NAMESPACE + "column:"
"""Prefix of the attribute of a column beyond the published ones."""

ADDED_COLUMNS = NAMESPACE + "columns"
"""Attribute of a material: names of its added columns, since some programs keep only texts."""

FOV_DEG = NAMESPACE + "fovDeg"
"""Attribute of a camera; its pose is the transform, in doubles that hold floats exactly."""


def column_attribute(column: str) -> str:
    """Return the attribute name of a material column."""
    return MATERIAL_ATTRIBUTES.get(column, _ADDED_COLUMN + column)


def column_of(attribute: str) -> str | None:
    """Return the material column of an attribute name; None for other attributes."""
    published = {name: column for column, name in MATERIAL_ATTRIBUTES.items()}
    added = attribute.removeprefix(_ADDED_COLUMN)
    return published.get(attribute, None if added == attribute else added)


def format_map(sha256: str, source: MapSource) -> str:
    """Return one line of JSON for a texture or map: content digest, name and rights."""
    return canonical_json({"sha256": sha256, **dataclasses.asdict(source)}).decode()


def parse_map_text(text: Any) -> tuple[str, MapSource] | None:
    """Parse a line of `format_map` to digest and source; return None for other text."""
    try:
        fields = read_json(str(text), dict[str, str], "")
        return fields.pop("sha256"), MapSource(**fields)
    except (TrilightError, TypeError, KeyError):
        return None


def material_name(row: int) -> str:
    """Return the name of the prim of a material row."""
    return f"material_{row}"


def camera_name(row: int) -> str:
    """Return the name of the prim of a camera."""
    return f"camera_{row}"


def parse_camera_row(name: str) -> int | None:
    """Return the camera row in a prim's name; None for other names."""
    row = name.removeprefix("camera_")
    return int(row) if row.isdecimal() and camera_name(int(row)) == name else None


Attributes = Mapping[str, tuple[str, Any] | tuple[str, Any, str]]
"""Type name, value and connected output, if any, of each attribute by name.

The prefix "uniform " of a type sets its variability. Inputs and outputs may have the value None. An
output is named by its path below the material.
"""

UNIFORM = "uniform "


def text_attributes(fields: Mapping[str, str], record: Any) -> dict[str, tuple[str, Any]]:
    """Return attributes of a record's fields that are texts; `fields` has their names."""
    return {name: ("string", getattr(record, field)) for field, name in fields.items()}


def add_prim(layer: Any, path: str, type_name: str, schemas: Sequence[str] = ()) -> Any:
    """Return a new prim of a type, with API schemas applied."""
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier = Sdf.SpecifierDef
    prim.typeName = type_name
    if schemas:
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=list(schemas)))
    return prim


def add_attributes(prim: Any, attributes: Attributes, material: str = "") -> None:
    """Write attributes with default values, and connections to outputs below `material`."""
    for name, (kind, value, *sources) in attributes.items():
        uniform = kind.startswith(UNIFORM)
        attribute = Sdf.AttributeSpec(
            prim,
            name,
            _value_type(kind),
            Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying,
            name.startswith(NAMESPACE),
        )
        if value is not None:
            attribute.default = usd_converter(kind)(value)
        if sources:
            paths = [_target(f"{material}/{source}") for source in sources]
            attribute.connectionPathList.explicitItems = paths


def add_relationship(prim: Any, name: str, target: str) -> None:
    """Write a relationship to one prim."""
    relationship = Sdf.RelationshipSpec(prim, name, False)
    relationship.targetPathList.explicitItems = [_target(target)]


def _target(path: str) -> Any:
    """Return the path of a prim as other prims name it, without variant selections."""
    return Sdf.Path(path).StripAllVariantSelections()


@functools.cache
def _value_type(kind: str) -> Any:
    return Sdf.ValueTypeNames.Find(kind.removeprefix(UNIFORM))


@functools.cache
def usd_converter(kind: str) -> Callable[[Any], Any]:
    """Return the converter of values to a USD type; cached, since scenes have 10^5 values."""
    python_class = Sdf.AssetPath if kind == "asset" else _value_type(kind).type.pythonClass
    if hasattr(python_class, "FromNumpy"):
        return lambda values: python_class.FromNumpy(np.ascontiguousarray(values))
    return python_class or (lambda value: value)  # numbers and texts have no class
