"""Reads the exact material values that Trilight wrote and another program has kept.

A column stands in attributes, in the preview shader and, without textures, in the OpenPBR shader.
Where none was changed since Trilight wrote it, it gets its exact value. The place that was changed
counts, with a note; of several the first. What was written is known by the scene's digest, or else
by two places that agree. Where neither tells, as in a file of Blender, the preview counts: users
edit it there. Blender writes no specular albedo, so that the exact one stays.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdShade

from pipeline.exchange.textured_triangles import (
    EXCESS,
    NO_TEXTURES,
    TexturedTriangles,
    color_textures,
    constant_map,
    linear_map,
)
from pipeline.exchange.usd import layout
from pipeline.exchange.usd.write_materials import (
    COAT_ROUGHNESS,
    OPENPBR,
    OPENPBR_SHADER,
    PREVIEW_INPUTS,
    decode_texture,
    openpbr_inputs,
)
from pipeline.foreign.picture import MAX_BYTES
from pipeline.foreign.usd.shaders import (
    DEFAULTS,
    IOR_OF_CONSTANT_ALBEDOS,
    ShaderReader,
    StatedMaterial,
    parse_color,
    reflect_head_on,
    surface_shader,
)
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import (
    TextureNode,
    asset_bytes,
    convert_to_rec709,
    find_sources,
    is_output,
    read_texture_node,
)
from storage.records.material import DIFFUSE, SPECULAR, column_places, laid_out
from storage.records.texture import TEXTURED, MapSource, Texture

_OPENPBR = f"its shader {OPENPBR}"
"""Words for the shader, for notes."""

_INPUTS = {
    "diffuse": ("base_weight", "base_color"),
    "specular": ("specular_weight", "specular_color", "specular_ior"),
    "roughness": ("specular_roughness",),
    "emission": ("emission_luminance", "emission_color"),
}
"""OpenPBR's inputs whose product is a column; an index of refraction counts as its reflectance."""


def read_columns(prim: Any, opened: OpenedStage) -> dict[str, NDArray[np.float32]]:
    """Return the columns that Trilight wrote on the prim of a material, by name.

    Its notes receive one for each that is not declared, not lawful or not there any more.
    """
    declared = {column.name: column for column, _ in laid_out()}
    columns = dict[str, NDArray[np.float32]]()
    missing = str(prim.GetAttribute(layout.ADDED_COLUMNS).Get() or "").split()
    for attribute in prim.GetAuthoredAttributes():
        name = layout.column_of(attribute.GetName())
        if name is None:
            continue
        missing = [each for each in missing if each != name]
        column = declared.get(name)
        if column is None:
            opened.lost.append(f"{attribute.GetPath()}: this material column is not declared here")
            continue
        try:
            value = np.array(attribute.Get(opened.time), np.float64).reshape(-1)
        except (TypeError, ValueError):
            value = np.zeros(0)
        if len(value) == column.width and np.all(column.within.holds(value)):
            columns[name] = value.astype(np.float32)
        else:
            opened.lost.append(
                f"{attribute.GetPath()}: expected {column.width} numbers {column.within}; it is "
                "not used"
            )
    opened.lost += [
        f"{prim.GetPath()}: material column {name!r} is not in the file any more; default used"
        for name in missing
    ]
    return columns


