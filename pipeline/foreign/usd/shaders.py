"""`read_material`: the inputs of a material of a stage, by the names of UsdPreviewSurface.

Inputs of OpenPBR and Standard Surface (MaterialX) get these names where they have the same meaning.
An input is a constant, a texture, or a primvar of the mesh.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdShade

from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.polygons import CutMesh, as_array
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import (
    TextureNode,
    convert_to_rec709,
    find_sources,
    is_output,
    read_input,
    read_texture_node,
)

PREVIEW = "UsdPreviewSurface"
_OPEN_PBR = "ND_open_pbr_surface_surfaceshader"
_STANDARD = "ND_standard_surface_surfaceshader"
_MATERIALX = {"diffuseColor": "base_color", "emissiveColor": "emission_color"}
NAMES: Mapping[str, Mapping[str, str]] = {
    PREVIEW: {},
    _OPEN_PBR: {
        **_MATERIALX,
        "metallic": "base_metalness",
        "roughness": "specular_roughness",
        "ior": "specular_ior",
        "strength": "emission_luminance",
    },
    _STANDARD: {
        **_MATERIALX,
        "metallic": "metalness",
        "roughness": "specular_roughness",
        "ior": "specular_IOR",
        "strength": "emission",
    },
}
"""Names of inputs in each shader, by their names in UsdPreviewSurface."""

DEFAULTS: Mapping[str, Any] = {
    "diffuseColor": (0.18, 0.18, 0.18),
    "specularColor": 0.0,
    "metallic": 0.0,
    "roughness": 0.5,
    "ior": 1.5,
    "emissiveColor": 0.0,
    "strength": 0.0,
    "useSpecularWorkflow": 0.0,
}
_OF_MATERIALX = {**DEFAULTS, "diffuseColor": 0.8, "emissiveColor": 1.0}
_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    PREVIEW: DEFAULTS,
    _OPEN_PBR: {**_OF_MATERIALX, "roughness": 0.3},
    _STANDARD: {**_OF_MATERIALX, "roughness": 0.2},
}
"""Defaults of each shader for inputs that are not stated."""

IOR_OF_CONSTANT_ALBEDOS = 1000.0
"""Index of refraction that Trilight writes in the specular workflow: at 1000, which is Blender's
maximum, a specular albedo is the same at every angle."""

TEXTURED = ("diffuseColor", "specularColor", "emissiveColor", "metallic", "roughness", "ior")
"""Inputs that may be textures or primvars."""

_NEUTRAL: Mapping[str, float] = {
    **dict.fromkeys(
        ("opacity", "occlusion", "specular", "specular_weight", "specular_color",
         "geometry_opacity"),
        1.0,
    ),
    **dict.fromkeys(
        ("clearcoat", "displacement", "diffuse_roughness", "specular_anisotropy",
         "specular_roughness_anisotropy", "base_diffuse_roughness", "transmission_weight",
         "transmission", "coat_weight", "coat", "subsurface_weight", "subsurface", "fuzz_weight",
         "sheen", "thin_film_weight", "thin_film_thickness", "thin_walled",
         "geometry_thin_walled"),
        0.0,
    ),
}  # fmt: skip
"""Unsupported inputs, with the value at which they have no effect."""
_OF_BLENDER = {"specular": 0.5}
"""Unsupported inputs that Blender writes to UsdPreviewSurface, which does not define them."""

_WEIGHTS = ("base", "base_weight")
"""Inputs that the base color is multiplied with."""

_PARTS = "clearcoat|coat_|opacity|transmission_|subsurface_|fuzz_|sheen_|thin_film_".split("|")
"""Prefixes of inputs that only refine an unsupported one."""

_LOST = {
    "opacity": "transparency",
    "transmission": "transmission",
    "clearcoat": "clearcoat",
    "coat": "clearcoat",
    "subsurface": "subsurface",
    "displacement": "displacement",
    "normal": "normal map",
}
"""Words for unsupported inputs, by the beginnings of their names."""

_READERS: Mapping[str, tuple[str, str]] = {
    **{
        f"UsdPrimvarReader_{kind}": ("varname", "fallback")
        for kind in ("float", "float3", "float4", "int", "vector", "point", "normal")
    },
    **{
        f"ND_geompropvalue_{kind}": ("geomprop", "default")
        for kind in ("float", "color3", "color4", "vector3")
    },
}
"""Nodes that read a primvar: their inputs for its name and for its fallback."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StatedMaterial:
    """The inputs of a material, before its pictures are decoded."""

    name: str
    """Name of the material's prim."""
    where: str
    """Path of its shader, for notes."""
    constants: Mapping[str, NDArray[np.float32]]
    """Values [3] of all inputs by name in UsdPreviewSurface; fallbacks for primvars."""
    textures: Mapping[str, TextureNode] = field(default_factory=dict)
    """Textures by name of the input; they override constants."""
    primvars: Mapping[str, str] = field(default_factory=dict)
    """Names of primvars by name of the input; they override constants."""
    has_strength: bool = False
    """True where emission is multiplied with `strength`."""
    lost: tuple[str, ...] = ()
    """Words for unsupported inputs that have an effect, and for networks that feed an input."""

    @property
    def is_specular(self) -> bool:
        """Return whether the material uses the specular workflow."""
        return bool(self.constants["useSpecularWorkflow"].any())


