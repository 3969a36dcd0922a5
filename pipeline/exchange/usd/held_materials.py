"""Reads the exact material values that Trilight wrote and another program has kept.

Blender keeps the exact values of a material in addition to its shader. A column that the shader
still shows as Trilight wrote it gets its exact value; a changed column is read from the shader,
with a note. Blender writes no specular albedo, so that the exact one stays.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import constant_map, may_exceed_one
from pipeline.exchange.usd.foreign_inputs import ShaderInputs, build_textures, lower_diffuse
from pipeline.exchange.usd.foreign_textures import ForeignTexture, read_texture
from pipeline.exchange.usd.names import (
    ADDED_COLUMNS,
    MATERIAL_ATTRIBUTES,
    column_attribute,
    texture_attribute,
)
from pipeline.exchange.usd.write_textures import COAT_ROUGHNESS
from pipeline.foreign.usd.shaders import surface_shader
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import find_sources, is_output, read_texture_node
from storage.records.material import EMISSION, declared_column, default_rows, laid_out
from storage.records.texture import TEXTURED, MapSource, Texture

_STATED = {
    "diffuse": ("diffuseColor", 3),
    "specular": ("specularColor", 3),
    "roughness": ("roughness", 1),
}
"""Preview input and its channel count, by column that may be textured."""

_SAME_VALUE = 1e-5
"""Relative tolerance for a value that Trilight wrote: programs compute in float32."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldMaterial:
    """Exact values of a material that Trilight wrote."""

    where: str
    """Path of the material's prim, for notes."""
    columns: Mapping[str, NDArray[np.float32]]
    """Value of each published column by name."""
    maps: Mapping[str, tuple[str, MapSource]]
    """Digest and source of the texture of each textured column."""

    @property
    def row(self) -> NDArray[np.float32]:
        """Row [10 or more] of `Scene.materials` with the exact values."""
        row = default_rows(1)[0]
        for column, part in laid_out():
            if column.name in self.columns:
                row[part] = self.columns[column.name]
        return row


def read_held_material(material: Any, time: Any) -> HeldMaterial | None:
    """Read the exact values of a material; return None where one is missing."""
    prim = material.GetPrim()
    columns = dict[str, NDArray[np.float32]]()
    for name, attribute in MATERIAL_ATTRIBUTES.items():
        value = prim.GetAttribute(attribute)
        column = declared_column(name)
        stated = parse_numbers(value.Get(time) if value else None)
        if len(stated) != column.width or not np.all(column.within.holds(stated)):
            return None
        columns[name] = stated.astype(np.float32)
    maps = {}
    for name in TEXTURED:
        text = prim.GetAttribute(texture_attribute(name))
        held = parse_map_text(text.Get(time) if text else None)
        if held is not None:
            maps[name] = held
    return HeldMaterial(where=str(prim.GetPath()), columns=columns, maps=maps)


def parse_map_text(text: Any) -> tuple[str, MapSource] | None:
    """Parse a line of `names.format_map` to digest and source; return None for other text."""
    try:
        fields = json.loads(text)
        sha256 = fields.pop("sha256")
        source = MapSource(**fields)
    except (TypeError, ValueError, KeyError, AttributeError):
        return None
    texts = (sha256, *dataclasses.astuple(source))
    return (sha256, source) if all(isinstance(each, str) for each in texts) else None


def read_held_textures(
    held: HeldMaterial | None, material: Any, time: Any, opened: OpenedStage
) -> dict[str, ForeignTexture]:
    """Read the specular texture where only the coat roughness still refers to it."""
    from pxr import UsdShade

    if held is None or "specular" not in held.maps:
        return {}
    sources = find_sources(surface_shader(material), COAT_ROUGHNESS.removeprefix("inputs:"))
    if not sources or not is_output(sources[0]):
        return {}
    node = UsdShade.Shader(sources[0].GetPrim())
    if node.GetShaderId() != "UsdUVTexture":
        return {}
    texture = read_texture(read_texture_node(node, "rgb", time, opened), opened)
    return {} if texture is None else {"specularColor": texture}


