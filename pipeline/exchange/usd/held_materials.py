"""Reads the exact material values that Trilight wrote and another program has kept.

A column stands in attributes, in the preview shader and, without textures, in the OpenPBR shader.
Where none was changed since Trilight wrote it, it gets its exact value. The place that was changed
counts, with a note; of several the first. What was written is known by the scene's digest, or else
by two places that agree. Where neither tells, as in a file of Blender, the preview counts: users
edit it there. Blender writes no specular albedo, so that the exact one stays.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import (
    EXCESS,
    color_textures,
    constant_map,
    linear_map,
)
from pipeline.exchange.pictures import MAX_BYTES, MAX_PIXELS
from pipeline.exchange.textured_triangles import NO_TEXTURES, TexturedTriangles
from pipeline.exchange.usd import prim_names as names
from pipeline.exchange.usd.write_materials import (
    COAT_ROUGHNESS,
    OPENPBR,
    PREVIEW_INPUTS,
    decode_texture,
    read_openpbr,
    written_columns,
)
from pipeline.foreign.picture import decode_image
from pipeline.foreign.usd.shaders import (
    DEFAULTS,
    IOR_OF_CONSTANT_ALBEDOS,
    StatedMaterial,
    parse_color,
    surface_shader,
)
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import (
    TextureNode,
    asset_bytes,
    find_sources,
    is_output,
    read_texture_node,
)
from storage.errors import Rejected
from storage.records.exr import MAGIC
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    ROUGHNESS,
    SPECULAR,
    MaterialColumn,
    declared_column,
    laid_out,
)
from storage.records.texture import TEXTURED, MapSource, Texture

_OPENPBR = f"its shader {OPENPBR}"
"""Words for the shader, for notes."""

ROUGHNESS_PART = slice(ROUGHNESS, ROUGHNESS + 1)

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
    is_marked: bool
    """True where the scene still has Trilight's marks: no program has written it anew."""
    openpbr: Mapping[str, NDArray[np.float64]]
    """Columns [3] that its OpenPBR shader states; none without the marks."""
    written: Mapping[str, NDArray[np.float32]]
    """Value of each published column when Trilight wrote it; empty where that is not known."""


def read_held_material(
    material: Any,
    time: Any,
    opened: OpenedStage,
    rows: Mapping[str, NDArray[np.float32]],
) -> HeldMaterial | None:
    """Read the exact values of a UsdShade.Material; return None where one is missing.

    `rows` are material rows as Trilight wrote them, by the paths of their prims, where known.
    """
    prim = material.GetPrim()
    columns = dict[str, NDArray[np.float32]]()
    for name, attribute in names.MATERIAL_ATTRIBUTES.items():
        value = prim.GetAttribute(attribute)
        column = declared_column(name)
        stated = read_column(value, column, time)
        if stated is None:
            if value and value.HasAuthoredValue():
                opened.lost.append(
                    f"{value.GetPath()}: expected {column.width} numbers {column.within}; the "
                    "material is read as any other"
                )
            return None
        columns[name] = stated.astype(np.float32)
    maps = {}
    for name in TEXTURED:
        text = prim.GetAttribute(names.texture_attribute(name))
        held = names.parse_map_text(text.Get(time) if text else None)
        if held is not None:
            maps[name] = held
    where = str(prim.GetPath())
    root = prim.GetParent().GetParent()
    is_marked = bool(root) and root.HasAttribute(names.DIGEST)
    parts = {column.name: part for column, part in laid_out()}
    return HeldMaterial(
        where=where,
        columns=columns,
        maps=maps,
        is_marked=is_marked,
        openpbr=read_openpbr(material, time, opened) if is_marked else {},
        written={name: rows[where][parts[name]] for name in columns} if where in rows else {},
    )


def restore_exact(
    held: HeldMaterial,
    stated: StatedMaterial | None,
    material: Any,
    time: Any,
    opened: OpenedStage,
) -> tuple[StatedMaterial, dict[str, Texture] | None]:
    """Return the inputs of a material that Trilight wrote, and its exact columns."""
    if stated is None:
        opened.lost.append(f"{held.where}: no shader; the values that Trilight wrote are used")
        stated = _as_stated(held)
    elif not stated.is_specular and (
        "metallic" in stated.textures or stated.constants["metallic"].any()
    ):
        opened.lost.append(
            f"{held.where}: became a metal since Trilight wrote it; read as any other material"
        )
        return stated, None
    else:
        stated = _restore_stated(held, stated, material, time, opened)
    return _find_exact(held, stated, opened.lost)