def read_colors(cut: CutMesh, primvar: str) -> NDArray[np.float64] | None:
    """Return numbers or colors at corners as colors [T, 3, 3]; None for anything else."""
    values = cut.read_primvar(primvar)
    if values is None:
        return None
    wide = values[..., None] if values.ndim == 2 else values
    if wide.ndim != 3 or wide.shape[2] not in (1, 3, 4) or not np.isfinite(wide).all():
        return None
    count = 3 if wide.shape[2] > 1 else 1
    return np.broadcast_to(wide[..., :count], (*wide.shape[:2], 3)).astype(np.float64)


def reflect_head_on(ior: Any) -> Any:
    """Return the share that a dielectric of an index of refraction reflects head-on."""
    return np.square((ior - 1) / np.maximum(ior + 1, 1e-3))


def read_bindings(placed: PlacedPrim) -> Iterator[tuple[Any, NDArray[np.int64] | None]]:
    """Yield the material of a mesh, or None; then those of its subsets with their polygons.

    The binding for full rendering, or else that for previews, counts if its shader is supported.
    Later subsets override earlier ones.
    """
    yield _find_material(placed.prim), None
    for subset in UsdShade.MaterialBindingAPI(placed.prim).GetMaterialBindSubsets():
        bound = _find_material(subset.GetPrim())
        if bound and subset.GetElementTypeAttr().Get(placed.time) == "face":
            yield bound, as_array(subset.GetIndicesAttr().Get(placed.time), np.int64, (-1,))


def _find_material(prim: Any) -> Any:
    first = None
    for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)[0]
        if material and surface_shader(material):
            return material
        first = first or material or None
    return first


def surface_shader(material: Any) -> Any:
    """Return a supported shader of a material, UsdPreviewSurface first, or None."""
    shader = None
    for context in ("", "mtlx"):
        source = material.ComputeSurfaceSource(context)[0]
        known = source and source.GetShaderId() in NAMES
        if known and (shader is None or source.GetShaderId() == PREVIEW):
            shader = source
    return shader


def read_material(
    material: Any,
    opened: OpenedStage,
    known: Collection[str] = (),
    *,
    normals: bool = False,
) -> StatedMaterial | None:
    """Return the inputs of a material, or None where it has no supported shader.

    Args:
        material: the UsdShade.Material.
        opened: the file, which receives notes.
        known: unsupported inputs that the caller reads itself.
        normals: whether the normal map of a UsdPreviewSurface is read, as the texture `normal`.

    Raises:
        TrilightError: a picture is outside of the folder, or on the network.
    """
    shader = surface_shader(material)
    if shader is None:
        return None
    reader = ShaderReader(shader, opened)
    notes = len(opened.lost)
    for name in TEXTURED:
        reader.read_connection(name)
    if normals and shader.GetShaderId() == PREVIEW:
        reader.read_connection("normal")
    constants = {name: reader.constant(name) for name in DEFAULTS}
    has_networks = len(opened.lost) > notes
    constants["diffuseColor"] = constants["diffuseColor"] * reader.weight()
    if material.GetDisplacementOutput().HasConnectedSource():
        opened.lost.append(f"{material.GetPath()}: its displacement has no place here")
    lost = reader.note_unsupported(known)
    words = {word for name in lost for start, word in _LOST.items() if name.startswith(start)}
    if reader.textures.pop("ior", None):
        opened.lost.append(f"{shader.GetPath()}.ior: its texture is not read; 1.5 taken")
    return StatedMaterial(
        name=str(material.GetPrim().GetName()),
        where=str(shader.GetPath()),
        constants=constants,
        textures=reader.textures,
        primvars=reader.primvars,
        has_strength="strength" in NAMES[shader.GetShaderId()],
        lost=tuple(sorted(words | {"networks of shaders"} if has_networks else words)),
    )