def choose_textures(
    held: HeldMaterial | None,
    inputs: ShaderInputs,
    textures: Mapping[str, Texture],
    source: MapSource,
    where: str,
    lost: list[str],
) -> tuple[Texture, Texture, Texture]:
    """Return diffuse, specular and roughness of a material, exact where they are unchanged.

    Args:
        held: exact values that Trilight wrote, if any.
        inputs: inputs of the shader.
        textures: textures by input.
        source: name and rights of other textures.
        where: path of the mesh, for notes.
        lost: receives a sentence for each change.
    """
    if held is None:
        return build_textures(inputs, textures, source, where, lost)
    is_specular = inputs.stated.is_specular
    if not is_specular and ("metallic" in textures or inputs.constant("metallic").any()):
        lost.append(
            f"{held.where}: became a metal since Trilight wrote it; read as any other material"
        )
        return build_textures(inputs, textures, source, where, lost)
    chosen = dict[str, Texture]()
    is_changed = False
    for column, (name, channels) in _STATED.items():
        stated = textures.get(name)
        if stated is None and (column != "specular" or is_specular):
            stated = inputs.build_constant(name, channels, source)
        exact = _find_exact(held, column, stated)
        if exact is None and stated is None:
            lost.append(
                f"{held.where}: the texture of {column} is not in the file; its mean is used"
            )
            stated = Texture(texels=constant_map(held.columns[column]), source=source)
        elif exact is None:
            lost.append(
                f"{held.where}: {column} was changed since Trilight wrote it; the new value is used"
            )
            is_changed = True
        texture = stated if exact is None else exact
        assert texture is not None
        chosen[column] = texture
    diffuse = chosen["diffuse"]
    specular = chosen["specular"]
    is_textured = any(texture.constant is None for texture in (diffuse, specular))
    if is_changed and is_textured and may_exceed_one(diffuse, specular):
        diffuse, specular = lower_diffuse(diffuse, specular, source, where, lost)
    return diffuse, specular, chosen["roughness"]


def choose_emission(
    held: HeldMaterial | None, stated: NDArray[np.float32], lost: list[str]
) -> NDArray[np.float32]:
    """Return the radiance [T, 3] of triangles; the exact value where the shader agrees."""
    if held is None:
        return stated
    exact = held.row[EMISSION]
    if _agree(stated, exact):
        return np.broadcast_to(exact, stated.shape).astype(np.float32)
    lost.append(
        f"{held.where}: emission was changed since Trilight wrote it; the new value is used"
    )
    return stated


def _find_exact(held: HeldMaterial, column: str, stated: Texture | None) -> Texture | None:
    """Return the exact texture or constant of a column; None where the shader differs."""
    if column in held.maps:
        sha256, source = held.maps[column]
        is_same = stated is not None and stated.sha256 == sha256
        return dataclasses.replace(stated, source=source) if stated and is_same else None
    if stated is not None and not (
        stated.constant is not None and _agree(stated.constant, held.columns[column])
    ):
        return None
    return Texture(texels=constant_map(held.columns[column]))


def _agree(stated: NDArray[np.float32], exact: NDArray[np.float32]) -> bool:
    return bool(np.allclose(stated, exact, rtol=_SAME_VALUE, atol=0))


def name_lost_columns(material: Any) -> list[str]:
    """Return a note for each added column that the file has lost."""
    prim = material.GetPrim()
    return [
        f"{prim.GetPath()}: material column {name!r} is not in the file any more; default used"
        for name in str(prim.GetAttribute(ADDED_COLUMNS).Get() or "").split()
        if not prim.HasAttribute(column_attribute(name))
    ]


def parse_numbers(value: Any) -> NDArray[np.float64]:
    """Return an attribute's value as a row of numbers; empty for other values."""
    try:
        return np.array(value, np.float64).reshape(-1)
    except (TypeError, ValueError):
        return np.zeros(0)
