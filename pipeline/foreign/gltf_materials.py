"""Materials of a glTF: core, KHR_materials_specular, _ior, _pbrSpecularGlossiness and transforms.

A picture counts as its slot says: base and specular colours are sRGB-encoded, all else is linear.
"""

import base64
import copy
import dataclasses
import json
import struct
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import Slot, SourceMaterial
from pipeline.foreign.material_files import MaterialFiles
from pipeline.foreign.parts import MOST_UV_SETS
from pipeline.foreign.picture import Picture, Wrap
from storage.errors import Rejected

_WRAPS: Mapping[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_DEFAULT = "trilight-default"

Decode = Callable[[bytes, str], NDArray]
"""Returns the values of a picture's bytes; its name is for messages."""


class GltfMaterials:
    """Reads the materials of one glTF, each picture once."""

    def __init__(
        self,
        tree: dict[str, Any],
        buffers: Callable[[int], bytes],
        pictures: MaterialFiles,
        decode: Decode,
        *,
        emission: bool = False,
    ) -> None:
        """Read nothing yet.

        Args:
            tree: its JSON.
            buffers: the bytes of a buffer by its number.
            pictures: files beside it.
            decode: what makes values of the bytes of a picture.
            emission: whether what emits is read too.
        """
        self._emission = emission
        self._tree, self._buffers = tree, buffers
        self._files, self._decode = pictures, decode
        self._values: dict[int, NDArray] = {}

    def by_name(self) -> dict[str, SourceMaterial]:
        """Return the materials by the names that `bare_gltf` gives them.

        Raises:
            Rejected: materials_unreadable, or as reading a picture.
        """
        try:
            used = _used_materials(self._tree)
            return {
                _name(row): self._material(self._tree["materials"][row]) for row in sorted(used)
            }
        except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
            raise Rejected(
                "materials_unreadable", f"the materials are malformed ({error!r:.120})"
            ) from error

    def _material(self, entry: dict[str, Any]) -> SourceMaterial:
        extensions = entry.get("extensions", {})
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if glossy is not None:
            return self._with_emission(self._specular_workflow(glossy, _lost(entry)), entry)
        metal = entry.get("pbrMetallicRoughness", {})
        specular = extensions.get("KHR_materials_specular", {})
        ior = float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5))
        base = _numbers(metal.get("baseColorFactor", [1, 1, 1, 1]), 4)
        red, green, blue = _numbers(specular.get("specularColorFactor", [1, 1, 1]), 3)
        both = self._slot(metal.get("metallicRoughnessTexture"))
        found = SourceMaterial(
            base_rgb=(base[0], base[1], base[2]),
            base=self._slot(metal.get("baseColorTexture"), is_srgb=True),
            metallic=float(metal.get("metallicFactor", 1)),
            roughness=float(metal.get("roughnessFactor", 1)),
            metallic_map=None if both is None else dataclasses.replace(both, channel=2),
            roughness_map=None if both is None else dataclasses.replace(both, channel=1),
            f0=((ior - 1) / (ior + 1)) ** 2 if ior > 0 else 1.0,
            specular_rgb=(red, green, blue),
            specular_colour=self._slot(specular.get("specularColorTexture"), is_srgb=True),
            specular_strength=float(specular.get("specularFactor", 1)),
            specular_strength_map=self._slot(specular.get("specularTexture")),
            lost=_lost(entry),
        )
        return self._with_emission(found, entry)

    def _with_emission(self, found: SourceMaterial, entry: dict[str, Any]) -> SourceMaterial:
        """Return a material with what it emits, where that is asked for."""
        if not self._emission:
            return found
        strength = entry.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        (times,) = _numbers([strength.get("emissiveStrength", 1)], 1)
        red, green, blue = (
            max(value * times, 0.0) for value in _numbers(entry.get("emissiveFactor", [0] * 3), 3)
        )
        if not any((red, green, blue)):
            return found
        return dataclasses.replace(
            found,
            emission_rgb=(red, green, blue),
            emission=self._slot(entry.get("emissiveTexture"), is_srgb=True),
        )

    def _specular_workflow(self, entry: dict[str, Any], lost: tuple[str, ...]) -> SourceMaterial:
        base = _numbers(entry.get("diffuseFactor", [1, 1, 1, 1]), 4)
        red, green, blue = _numbers(entry.get("specularFactor", [1, 1, 1]), 3)
        both = entry.get("specularGlossinessTexture")
        return SourceMaterial(
            base_rgb=(base[0], base[1], base[2]),
            base=self._slot(entry.get("diffuseTexture"), is_srgb=True),
            roughness=1 - float(entry.get("glossinessFactor", 1)),
            f0=1.0,
            specular_rgb=(red, green, blue),
            specular_colour=self._slot(both, is_srgb=True),
            glossiness=self._slot(both),
            lost=lost,
        )

    def _slot(self, entry: dict[str, Any] | None, *, is_srgb: bool = False) -> Slot | None:
        if entry is None:
            return None
        texture = self._tree["textures"][entry["index"]]
        source = texture.get("source")
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        if source is None or "source" in webp:
            source = webp.get("source", source)
        if source is None:
            raise Rejected("texture_unreadable", "a texture has no picture in a form that is read")
        sampler = self._tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wrap = _WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)]
        moved = entry.get("extensions", {}).get("KHR_texture_transform", {})
        turn, shift = _moves(moved)
        uv_set = int(moved.get("texCoord", entry.get("texCoord", 0)))
        if not 0 <= uv_set < MOST_UV_SETS:
            raise Rejected("no_texture_coordinates", f"a texture lies on TEXCOORD_{uv_set}")
        values = self._picture(int(source))
        return Slot(
            picture=Picture(
                values=values,
                is_srgb=is_srgb and values.dtype != np.float16,  # floats are linear
                wrap=wrap,
                is_nearest=sampler.get("magFilter") == _NEAREST,
            ),
            uv_set=uv_set,
            turn=turn,
            shift=shift,
        )

    def _picture(self, number: int) -> NDArray:
        if number not in self._values:
            image = self._tree["images"][number]
            name = str(image.get("uri", image.get("name", f"picture {number}")))
            name = "an embedded picture" if name.startswith("data:") else name
            self._values[number] = self._decode(self._bytes(image), name)
        return self._values[number]

    def _bytes(self, image: dict[str, Any]) -> bytes:
        if "bufferView" in image:
            view = self._tree["bufferViews"][image["bufferView"]]
            start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
            return self._buffers(int(view["buffer"]))[start : start + length]
        uri = image["uri"]
        if uri.startswith("data:"):
            return data_uri_bytes(uri)
        return self._files.of(uri)


