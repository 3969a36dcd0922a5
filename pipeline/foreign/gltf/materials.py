"""Materials of a glTF as `SourceMaterial`, for objects and for scenes.

The slot of a picture decides on its encoding: base and specular colors are sRGB-encoded, all other
slots are linear.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.gltf.document import GltfDocument
from pipeline.foreign.gltf.nodes import entry, extension
from pipeline.foreign.material import MOST_UV_SETS, RGB, Slot, SourceMaterial, with_normal_map
from pipeline.foreign.numbers import Malformed, read_count, read_number, read_numbers
from pipeline.foreign.picture import FilePictures, Picture, Wrap
from storage.errors import Rejected

DEFAULT = SourceMaterial(metallic=1.0)
"""Material that glTF defines for a mesh without one."""

_WRAPS: Mapping[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_MOST_EMISSION = 1e9


@dataclass(eq=False)
class GltfMaterials:
    """Reads the materials of one glTF on demand.

    In a scene, numbers that are malformed or beyond their range are replaced, with notes.
    """

    document: GltfDocument
    pictures: FilePictures
    _: KW_ONLY
    emission: bool = False
    """True to read emission, too."""
    normals: bool = False
    """True to read normal maps, too."""
    _known: dict[int, SourceMaterial] = field(default_factory=dict, init=False)

    def material(self, number: int) -> SourceMaterial:
        """Return one material; raises Rejected as reading a picture."""
        if number not in self._known:
            self._known[number] = self._read(number)
        return self._known[number]

    def _read(self, number: int) -> SourceMaterial:
        row = entry(self.document.tree, "materials", number)
        glossy = row.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if "KHR_materials_unlit" in row.get("extensions", {}):
            return self._unlit(row)
        material = self._metallic(row) if glossy is None else self._glossy(glossy)
        material = dataclasses.replace(material, lost=_list_unsupported(row))
        return self._with_emission(self._with_normals(material, row), row)

    def _unlit(self, row: Mapping[str, Any]) -> SourceMaterial:
        """Return a diffuse surface of the base color, which looks unlit under uniform light."""
        metal = row.get("pbrMetallicRoughness", {})
        return SourceMaterial(
            base_rgb=self._rgb(metal, "baseColorFactor", 4),
            base=self._slot(metal, "baseColorTexture", is_srgb=True),
            specular_strength=0.0,
            lost=("unlit", *_list_unsupported(row)),
        )

    def _metallic(self, row: Mapping[str, Any]) -> SourceMaterial:
        metal = row.get("pbrMetallicRoughness", {})
        specular = extension(row, "KHR_materials_specular")
        ior = self._number(extension(row, "KHR_materials_ior"), "ior", 1.5, 1e3)
        both = self._slot(metal, "metallicRoughnessTexture")
        return SourceMaterial(
            base_rgb=self._rgb(metal, "baseColorFactor", 4),
            base=self._slot(metal, "baseColorTexture", is_srgb=True),
            metallic=self._number(metal, "metallicFactor", 1),
            roughness=self._number(metal, "roughnessFactor", 1),
            metallic_map=None if both is None else dataclasses.replace(both, channel=2),
            roughness_map=None if both is None else dataclasses.replace(both, channel=1),
            f0=((ior - 1) / (ior + 1)) ** 2 if ior > 0 else 1.0,
            specular_rgb=self._rgb(specular, "specularColorFactor", 3, 1e3),
            specular_colour=self._slot(specular, "specularColorTexture", is_srgb=True),
            specular_strength=self._number(specular, "specularFactor", 1),
            specular_strength_map=self._slot(specular, "specularTexture"),
        )

    def _glossy(self, row: Mapping[str, Any]) -> SourceMaterial:
        return SourceMaterial(
            base_rgb=self._rgb(row, "diffuseFactor", 4),
            base=self._slot(row, "diffuseTexture", is_srgb=True),
            roughness=1 - self._number(row, "glossinessFactor", 1),
            f0=1.0,
            specular_rgb=self._rgb(row, "specularFactor", 3),
            specular_colour=self._slot(row, "specularGlossinessTexture", is_srgb=True),
            glossiness=self._slot(row, "specularGlossinessTexture"),
        )

    def _with_normals(self, material: SourceMaterial, row: Mapping[str, Any]) -> SourceMaterial:
        """Return a material with its normal map, where normal maps are read."""
        slot = self._slot(row, "normalTexture") if self.normals else None
        if slot is None:
            return material
        strength = read_number(row["normalTexture"].get("scale", 1), "normalTexture.scale")
        return with_normal_map(material, slot, strength)

    def _with_emission(self, material: SourceMaterial, row: Mapping[str, Any]) -> SourceMaterial:
        """Return a material with its emission, where emission is read."""
        if not self.emission:
            return material
        strength = extension(row, "KHR_materials_emissive_strength")
        times = self._number(strength, "emissiveStrength", 1, _MOST_EMISSION)
        red, green, blue = self._numbers(row, "emissiveFactor", (0.0,) * 3, _MOST_EMISSION)
        if not any((red, green, blue)) or not times:
            return material
        return dataclasses.replace(
            material,
            emission_rgb=(red * times, green * times, blue * times),
            emission=self._slot(row, "emissiveTexture", is_srgb=True),
        )

    def _slot(self, row: Mapping[str, Any], name: str, *, is_srgb: bool = False) -> Slot | None:
        info = row.get(name)
        if info is None:
            return None
        return self.pictures.read_or_leave_out("", lambda: self._texture(info, is_srgb=is_srgb))

    def _texture(self, info: Mapping[str, Any], *, is_srgb: bool) -> Slot:
        tree = self.document.tree
        texture = entry(tree, "textures", info["index"])
        source = extension(texture, "EXT_texture_webp").get("source", texture.get("source"))
        if source is None:
            forms = ", ".join(texture.get("extensions", ())) or "nothing"
            raise Rejected("texture_unreadable", f"its picture is in no form read here: {forms}")
        sampler = entry(tree, "samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = _WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)]
        transform = extension(info, "KHR_texture_transform")
        uv_matrix, uv_offset = _uv_transform(transform)
        uv_set = read_count(transform, "texCoord", info.get("texCoord", 0))
        if uv_set >= MOST_UV_SETS:
            raise Rejected("no_texture_coordinates", f"a texture lies on TEXCOORD_{uv_set}")
        values = self._picture(source)
        return Slot(
            picture=Picture(
                values=values,
                is_srgb=is_srgb and values.dtype != np.float16,  # floats are linear
                wrap=wrap,
                is_nearest=sampler.get("magFilter") == _NEAREST,
            ),
            uv_set=uv_set,
            uv_matrix=uv_matrix,
            uv_offset=uv_offset,
        )

    def _picture(self, number: int) -> NDArray:
        image = entry(self.document.tree, "images", number)
        name = str(image.get("uri", image.get("name", f"picture {number}")))
        name = "an embedded picture" if name.startswith("data:") else name
        return self.pictures.decode(number, name, lambda: self.document.picture_bytes(image))

    def _rgb(self, row: Mapping[str, Any], name: str, count: int, most: float = 1.0) -> RGB:
        red, green, blue = self._numbers(row, name, (1.0,) * count, most)[:3]
        return red, green, blue

    def _number(
        self, row: Mapping[str, Any], name: str, default: float, most: float = 1.0
    ) -> float:
        one = {} if name not in row else {name: [row[name]]}
        return self._numbers(one, name, (default,), most)[0]

    def _numbers(
        self, row: Mapping[str, Any], name: str, default: tuple[float, ...], most: float
    ) -> list[float]:
        """Return factors clamped to [0, `most`]; malformed ones become the default, with a note."""
        try:
            factors = [*read_numbers(row.get(name, default), len(default), name)]
            if most > 1 and max(factors) > most and not self.pictures.of_scene:
                raise Malformed(f"{name} is {max(factors):g}; expected at most {most:g}")
        except Malformed as error:
            if not self.pictures.of_scene:
                raise
            self.pictures.notes.append(f"{error}; {[*default]} taken")
            return list(default)
        clamped = [min(max(value, 0.0), most) for value in factors]
        if self.pictures.of_scene and clamped != factors:
            self.pictures.notes.append(f"{name}: clamped to [0, {most:g}]")
        return clamped


def _list_unsupported(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return words for stated features that are not read."""
    extensions = row.get("extensions", {})
    unsupported = {
        "emission": any(row.get("emissiveFactor", ())),
        "normal map": "normalTexture" in row,
        "transparency": row.get("alphaMode", "OPAQUE") != "OPAQUE",
        **{
            word: f"KHR_materials_{word}" in extensions
            for word in ("clearcoat", "transmission", "sheen", "anisotropy", "iridescence")
        },
    }
    return tuple(word for word, is_there in unsupported.items() if is_there)


def _uv_transform(transform: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the matrix [2, 2] and offset [2] of KHR_texture_transform for coordinates with v up.

    The extension defines (u, w)' = shift + R S (u, w) with w down, and w = 1 - v.
    """
    angle = read_number(transform.get("rotation", 0), "rotation")
    scale = read_numbers(transform.get("scale", (1, 1)), 2, "scale")
    cos = np.cos(angle)
    sin = np.sin(angle)
    down = np.array([[cos, sin], [-sin, cos]]) @ np.diag(scale)
    offset = np.array(read_numbers(transform.get("offset", (0, 0)), 2, "offset"))
    flip = np.diag([1.0, -1.0])
    one = np.array([0.0, 1.0])
    return flip @ down @ flip, flip @ (offset + down @ one) + one