def _restore_stated(
    held: HeldMaterial, stated: StatedMaterial, material: Any, time: Any, opened: OpenedStage
) -> StatedMaterial:
    """Return the inputs of a shader in the workflow that Trilight writes.

    Blender writes no specular albedo: the exact one is taken, or the texture that the roughness of
    the absent coat still refers to.
    """
    from pxr import UsdShade

    textures = dict(stated.textures)
    constants = {**stated.constants, **_WORKFLOW}
    if stated.has_strength and "emissiveColor" not in {*stated.textures, *stated.primvars}:
        constants["emissiveColor"] = constants["emissiveColor"] * constants["strength"]
        stated = dataclasses.replace(stated, has_strength=False)
    sources = find_sources(surface_shader(material), COAT_ROUGHNESS.removeprefix("inputs:"))
    if held.is_marked:
        _note_unused(held, stated, surface_shader(material), time, opened.lost)
    if "specular" in held.maps and sources and is_output(sources[0]):
        node = UsdShade.Shader(sources[0].GetPrim())
        if "specularColor" not in textures and node.GetShaderId() == "UsdUVTexture":
            textures["specularColor"] = read_texture_node(node, "rgb", time, opened)
    if not stated.is_specular:
        constants["specularColor"] = held.columns["specular"]
        if "specular" in held.maps and "specularColor" not in textures:
            opened.lost.append(
                f"{held.where}: the texture of specular is not in the file; its mean is used"
            )
    return dataclasses.replace(stated, constants=constants, textures=textures)


def _note_unused(
    held: HeldMaterial, stated: StatedMaterial, shader: Any, time: Any, lost: list[str]
) -> None:
    """Note changes that have no effect: of constants below textures, and of the workflow."""
    for column, name in PREVIEW_INPUTS.items():
        constant = parse_color(shader.GetInput(name).Get(time)) if name in stated.textures else None
        if constant is not None and not np.allclose(constant, held.columns[column], _SAME_VALUE, 0):
            lost.append(
                f"{held.where}: {column} has a texture, which is used, not its changed constant; "
                "disconnect the texture to use that"
            )
    for name, value in _WORKFLOW.items():
        if shader.GetInput(name) and (stated.constants[name] != value).any():
            lost.append(f"{stated.where}.{name}: has no place here")


def _as_stated(held: HeldMaterial) -> StatedMaterial:
    """Return a material of the values that Trilight wrote, for one that has lost its shader."""
    values = {name: _fill(held.columns[column]) for column, name in PREVIEW_INPUTS.items()}
    return StatedMaterial(
        name=held.where.rpartition("/")[2],
        where=held.where,
        constants={
            **{name: _fill(value) for name, value in DEFAULTS.items()},
            **values,
            **_WORKFLOW,
        },
        textures={},
        primvars={},
        has_strength=False,
        lost=(),
        has_networks=False,
    )


def _find_exact(
    held: HeldMaterial, stated: StatedMaterial, lost: list[str]
) -> tuple[StatedMaterial, dict[str, Texture]]:
    """Return the inputs with the values that count, and the columns as Trilight wrote them.

    Each other column gets a note. A constant, such as emission, is a texture of one texel.
    """
    exact = {}
    constants = dict(stated.constants)
    for column, name in PREVIEW_INPUTS.items():
        node = stated.textures.get(name)
        texture = None
        place = _name_shader(stated)
        unused = list[str]()
        if name in stated.primvars:
            pass
        elif node is not None:
            texture = _read_exact_texture(held, column, node, stated.textures.values())
        elif changed := _find_changed(held, stated, column):
            (place, value), *rest = changed.items()
            unused = [word for word, each in rest if not np.allclose(each, value, rtol=1e-3)]
            constants[name] = _fill(value)
        else:
            texture = Texture(texels=constant_map(held.columns[column]))
        if texture is not None:
            exact[column] = texture
            continue
        text = f"{column} was changed since Trilight wrote it; the value of {place} is used"
        if unused:
            text += f", not of {' or '.join(unused)}; make them equal to choose"
        lost.append(f"{held.where}: {text}")
    return dataclasses.replace(stated, constants=constants), exact


def _find_changed(
    held: HeldMaterial, stated: StatedMaterial, column: str
) -> dict[str, NDArray[Any]]:
    """Return the changed values of a constant column by their places, the one that counts first.

    Where it is not known which of them was changed, all are returned.
    """
    of_preview = {each: stated.constants[name] for each, name in PREVIEW_INPUTS.items()}
    places: dict[str, NDArray[Any]] = {
        names.column_attribute(column): held.columns[column],
        _name_shader(stated): of_preview[column],
    }
    if column in held.openpbr:
        places[_OPENPBR] = held.openpbr[column]
    for written in [held.written] if held.written else [of_preview, held.columns]:
        openpbr = written_columns(written)
        changed = {
            place: value
            for place, value in places.items()
            if not np.allclose(
                value,
                (openpbr if place == _OPENPBR else written)[column],
                rtol=_SAME_VALUE,
                atol=0,
            )
        }
        if held.written or len(changed) <= len(places) - 2:
            return changed
    return places if held.openpbr else dict(reversed(places.items()))