def data_uri_bytes(uri: str) -> bytes:
    """Return what a data: URI holds; raises ValueError where that is no base64."""
    head, _, body = uri.partition(",")
    return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)


def bare_gltf(data: bytes, tree: dict[str, Any], suffix: str) -> bytes:
    """Return the file without pictures: its materials are names, its coordinates plain attributes.

    A mesh keeps its triangles, so that they are those of the file itself.
    """
    bare = copy.deepcopy(tree)
    used = _used_materials(tree)
    count = len(bare.get("materials", ()))
    for name in ("images", "textures", "samplers", "materials"):
        bare.pop(name, None)
    bare["materials"] = [{"name": _name(row)} for row in range(count)] + [{"name": _DEFAULT}]
    for mesh in bare.get("meshes", ()):
        mesh.pop("extras", None)
        for primitive in mesh["primitives"]:
            if primitive.get("material") not in used:
                primitive["material"] = count
            primitive["attributes"] = _renamed(primitive["attributes"])
    text = json.dumps(bare).encode()
    if suffix == ".gltf":
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + int.from_bytes(data[12:16], "little") :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def _renamed(attributes: Mapping[str, int]) -> dict[str, int]:
    found = {"POSITION": attributes["POSITION"]}
    for number in range(MOST_UV_SETS):
        if (accessor := attributes.get(f"TEXCOORD_{number}")) is not None:
            found[f"_TRILIGHT_UV_{number}"] = accessor
    if "COLOR_0" in attributes:
        found["_TRILIGHT_COLOUR"] = attributes["COLOR_0"]
    return found


def _used_materials(tree: Mapping[str, Any]) -> set[int]:
    count = len(tree.get("materials", ()))
    named = {
        primitive.get("material")
        for mesh in tree.get("meshes", ())
        for primitive in mesh["primitives"]
    }
    return {row for row in named if isinstance(row, int) and 0 <= row < count}


def _name(row: int) -> str:
    return f"trilight-{row}"


def _lost(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what a material says beyond what is read of it."""
    extensions = entry.get("extensions", {})
    found = {
        "emission": any(entry.get("emissiveFactor", ())),
        "normal map": "normalTexture" in entry,
        "transparency": entry.get("alphaMode", "OPAQUE") != "OPAQUE",
        **{
            word: f"KHR_materials_{word}" in extensions
            for word in ("clearcoat", "transmission", "sheen", "anisotropy", "iridescence")
        },
    }
    return tuple(word for word, is_there in found.items() if is_there)


def _moves(moved: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the turn and shift of KHR_texture_transform for coordinates with v up.

    The extension says (u, w)' = shift + R S (u, w) with w down, and w = 1 - v.
    """
    angle, scale = float(moved.get("rotation", 0)), _numbers(moved.get("scale", [1, 1]), 2)
    cos, sin = np.cos(angle), np.sin(angle)
    down = np.array([[cos, sin], [-sin, cos]]) @ np.diag(scale)
    offset = np.array(_numbers(moved.get("offset", [0, 0]), 2))
    flip = np.diag([1.0, -1.0])
    one = np.array([0.0, 1.0])
    return flip @ down @ flip, flip @ (offset + down @ one) + one


def _numbers(values: Any, count: int) -> list[float]:
    found = [float(value) for value in values]
    if len(found) != count or not np.isfinite(found).all():
        raise ValueError(f"{values!r:.60}; expected {count} finite numbers")
    return found