class HeldMaterial:
    """A material that Trilight wrote, of which another program has kept the exact values."""

    def __init__(
        self,
        material: Any,
        columns: Mapping[str, NDArray[np.float32]],
        written: Mapping[str, Mapping[str, NDArray[np.float32]]],
        opened: OpenedStage,
    ) -> None:
        """Read the values of a UsdShade.Material, whose exact columns are known.

        `written` has the columns as Trilight wrote them, by the paths of materials, where known;
        the notes of `opened` receive what is lost.
        """
        prim = material.GetPrim()
        root = prim.GetParent().GetParent()
        self._where = str(prim.GetPath())
        self._shader = surface_shader(material)
        self._columns = columns
        self._written = written.get(self._where, {})
        self._opened = opened
        self._maps: dict[str, tuple[str, MapSource]] = {}
        for name in TEXTURED:
            text = prim.GetAttribute(layout.TEXTURE_SOURCE + name).Get(opened.time)
            if (held := layout.parse_map_text(text)) is not None:
                self._maps[name] = held
        self._is_marked = bool(root) and root.HasAttribute(layout.DIGEST)
        self._openpbr = _read_openpbr(material, opened) if self._is_marked else {}

    def restore(
        self, stated: StatedMaterial | None
    ) -> tuple[StatedMaterial, dict[str, Texture] | None]:
        """Return the inputs of the shader with the values that count, and the exact columns.

        A constant, such as emission, is a texture of one texel. A material that became a metal has
        no exact columns, and a note.
        """
        if stated is None:
            self._note("no shader; the values that Trilight wrote are used")
            return self._find_exact(self._as_stated())
        if not stated.is_specular and (
            "metallic" in stated.textures or stated.constants["metallic"].any()
        ):
            self._note("became a metal since Trilight wrote it; read as any other material")
            return stated, None
        return self._find_exact(self._restore_workflow(stated))

    def _note(self, text: str) -> None:
        self._opened.lost.append(f"{self._where}: {text}")

    def _restore_workflow(self, stated: StatedMaterial) -> StatedMaterial:
        """Return the inputs of a shader in the workflow that Trilight writes.

        Blender writes no specular albedo: the exact one is taken, or the texture that the roughness
        of the absent coat still refers to.
        """
        textures = dict(stated.textures)
        constants = {**stated.constants, **_WORKFLOW}
        if stated.has_strength and "emissiveColor" not in {*stated.textures, *stated.primvars}:
            constants["emissiveColor"] = constants["emissiveColor"] * constants["strength"]
            stated = dataclasses.replace(stated, has_strength=False)
        if self._is_marked:
            self._note_unused(stated)
        sources = find_sources(self._shader, COAT_ROUGHNESS.removeprefix("inputs:"))
        if "specular" in self._maps and sources and is_output(sources[0]):
            node = UsdShade.Shader(sources[0].GetPrim())
            if "specularColor" not in textures and node.GetShaderId() == "UsdUVTexture":
                textures["specularColor"] = read_texture_node(node, "rgb", self._opened)
        if not stated.is_specular:
            constants["specularColor"] = self._columns["specular"]
            if "specular" in self._maps and "specularColor" not in textures:
                self._note("the texture of specular is not in the file; its mean is used")
        return dataclasses.replace(stated, constants=constants, textures=textures)

    def _note_unused(self, stated: StatedMaterial) -> None:
        """Note changes that have no effect: of constants below textures, and of the workflow."""
        for column, name in PREVIEW_INPUTS.items():
            if name not in stated.textures:
                continue
            constant = parse_color(self._shader.GetInput(name).Get(self._opened.time))
            written = self._columns[column]
            if constant is not None and not np.allclose(constant, written, layout.SAME_VALUE, 0):
                self._note(
                    f"{column} has a texture, which is used, not its changed constant; disconnect "
                    "the texture to use that"
                )
        for name, value in _WORKFLOW.items():
            if self._shader.GetInput(name) and (stated.constants[name] != value).any():
                self._opened.lost.append(f"{stated.where}.{name}: has no place here")

    def _as_stated(self) -> StatedMaterial:
        """Return a material of the values that Trilight wrote, for one that has lost its shader."""
        values = {name: self._columns[column] for column, name in PREVIEW_INPUTS.items()}
        constants = {**DEFAULTS, **values, **_WORKFLOW}
        return StatedMaterial(
            name=self._where.rpartition("/")[2],
            where=self._where,
            constants={name: _fill(value) for name, value in constants.items()},
        )

    def _find_exact(self, stated: StatedMaterial) -> tuple[StatedMaterial, dict[str, Texture]]:
        """Return the inputs with the values that count, and the columns as Trilight wrote them.

        Each other column gets a note.
        """
        exact = {}
        constants = dict(stated.constants)
        for column, name in PREVIEW_INPUTS.items():
            texture = None
            place = _name_shader(stated)
            unused = list[str]()
            if name in stated.primvars:
                pass
            elif name in stated.textures:
                texture = self._read_exact_texture(column, name, stated.textures)
            elif changed := self._find_changed(stated, column):
                (place, value), *rest = changed.items()
                unused = [word for word, each in rest if not np.allclose(each, value, rtol=1e-3)]
                constants[name] = _fill(value)
            else:
                texture = Texture(texels=constant_map(self._columns[column]))
            if texture is not None:
                exact[column] = texture
                continue
            text = f"{column} was changed since Trilight wrote it; the value of {place} is used"
            if unused:
                text += f", not of {' or '.join(unused)}; make them equal to choose"
            self._note(text)
        return dataclasses.replace(stated, constants=constants), exact

    def _find_changed(self, stated: StatedMaterial, column: str) -> dict[str, NDArray[Any]]:
        """Return the changed values of a constant column by their places, the first one counts.

        Where it is not known which of them was changed, all are returned.
        """
        of_preview = {each: stated.constants[name] for each, name in PREVIEW_INPUTS.items()}
        places: dict[str, NDArray[Any]] = {
            layout.column_attribute(column): self._columns[column],
            _name_shader(stated): of_preview[column],
        }
        if column in self._openpbr:
            places[_OPENPBR] = self._openpbr[column]
        for written in [self._written] if self._written else [of_preview, self._columns]:
            expected = {_OPENPBR: _written_columns(written)[column]}
            changed = {
                place: value
                for place, value in places.items()
                if not np.allclose(
                    value, expected.get(place, written[column]), rtol=layout.SAME_VALUE, atol=0
                )
            }
            if self._written or len(changed) <= len(places) - 2:
                return changed
        return places if self._openpbr else dict(reversed(places.items()))

    def _read_exact_texture(
        self, column: str, name: str, textures: Mapping[str, TextureNode]
    ) -> Texture | None:
        """Return the texture of a column; None where its file or its use differs."""
        node = textures[name]
        is_used_alike = all(
            each.wrap == ("repeat", "repeat")
            and each.primvar == node.primvar
            and (each.uv_matrix == np.eye(2)).all()
            and not each.uv_offset.any()
            and (each.scale == 1).all()
            and not each.bias.any()
            for each in textures.values()
        )
        data = None if node.resolved is None else asset_bytes(node.resolved, MAX_BYTES)
        if column not in self._maps or not is_used_alike or data is None:
            return None
        sha256, source = self._maps[column]
        is_srgb = node.color_space == "sRGB"
        try:
            texture = decode_texture(data, node.named, column, is_srgb=is_srgb, source=source)
        except LookupError:
            return None
        return texture if texture.sha256 == sha256 else None


