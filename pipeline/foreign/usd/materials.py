"""Materials of a USD stage: UsdPreviewSurface in both workflows, with its UsdUVTextures.

The shader decides on the color space; without one, colors in 8 bits are sRGB-encoded, as USD
defines, and metadata of the picture are ignored.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import (
    MOST_UV_SETS,
    RGB,
    Slot,
    SourceMaterial,
    TexturedMesh,
    with_normal_map,
)
from pipeline.foreign.picture import FilePictures, Picture, has_colors
from pipeline.foreign.usd.object_source import StageMaterials, UsdSource
from pipeline.foreign.usd.polygons import CutMesh
from pipeline.foreign.usd.shaders import (
    IOR_OF_CONSTANT_ALBEDOS,
    StatedMaterial,
    parse_color,
    read_colors,
    reflect_head_on,
)
from pipeline.foreign.usd.texture_nodes import TextureNode
from storage.errors import Rejected

_INPUTS = {
    "diffuseColor": ("base_rgb", "base"),
    "roughness": ("roughness", "roughness_map"),
    "emissiveColor": ("emission_rgb", "emission"),
    "metallic": ("metallic", "metallic_map"),
    "specularColor": ("specular_rgb", "specular_colour"),
}
"""Names of the factor and of the picture of each input in `SourceMaterial`."""
_COLORS = ("diffuseColor", "emissiveColor", "specularColor")
_CHANNELS = {"rgb": 0, "r": 0, "g": 1, "b": 2, "a": 3}
_STRIP = 256
_MOST_VARIED = 4096
"""Maximum number of materials made of the primvars of one; more values become their mean."""
_UNBOUND = 0.18
"""Gray of a mesh without material and display color, as USD shows it."""


def usd_textured_mesh(
    source: UsdSource, pictures: FilePictures, *, emission: bool = False
) -> TexturedMesh:
    """Return the triangles of a USD file with their materials; emission only on request.

    Raises:
        Rejected: no_materials, materials_unreadable, no_texture_coordinates, or as reading a
            picture.
    """
    looks = MeshMaterials(source.materials, pictures, emission=emission)
    if len(looks.primvars) > MOST_UV_SETS:
        count = len(looks.primvars)
        raise Rejected("no_texture_coordinates", f"textures lie on {count} sets of them")
    cuts = source.meshes
    looks_of_meshes = [looks.assign(number, cut) for number, cut in cuts.items()]
    material = np.concatenate([rows for rows, _ in looks_of_meshes])
    tint = np.concatenate([tints for _, tints in looks_of_meshes])
    if (material == looks.plain).all() and (tint == _UNBOUND).all():
        raise Rejected("no_materials", "the stage has no materials and no display colors")
    sets = looks.primvars or ["st"]
    uv = [np.stack([cut.read_coordinates(name) for name in sets], axis=1) for cut in cuts.values()]
    return TexturedMesh(
        mesh=source.mesh,
        material=material,
        materials=tuple(looks.materials),
        uv=np.concatenate(uv),
        color=None if (tint == 1).all() else tint,
    )


@dataclass(eq=False)
class MeshMaterials:
    """The materials of a stage's meshes; primvars tint corners, or make further materials."""

    stage: StageMaterials
    """Materials as the stage states them."""
    pictures: FilePictures
    _: KW_ONLY
    emission: bool = False
    """True to read emission, too."""
    _known: dict[tuple[int, bytes], int] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Convert all materials.

        Raises:
            Rejected: materials_unreadable, or as reading a picture.
        """
        stated_materials = self.stage.materials
        nodes = [node for stated in stated_materials for node in stated.textures.values()]
        self.primvars = list(dict.fromkeys(node.primvar for node in nodes))
        """Names of the sets of texture coordinates, by the numbers in slots."""
        self.materials = [self._convert(stated) for stated in stated_materials]
        """Materials by row; those of primvars are added when they are met."""
        self.plain = len(self.materials)
        """Row of triangles without a material."""
        self.materials.append(SourceMaterial(roughness=0.5))
        self.origins = list(range(self.plain + 1))
        """Row of the stated material of each material."""

    def assign(self, number: int, cut: CutMesh) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the material rows [T] and corner tints [T, 3, 3] of a mesh's triangles.

        Args:
            number: index of the mesh within the stage.
            cut: its triangles.
        """
        rows = np.full(len(cut.corners), self.plain)
        for row, polygons in self.stage.bindings[number]:
            chosen = slice(None) if polygons is None else np.isin(cut.polygons, polygons)
            rows[chosen] = self.plain if row < 0 else row
        tints = np.ones((len(rows), 3, 3))
        is_plain = rows == self.plain
        if is_plain.any():
            display_colors = read_colors(cut, "displayColor")
            tints[is_plain] = (
                _UNBOUND if display_colors is None else np.clip(display_colors[is_plain], 0, 1)
            )
        for row in np.unique(rows):
            if row < self.plain and self.stage.materials[row].primvars:
                self._apply_primvars(int(row), cut, rows, tints)
        return rows, tints

    def _apply_primvars(
        self, row: int, cut: CutMesh, rows: NDArray[np.int64], tints: NDArray[np.float64]
    ) -> None:
        """Replace the rows [T] and tints [T, 3, 3] of triangles of a material with primvars."""
        stated = self.stage.materials[row]
        mask = rows == row
        values = {name: read_colors(cut, primvar) for name, primvar in stated.primvars.items()}
        for name, primvar in stated.primvars.items():
            if values[name] is None:
                cut.placed.note(f"no primvar {primvar!r:.60}; its fallback taken")
        base = values.pop("diffuseColor", None)
        if base is not None:
            tints[mask] = np.clip(base, 0, 1)[mask]
        elif "diffuseColor" in stated.primvars:
            tints[mask] = np.maximum(stated.constants["diffuseColor"], 0)
        glow = values.pop("emissiveColor", None)
        if glow is not None and self.emission:
            values["emissiveColor"] = glow * _read_strength(stated)
        means = {name: each.mean(axis=1)[mask] for name, each in values.items() if each is not None}
        if means and mask.any():
            rows[mask] = self._add_materials(row, means, cut)

    def _add_materials(
        self, row: int, means: Mapping[str, NDArray[np.float64]], cut: CutMesh
    ) -> NDArray[np.int64]:
        """Return rows [T] of materials with mean inputs [T, 3] of triangles, adding new ones."""
        table = np.concatenate(list(means.values()), axis=1)
        distinct, index = np.unique(table, axis=0, return_inverse=True)
        if len(distinct) > _MOST_VARIED:
            cut.placed.note(f"many values of {', '.join(means)}: their mean is taken")
            distinct = table.mean(axis=0, keepdims=True)
            index = np.zeros(len(table), np.int64)
        rows = []
        for values in distinct:
            key = (row, values.tobytes())
            if key not in self._known:
                self._known[key] = len(self.materials)
                inputs = dict(zip(means, np.split(values, len(means)), strict=True))
                self.materials.append(_replace_values(self.materials[row], inputs))
                self.origins.append(row)
            rows.append(self._known[key])
        return np.array(rows, np.int64)[index.reshape(-1)]

    def _convert(self, stated: StatedMaterial) -> SourceMaterial:
        glows = (
            "emissiveColor" in stated.textures or _read_constant(stated, "emissiveColor").max() > 0
        )
        is_lit = glows and _read_strength(stated) > 0
        is_emissive = is_lit or "emissiveColor" in stated.primvars
        lost = ("emission", *stated.lost) if is_emissive else stated.lost
        names = ["diffuseColor", "roughness"]
        names += ["emissiveColor"] if self.emission and is_lit else []
        material = self._with_inputs(SourceMaterial(lost=lost), stated, *names)
        if "normal" in stated.textures:
            material = self._with_normal_map(material, stated.textures["normal"])
        if not stated.is_specular:
            f0 = float(reflect_head_on(stated.constants["ior"].astype(float))[0])
            return dataclasses.replace(self._with_inputs(material, stated, "metallic"), f0=f0)
        return dataclasses.replace(
            self._with_inputs(material, stated, "specularColor"),
            f0=1.0,
            has_fresnel=stated.constants["ior"][0] != IOR_OF_CONSTANT_ALBEDOS,
        )

    def _with_inputs(
        self, material: SourceMaterial, stated: StatedMaterial, *names: str
    ) -> SourceMaterial:
        """Return a material with the factors and pictures of some inputs.

        A picture has the factor 1, and so have diffuse primvars, which tint corners.
        """
        fields: dict[str, Any] = {}
        for name in names:
            factor, picture = _INPUTS[name]
            slot = self._slot(stated, name)
            is_tint = slot is not None or (name in stated.primvars and name == "diffuseColor")
            value = np.ones(3) if is_tint else _read_constant(stated, name)
            if name == "emissiveColor":
                value = value.astype(float) * _read_strength(stated)
            fields[factor] = _factor(name, value)
            fields[picture] = slot
        return dataclasses.replace(material, **fields)

    def _with_normal_map(self, material: SourceMaterial, node: TextureNode) -> SourceMaterial:
        """Return a material with its normal map.

        Files that state neither scale nor bias mean those of a picture from 0 to 1. The picture is
        linear, unless it is said to be sRGB-encoded.
        """
        plain = dataclasses.replace(
            node,
            scale=np.ones(4, np.float32),
            bias=np.zeros(4, np.float32),
            color_space="sRGB" if node.color_space == "sRGB" else "raw",
        )
        slot = self._read_slot(plain, "", is_grey=False)
        material = with_normal_map(material, slot)
        if (node.scale == 1).all() and not node.bias.any():
            return material
        scale, bias = (values[:3].astype(float).tolist() for values in (node.scale, node.bias))
        return dataclasses.replace(material, normal_scale=tuple(scale), normal_bias=tuple(bias))

    def _slot(self, stated: StatedMaterial, name: str) -> Slot | None:
        """Return the slot of an input; the single channel of a color is copied to all three."""
        node = stated.textures.get(name)
        if node is None:
            return None
        is_grey = name in _COLORS and node.output != "rgb"
        where = f"{stated.where}.{name}: "
        return self.pictures.read_or_leave_out(
            where, lambda: self._read_slot(node, where, is_grey=is_grey)
        )

    def _read_slot(self, node: TextureNode, where: str, *, is_grey: bool) -> Slot:
        path = node.resolved or node.named
        files = self.stage.pictures
        values = self.pictures.decode(path, node.named, lambda: files.require(path))
        is_srgb = node.color_space == "sRGB"
        if node.color_space not in ("sRGB", "raw"):
            is_srgb = has_colors(files.require(path))
        channel = _CHANNELS[node.output]
        channels = [channel] * 3 + [3] if is_grey else [0, 1, 2, 3]
        if is_grey:
            values = np.ascontiguousarray(values[..., channels])
            is_srgb = is_srgb and channel != 3
        picture = Picture(values=values, is_srgb=is_srgb, wrap=node.wrap)
        if (node.scale != 1).any() or node.bias.any():
            picture = _scale_picture(picture, node.scale[channels], node.bias[channels])
            if self.pictures.of_scene and picture.values[..., :3].max() > 1:
                self.pictures.notes.append(f"{where}texels above 1 are clamped, but for emission")
        return Slot(
            picture=picture,
            uv_set=self.primvars.index(node.primvar),
            uv_matrix=node.uv_matrix,
            uv_offset=node.uv_offset,
            channel=channel,
        )


