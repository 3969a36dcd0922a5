"""Materials of a USD stage: UsdPreviewSurface in both workflows, with its UsdUVTextures.

The shader decides on the color space; without one, colors in 8 bits are sRGB-encoded, as USD
defines, and metadata of the picture are ignored.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import MOST_UV_SETS, RGB, WHITE, Slot, SourceMaterial
from pipeline.foreign.material_files import MaterialFiles
from pipeline.foreign.picture import Picture, has_colors
from pipeline.foreign.textured_mesh import TexturedMesh
from pipeline.foreign.usd.object_meshes import PlacedMesh
from pipeline.foreign.usd.object_source import UsdSource
from pipeline.foreign.usd.shaders import StatedMaterial, read_colors, reflect_head_on
from pipeline.foreign.usd.stage_materials import Binding, name_unsupported
from pipeline.foreign.usd.texture_nodes import TextureNode, UvChart
from storage.errors import Rejected

_CHANNELS = {"rgb": 0, "r": 0, "g": 1, "b": 2, "a": 3}
_STRIP = 256
_MOST_VARIED = 256
"""Maximum number of materials made of the primvars of one; more values become their mean."""
_UNBOUND = 0.18
"""Gray of a mesh without material and display color, as USD shows it."""

Decode = Callable[[bytes, str], NDArray]


def usd_textured_mesh(source: UsdSource, decode: Decode, *, emission: bool = False) -> TexturedMesh:
    """Return the triangles of a USD file with their materials; emission only on request.

    Raises:
        Rejected: no_materials, materials_unreadable, no_texture_coordinates, or as reading a
            picture.
    """
    stage_materials = source.materials()
    time = source.stage.time
    nodes = [node for stated in stage_materials.materials for node in stated.textures.values()]
    primvars = list(dict.fromkeys(node.chart.primvar for node in nodes))
    if len(primvars) > MOST_UV_SETS:
        raise Rejected("no_texture_coordinates", f"textures lie on {len(primvars)} sets of them")
    reader = _Reader(stage_materials.pictures, primvars, decode, emission=emission)
    materials = [reader.material(stated) for stated in stage_materials.materials]
    plain = len(materials)
    materials.append(SourceMaterial(roughness=0.5))
    primvar_materials = _PrimvarMaterials(
        stage_materials.materials, materials, time, emission=emission
    )
    rows = []
    tints = []
    coordinates = []
    for placed in source.meshes:
        mesh_rows = _material_rows(stage_materials.bindings[placed.number], placed, plain)
        tints.append(_corner_tints(placed, mesh_rows == plain, time))
        primvar_materials.apply(placed, mesh_rows, tints[-1])
        rows.append(mesh_rows)
        coordinates.append(placed.coordinates(primvars or ["st"], time))
    material = np.concatenate(rows)
    tint = np.concatenate(tints)
    if (material == plain).all() and (tint == _UNBOUND).all():
        raise Rejected("no_materials", "the stage has no materials and no display colours")
    return TexturedMesh(
        mesh=source.mesh,
        material=material,
        materials=tuple(materials),
        uv=np.concatenate(coordinates),
        color=None if (tint == 1).all() else tint,
    )


def _material_rows(
    bindings: Sequence[Binding], placed: PlacedMesh, plain: int
) -> NDArray[np.int64]:
    rows = np.full(len(placed.cut.corners), plain)
    for row, polygons in bindings:
        chosen = slice(None) if polygons is None else np.isin(placed.cut.polygons, polygons)
        rows[chosen] = plain if row < 0 else row
    return rows


def _corner_tints(
    placed: PlacedMesh, is_plain: NDArray[np.bool_], time: object
) -> NDArray[np.float64]:
    """Return the tints [T, 3, 3] of corners: display colors where there is no material, else 1."""
    tints = np.ones((len(is_plain), 3, 3))
    if is_plain.any():
        display_colors = read_colors(placed.cut, "displayColor", time)
        tints[is_plain] = (
            _UNBOUND if display_colors is None else np.clip(display_colors[is_plain], 0, 1)
        )
    return tints


class _PrimvarMaterials:
    """Materials with primvar inputs: colors tint corners, and numbers become further materials."""

    def __init__(
        self,
        stated: Sequence[StatedMaterial],
        materials: list[SourceMaterial],
        time: object,
        *,
        emission: bool,
    ) -> None:
        self._stated = stated
        self._materials = materials
        self._time = time
        self._emission = emission
        self._known: dict[tuple[int, bytes], int] = {}

    def apply(
        self, placed: PlacedMesh, rows: NDArray[np.int64], tints: NDArray[np.float64]
    ) -> None:
        """Replace the rows [T] and tints [T, 3, 3] of triangles that have such materials."""
        for row in np.unique(rows):
            if row >= len(self._stated) or not self._stated[row].primvars:
                continue
            stated = self._stated[row]
            mask = rows == row
            base = stated.read_values("diffuseColor", placed.cut, self._time)
            if base is not None:
                tints[mask] = np.clip(base, 0, 1)[mask]
            elif "diffuseColor" in stated.primvars:
                tints[mask] = np.maximum(stated.constants["diffuseColor"], 0)
            values = {
                name: stated.read_values(name, placed.cut, self._time) for name in stated.primvars
            }
            values["diffuseColor"] = None
            glow = values.get("emissiveColor")
            if glow is not None:
                values["emissiveColor"] = glow * _read_strength(stated) if self._emission else None
            means = {name: each.mean(axis=1) for name, each in values.items() if each is not None}
            if means:
                rows[mask] = self._add_materials(int(row), {k: v[mask] for k, v in means.items()})

    def _add_materials(
        self, row: int, means: Mapping[str, NDArray[np.float64]]
    ) -> NDArray[np.int64]:
        """Return rows [T] of materials with mean inputs [T, 3] of triangles, adding new ones."""
        table = np.concatenate(list(means.values()), axis=1)
        if len(np.unique(table, axis=0)) > _MOST_VARIED:
            table = np.broadcast_to(table.mean(axis=0), table.shape)
        distinct, index = np.unique(table, axis=0, return_inverse=True)
        rows = []
        for values in distinct:
            key = (row, values.tobytes())
            if key not in self._known:
                self._known[key] = len(self._materials)
                inputs = dict(zip(means, np.split(values, len(means)), strict=True))
                self._materials.append(_replace_values(self._materials[row], inputs))
            rows.append(self._known[key])
        return np.array(rows, np.int64)[index.reshape(-1)]


def _replace_values(
    material: SourceMaterial, values: Mapping[str, NDArray[np.float64]]
) -> SourceMaterial:
    """Return a material with some inputs replaced by values [3]."""

    def number(name: str, old: float) -> float:
        return float(values[name][0]) if name in values else old

    specular = values.get("specularColor")
    glow = values.get("emissiveColor")
    f0 = float(reflect_head_on(values["ior"])[0]) if "ior" in values else material.f0
    return dataclasses.replace(
        material,
        metallic=number("metallic", material.metallic),
        roughness=number("roughness", material.roughness),
        f0=f0,
        specular_rgb=material.specular_rgb if specular is None else _drop_negative(specular),
        emission_rgb=material.emission_rgb if glow is None else _drop_negative(glow),
    )


class _Reader:
    """Converts the materials of one stage, decoding each picture once."""

    def __init__(
        self, files: MaterialFiles, primvars: Sequence[str], decode: Decode, *, emission: bool
    ) -> None:
        self._files = files
        self._primvars = primvars
        self._decode = decode
        self._emission = emission
        self._values: dict[str, NDArray] = {}

    def material(self, stated: StatedMaterial) -> SourceMaterial:
        base = self._color_slot(stated, "diffuseColor")
        is_tint = base is not None or "diffuseColor" in stated.primvars
        roughness = self._number_slot(stated, "roughness")
        lost = name_unsupported(stated)
        glows = any(_glow(stated)) or "emissiveColor" in stated.primvars
        material = SourceMaterial(
            base_rgb=WHITE if is_tint else _rgb(stated, "diffuseColor"),
            base=base,
            roughness=1.0 if roughness is not None else _first_channel(stated, "roughness"),
            roughness_map=roughness,
            lost=("emission", *lost) if glows else lost,
        )
        if self._emission and any(_glow(stated)):
            picture = self._color_slot(stated, "emissiveColor")
            material = dataclasses.replace(material, emission_rgb=_glow(stated), emission=picture)
        if stated.is_specular:
            return self._specular(stated, material)
        metallic = self._number_slot(stated, "metallic")
        return dataclasses.replace(
            material,
            metallic=1.0 if metallic is not None else _first_channel(stated, "metallic"),
            metallic_map=metallic,
            f0=float(reflect_head_on(stated.constants["ior"].astype(float))[0]),
        )

    def _specular(self, stated: StatedMaterial, common: SourceMaterial) -> SourceMaterial:
        color = self._color_slot(stated, "specularColor")
        return dataclasses.replace(
            common,
            f0=1.0,
            specular_rgb=WHITE if color is not None else _rgb(stated, "specularColor"),
            specular_colour=color,
        )

    def _color_slot(self, stated: StatedMaterial, name: str) -> Slot | None:
        """Return the slot of a color input; a single channel is copied to all three."""
        node = stated.textures.get(name)
        return None if node is None else self._slot(node, is_grey=node.output != "rgb")

    def _number_slot(self, stated: StatedMaterial, name: str) -> Slot | None:
        node = stated.textures.get(name)
        return None if node is None else self._slot(node, is_grey=False)

    def _slot(self, node: TextureNode, *, is_grey: bool) -> Slot:
        values = self._picture(node)
        is_srgb = self._is_srgb(node)
        channel = _CHANNELS[node.output]
        if is_grey:
            values = np.ascontiguousarray(values[..., [channel] * 3 + [3]])
            is_srgb = is_srgb and channel != 3
        picture = Picture(values=values, is_srgb=is_srgb, wrap=node.wrap)
        if (node.scale != 1).any() or node.bias.any():
            scale = node.scale
            bias = node.bias
            if is_grey:
                scale = scale[[channel] * 3 + [3]]
                bias = bias[[channel] * 3 + [3]]
            picture = _scale_picture(picture, scale, bias)
        uv_matrix, uv_offset = _chart_transform(node.chart)
        return Slot(
            picture=picture,
            uv_set=self._primvars.index(node.chart.primvar),
            uv_matrix=uv_matrix,
            uv_offset=uv_offset,
            channel=channel,
        )

    def _picture(self, node: TextureNode) -> NDArray:
        path = node.resolved or node.named
        if path not in self._values:
            self._values[path] = self._decode(self._files.require(path), node.named)
        return self._values[path]

    def _is_srgb(self, node: TextureNode) -> bool:
        if node.color_space in ("sRGB", "raw"):
            return node.color_space == "sRGB"
        return has_colors(self._files.require(node.resolved or node.named))


def _scale_picture(
    picture: Picture, scale: NDArray[np.float32], bias: NDArray[np.float32]
) -> Picture:
    """Return a picture of linear float32 values, scaled and offset, clamped to 0 from below."""
    values = np.zeros((*picture.values.shape[:2], 4), np.float32)
    for row in range(0, len(values), _STRIP):
        strip = slice(row, row + _STRIP)
        values[strip] = np.maximum(picture.linear(picture.values[strip]) * scale + bias, 0)
    return Picture(values=values, is_srgb=False, wrap=picture.wrap)


def _chart_transform(chart: UvChart) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    matrix = np.eye(2)
    offset = np.zeros(2)
    for transform in chart.transforms:
        matrix = transform.matrix @ matrix
        offset = transform.matrix @ offset + transform.translation
    if not (np.isfinite(matrix).all() and np.isfinite(offset).all()):
        raise Rejected("materials_unreadable", "coordinates are moved by what is no number")
    return matrix, offset


def _rgb(stated: StatedMaterial, name: str) -> RGB:
    return _drop_negative(stated.constants[name])


def _drop_negative(values: NDArray) -> RGB:
    red, green, blue = np.maximum(values, 0).tolist()
    return red, green, blue


def _glow(stated: StatedMaterial) -> RGB:
    """Return the emission factor, which a picture, if there is one, is multiplied with."""
    strength = _read_strength(stated)
    if "emissiveColor" in stated.textures:
        return (strength, strength, strength)
    red, green, blue = (strength * value for value in _rgb(stated, "emissiveColor"))
    return red, green, blue


def _read_strength(stated: StatedMaterial) -> float:
    return max(_first_channel(stated, "strength"), 0.0) if stated.has_strength else 1.0


def _first_channel(stated: StatedMaterial, name: str) -> float:
    return float(stated.constants[name][0])