def _name_shader(stated: StatedMaterial) -> str:
    return f"its shader {stated.where.rpartition('/')[2]}"


def _written_columns(columns: Mapping[str, NDArray]) -> dict[str, NDArray[np.float64]]:
    """Return the columns [3] that the shader written for a material's columns states."""
    table = openpbr_inputs({name: np.maximum(columns[name], 0).tolist() for name in _INPUTS})
    return _multiply({name.removeprefix("inputs:"): each[1] for name, each in table.items()})


def _read_openpbr(material: Any, opened: OpenedStage) -> dict[str, NDArray[np.float64]]:
    """Return the columns [3] that the OpenPBR shader beside a preview states; none without both.

    Columns with an input that is missing, or no constant, are left out; notes name the latter.
    """
    shader = material.ComputeSurfaceSource("mtlx")[0]
    preview = surface_shader(material)
    if (
        not shader
        or shader.GetShaderId() != OPENPBR_SHADER
        or shader.GetPath() == preview.GetPath()
    ):
        return {}
    values = dict[str, NDArray[Any]]()
    for name in (each for inputs in _INPUTS.values() for each in inputs):
        sources = find_sources(shader, name)
        if not sources:
            continue
        stated = None if is_output(sources[0]) else sources[0].Get(opened.time)
        value = parse_color(
            None if stated is None else convert_to_rec709(sources[0], np.array(stated))
        )
        if value is None:
            opened.lost.append(f"{shader.GetPath()}.{name}: no finite constant; it is not read")
        else:
            values[name] = value
    reader = ShaderReader(shader, opened)
    reader.note_unsupported(("specular_weight", "specular_color"))
    return _multiply(values)


def _multiply(values: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    columns = {}
    for column, inputs in _INPUTS.items():
        if all(name in values for name in inputs):
            factors = [np.broadcast_to(values[name], 3).astype(float) for name in inputs]
            if column == "specular":
                factors[-1] = reflect_head_on(factors[-1])
            columns[column] = np.prod(factors, axis=0)
    return columns


def keep_exact(
    triangles: TexturedTriangles, exact: Mapping[str, Texture], where: str, lost: list[str]
) -> TexturedTriangles:
    """Return triangles whose unchanged columns are exact, and diffuse + specular at most 1."""
    rows = triangles.rows.copy()
    places = column_places()
    for name, texture in exact.items():
        rows[:, places[name]] = texture.mean
    note = f"{where}: diffuse lowered where diffuse + specular is over 1"
    if triangles.texture_sets[0] == NO_TEXTURES:
        excess = (rows[:, DIFFUSE] + rows[:, SPECULAR]).max(axis=1, initial=0) > 1 + EXCESS
        if excess.any():
            lost.append(note)
            rows[excess, DIFFUSE] = np.minimum(rows[excess, DIFFUSE], 1 - rows[excess, SPECULAR])
        return dataclasses.replace(triangles, rows=rows)
    texture_sets = []
    for texture_set in triangles.texture_sets:
        diffuse, specular, roughness = (
            exact.get(name, texture) for name, texture in zip(TEXTURED, texture_set, strict=True)
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