def _replace_values(
    material: SourceMaterial, values: Mapping[str, NDArray[np.float64]]
) -> SourceMaterial:
    """Return a material with some inputs replaced by values [3]."""
    fields: dict[str, Any] = {
        _INPUTS[name][0]: _factor(name, value) for name, value in values.items() if name != "ior"
    }
    if "ior" in values:
        fields["f0"] = float(reflect_head_on(values["ior"])[0])
    return dataclasses.replace(material, **fields)


def _scale_picture(
    picture: Picture, scale: NDArray[np.float32], bias: NDArray[np.float32]
) -> Picture:
    """Return a picture of linear float32 values, scaled and offset, clamped to 0 from below."""
    values = np.zeros((*picture.values.shape[:2], 4), np.float32)
    for row in range(0, len(values), _STRIP):
        strip = slice(row, row + _STRIP)
        values[strip] = np.maximum(picture.linear(picture.values[strip]) * scale + bias, 0)
    return Picture(values=values, is_srgb=False, wrap=picture.wrap)


def _read_constant(stated: StatedMaterial, name: str) -> NDArray[np.float32]:
    """Return the constant of an input, which is the fallback of a texture that is left out."""
    node = stated.textures.get(name)
    fallback = None if node is None or node.fallback is None else parse_color(node.fallback[:3])
    return stated.constants[name] if fallback is None else fallback


def _factor(name: str, value: NDArray) -> float | RGB:
    """Return a value [3] of an input as a factor of `SourceMaterial`: a number, or a color."""
    if name not in _COLORS:
        return float(value[0])
    red, green, blue = np.maximum(value, 0).tolist()
    return red, green, blue


def _read_strength(stated: StatedMaterial) -> float:
    has_strength = stated.has_strength
    return max(float(_read_constant(stated, "strength")[0]), 0.0) if has_strength else 1.0