class ShaderReader:
    """Reads the inputs of one supported shader."""

    def __init__(self, shader: Any, opened: OpenedStage) -> None:
        """Take the names and defaults of the shader; the notes of `opened` receive what is lost."""
        self._shader = shader
        self._opened = opened
        self._names = NAMES[shader.GetShaderId()]
        self._defaults = _DEFAULTS[shader.GetShaderId()]
        is_preview = shader.GetShaderId() == PREVIEW
        self._neutral = {**_NEUTRAL, **_OF_BLENDER} if is_preview else _NEUTRAL
        self.textures: dict[str, TextureNode] = {}
        self.primvars: dict[str, str] = {}
        self._fallbacks: dict[str, Any] = {}

    def read_connection(self, name: str) -> None:
        """Store the texture or the primvar that an input is connected to."""
        sources = self._sources(name)
        if not sources or not is_output(sources[0]):
            return
        node = UsdShade.Shader(sources[0].GetPrim())
        if node.GetShaderId() == "UsdUVTexture":
            output = UsdShade.Output(sources[0]).GetBaseName()
            self.textures[name] = read_texture_node(node, output, self._opened)
        elif name == "normal":  # other connections stay unsupported
            return
        elif node.GetShaderId() in _READERS:
            primvar, fallback = _READERS[node.GetShaderId()]
            self.primvars[name] = str(read_input(node, primvar, self._opened.time, ""))
            self._fallbacks[name] = read_input(node, fallback, self._opened.time, 0.0)
        else:
            self._lose(name, f"{node.GetShaderId() or 'a network'} that is not read")

    def constant(self, name: str) -> NDArray[np.float32]:
        """Return the constant [3] of an input; a number fills all channels."""
        default = self._defaults[name]
        stated = self._fallbacks.get(name)
        sources = self._sources(name)
        if sources and not is_output(sources[0]):
            stated = sources[0].Get(self._opened.time)
            stated = None if stated is None else convert_to_rec709(sources[0], np.array(stated))
        value = parse_color(default if stated is None else stated)
        if value is None:
            self._lose(name, "no finite number or color")
            return np.broadcast_to(np.array(default, np.float32), 3)
        return value

    def weight(self) -> NDArray[np.float32]:
        """Return the factor [3] of a base color; a textured one is not multiplied."""
        product = np.ones(3, np.float32)
        for name in _WEIGHTS:
            value = self._value(name, 1.0)
            if value is None or ("diffuseColor" in self.textures and (value != 1).any()):
                self._opened.lost.append(f"{self._shader.GetPath()}.{name}: has no place here")
            else:
                product = product * value
        return product

    def note_unsupported(self, known: Collection[str]) -> tuple[str, ...]:
        """Note unsupported inputs that have an effect, but for known ones; return their names."""
        read = {*(self._names.get(name, name) for name in DEFAULTS), *_WEIGHTS, *self.textures}
        names = []
        for each in self._shader.GetInputs():
            name = str(each.GetBaseName())
            if name in self._neutral:
                value = self._value(name, self._neutral[name])
                is_lost = value is None or (value != self._neutral[name]).any()
            elif name in read or name.startswith(tuple(_PARTS)):
                is_lost = False
            else:
                is_lost = each.HasConnectedSource() or (
                    name != "normal" and each.GetAttr().HasAuthoredValue()
                )
            if is_lost and name not in known:
                names.append(name)
        where = self._shader.GetPath()
        self._opened.lost += [f"{where}.{name}: has no place here" for name in names]
        return tuple(names)

    def _value(self, name: str, default: float) -> NDArray[np.float32] | None:
        """Return the value [3] of an input; None for a network, or a value that is no color."""
        sources = self._sources(name)
        if sources and is_output(sources[0]):
            return None
        return parse_color(read_input(self._shader, name, self._opened.time, default))

    def _sources(self, name: str) -> Any:
        return find_sources(self._shader, self._names.get(name, name))

    def _lose(self, name: str, why: str) -> None:
        called = self._names.get(name, name)
        self._opened.lost.append(
            f"{self._shader.GetPath()}.{called}: {why}; {self._defaults[name]} taken"
        )


def parse_color(stated: Any) -> NDArray[np.float32] | None:
    """Return a number or color as a color [3]; None for anything else."""
    value = np.array(stated, np.float32)  # None becomes NaN
    if value.shape == (4,):  # alpha is an input of its own
        value = value[:3]
    if value.shape not in ((), (3,)) or not np.isfinite(value).all():
        return None
    return np.broadcast_to(value, 3).astype(np.float32)