def _name_shader(stated: StatedMaterial) -> str:
    return f"its shader {stated.where.rpartition('/')[2]}"


def _read_exact_texture(
    held: HeldMaterial, column: str, node: TextureNode, nodes: Iterable[TextureNode]
) -> Texture | None:
    """Return the texture of a column; None where its file or its use differs."""
    is_used_alike = all(
        each.wrap == ("repeat", "repeat")
        and each.chart.primvar == node.chart.primvar
        and not each.chart.is_moved
        and (each.scale == 1).all()
        and not each.bias.any()
        for each in nodes
    )
    data = None if node.resolved is None else asset_bytes(node.resolved, MAX_BYTES)
    if column not in held.maps or not is_used_alike or data is None:
        return None
    sha256, source = held.maps[column]
    is_srgb = node.color_space == "sRGB"
    try:
        if data.startswith(MAGIC):
            texture = decode_texture(data, is_exr=True, is_srgb=False, source=source)
        else:
            values = decode_image(data, node.named, MAX_PIXELS, [])
            chosen = values[..., :3] if column != "roughness" else values[..., :1]
            texels = np.ascontiguousarray(chosen)
            texture = Texture(texels=texels, is_srgb=is_srgb, source=source)
    except (LookupError, Rejected):
        return None
    return texture if texture.sha256 == sha256 else None


def keep_exact(
    triangles: TexturedTriangles, exact: Mapping[str, Texture], where: str, lost: list[str]
) -> TexturedTriangles:
    """Return triangles whose unchanged columns are exact, and diffuse + specular at most 1."""
    rows = triangles.rows.copy()
    if "emission" in exact:
        rows[:, EMISSION] = exact["emission"].mean
    note = f"{where}: diffuse lowered where diffuse + specular is over 1"
    if triangles.texture_sets[0] == NO_TEXTURES:
        for column, part in zip(TEXTURED, (DIFFUSE, SPECULAR, ROUGHNESS_PART), strict=True):
            if column in exact:
                rows[:, part] = exact[column].mean
        excess = (rows[:, DIFFUSE] + rows[:, SPECULAR]).max(axis=1, initial=0) > 1 + EXCESS
        if excess.any():
            lost.append(note)
            rows[excess, DIFFUSE] = np.minimum(rows[excess, DIFFUSE], 1 - rows[excess, SPECULAR])
        return dataclasses.replace(triangles, rows=rows)
    texture_sets = []
    for texture_set in triangles.texture_sets:
        diffuse, specular, roughness = (
            exact.get(column, texture)
            for column, texture in zip(TEXTURED, texture_set, strict=True)
        )
        assert diffuse is not None and specular is not None
        exceeds = (diffuse.greatest + specular.greatest > 1 + EXCESS).any()
        if exceeds and not {"diffuse", "specular"} <= exact.keys():
            lost.append(note)
            source = diffuse.source
            diffuse, specular = color_textures(linear_map(diffuse), linear_map(specular), source)
        texture_sets.append((diffuse, specular, roughness))
    return dataclasses.replace(triangles, rows=rows, texture_sets=texture_sets)


def _fill(value: Any) -> NDArray[np.float32]:
    return np.broadcast_to(np.asarray(value, np.float32), 3)


_WORKFLOW = {"useSpecularWorkflow": _fill(1), "ior": _fill(IOR_OF_CONSTANT_ALBEDOS)}
"""Inputs that Trilight writes to every material."""


def name_lost_columns(material: Any) -> list[str]:
    """Return a note for each added column that the file has lost."""
    prim = material.GetPrim()
    return [
        f"{prim.GetPath()}: material column {name!r} is not in the file any more; default used"
        for name in str(prim.GetAttribute(names.ADDED_COLUMNS).Get() or "").split()
        if not prim.HasAttribute(names.column_attribute(name))
    ]


def read_column(attribute: Any, column: MaterialColumn, time: Any) -> NDArray[np.float64] | None:
    """Return the lawful value of a column's attribute as a row of numbers; else None."""
    try:
        value = np.array(attribute.Get(time) if attribute else None, np.float64).reshape(-1)
    except (TypeError, ValueError):
        return None
    return value if len(value) == column.width and np.all(column.within.holds(value)) else None
