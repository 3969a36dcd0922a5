"""The inputs of a shader that is understood: textures, constants, and what they make together."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import (
    colour_textures,
    constant_map,
    is_constant,
    linear_map,
    on_one_grid,
    over_one,
)
from pipeline.exchange.usd.foreign_coordinates import coordinates
from pipeline.exchange.usd.foreign_meshes import MeshToShade
from pipeline.exchange.usd.foreign_textures import ForeignTexture, read_texture
from pipeline.exchange.usd.stage import OpenedUsd
from storage.records.texture import MapSource, Texture

PREVIEW = "UsdPreviewSurface"
NAMES: Mapping[str, Mapping[str, str]] = {
    PREVIEW: {},
    "ND_open_pbr_surface_surfaceshader": {
        "diffuseColor": "base_color",
        "metallic": "base_metalness",
        "roughness": "specular_roughness",
        "ior": "specular_ior",
        "emissiveColor": "emission_color",
        "strength": "emission_luminance",
    },
    "ND_standard_surface_surfaceshader": {
        "diffuseColor": "base_color",
        "metallic": "metalness",
        "roughness": "specular_roughness",
        "ior": "specular_IOR",
        "emissiveColor": "emission_color",
        "strength": "emission",
    },
}
"""How shaders call what UsdPreviewSurface calls by the first name."""

_DEFAULTS: Mapping[str, Any] = {
    "diffuseColor": (0.18, 0.18, 0.18),
    "specularColor": 0.0,
    "metallic": 0.0,
    "roughness": 0.5,
    "ior": 1.5,
    "emissiveColor": 0.0,
    "strength": 0.0,
    "useSpecularWorkflow": 0.0,
}


class ShaderInputs:
    """What a shader is fed with."""

    def __init__(self, shader: Any, names: Mapping[str, str], time: Any, opened: OpenedUsd) -> None:
        """Remember it; nothing is read yet.

        Args:
            shader: the shader of a material.
            names: how it calls its inputs (NAMES).
            time: of the values.
            opened: the file; what is lost is noted there.
        """
        self._shader, self._names, self._time, self._opened = shader, names, time, opened
        self._read: dict[str, ForeignTexture | NDArray[np.float64] | None] = {}

    def has(self, name: str) -> bool:
        """Return whether this kind of shader has the input under a name of its own."""
        return name in self._names

    def textures(self, names: Collection[str]) -> dict[str, ForeignTexture]:
        """Return the textures that inputs are connected to, by their names."""
        found = {name: self._connected(name) for name in names}
        return {name: each for name, each in found.items() if isinstance(each, ForeignTexture)}

    def constant(self, name: str) -> NDArray[np.float32]:
        """Return the value [3] of an input without a texture; a number stands in every channel."""
        fallback = self._connected(name)
        if isinstance(fallback, np.ndarray):
            return self._finite(name, fallback[:3])
        sources = self._sources(name)
        stated = sources[0].Get(self._time) if sources and not _is_output(sources[0]) else None
        return self._finite(name, _DEFAULTS[name] if stated is None else stated)

    def emission(self, surface: MeshToShade) -> NDArray[np.float32]:
        """Return the radiance [T, 3] of triangles: of a texture its mean over each."""
        count = len(surface.soup.polygons)
        texture = self._connected("emissiveColor")
        if isinstance(texture, ForeignTexture):
            uv = coordinates(texture.chart, surface, self._time)
            if uv is None:
                uv = np.broadcast_to(np.float64(0.5), (count, 3, 2))
            glow = texture.means(uv)
            self._opened.lost.append(
                f"{surface.prim.GetPath()}: texture of emissiveColor became one value a triangle"
            )
        else:
            glow = np.broadcast_to(self.constant("emissiveColor"), (count, 3))
        strength = self.constant("strength") if self.has("strength") else np.float32(1)
        return np.maximum(glow * strength, 0).astype(np.float32)

    def _connected(self, name: str) -> ForeignTexture | NDArray[np.float64] | None:
        """Return the texture of an input, or its fallback [4]; None where it has neither."""
        if name not in self._read:
            self._read[name] = self._texture(name)
        return self._read[name]

    def _texture(self, name: str) -> ForeignTexture | NDArray[np.float64] | None:
        from pxr import UsdShade

        sources = self._sources(name)
        if not sources or not _is_output(sources[0]):
            return None
        output = UsdShade.Output(sources[0])
        node = UsdShade.Shader(sources[0].GetPrim())
        if node.GetShaderId() == "UsdUVTexture":
            found = read_texture(node, output.GetBaseName(), self._time, self._opened)
            if found is not None:
                return found
        self._lose(name, "a network that is not read")
        return None

    def _sources(self, name: str) -> Any:
        from pxr import UsdShade

        known = self._shader.GetInput(self._names.get(name, name))
        return UsdShade.Utils.GetValueProducingAttributes(known) if known else []

    def _finite(self, name: str, stated: Any) -> NDArray[np.float32]:
        value = np.array(stated, np.float32)
        if value.ndim > 1 or value.shape not in ((), (3,)) or not np.isfinite(value).all():
            self._lose(name, "no finite number or colour")
            value = np.array(_DEFAULTS[name], np.float32)
        return np.broadcast_to(value, 3).astype(np.float32)

    def _lose(self, name: str, why: str) -> None:
        called = self._names.get(name, name)
        self._opened.lost.append(
            f"{self._shader.GetPath()}.{called}: {why}; {_DEFAULTS[name]} taken"
        )


def worn_textures(
    inputs: ShaderInputs,
    textures: Mapping[str, Texture],
    source: MapSource,
    where: str,
    lost: list[str],
) -> tuple[Texture, Texture, Texture]:
    """Return diffuse, specular and roughness of a material; a constant is a texture of one texel.

    Args:
        inputs: of its shader.
        textures: of inputs that have one.
        source: name and rights of textures that are worked out.
        where: the mesh, for notes.
        lost: receives what cannot be carried over.
    """

    def of(name: str, channels: int) -> Texture:
        if name in textures:
            return textures[name]
        return Texture(
            texels=constant_map(np.clip(inputs.constant(name)[:channels], 0, 1)), source=source
        )

    base, roughness = of("diffuseColor", 3), of("roughness", 1)
    if inputs.constant("useSpecularWorkflow").any():
        diffuse, specular = base, of("specularColor", 3)
    else:
        diffuse, specular = _metallic(base, of("metallic", 1), inputs, textures, source)
    if over_one(diffuse, specular) and not (_one_texel(diffuse) and _one_texel(specular)):
        lost.append(f"{where}: textured diffuse lowered where it would reflect more than it gets")
        diffuse, specular = colour_textures(linear_map(diffuse), linear_map(specular), source)
    return diffuse, specular, roughness


def _metallic(
    base: Texture,
    metal: Texture,
    inputs: ShaderInputs,
    textures: Mapping[str, Texture],
    source: MapSource,
) -> tuple[Texture, Texture]:
    """Return the albedos of the metallic workflow: head-on, a metal reflects its base colour."""
    ior = inputs.constant("ior")
    if "ior" in textures:
        ior = np.broadcast_to(textures["ior"].mean, 3)
    head_on = np.square((ior - 1) / np.maximum(ior + 1, 1e-3)).astype(np.float32)
    dielectric = Texture(texels=constant_map(np.clip(head_on, 0, 1)), source=source)
    if not metal.greatest.any():
        return base, dielectric
    colour, share = on_one_grid(linear_map(base), linear_map(metal))
    diffuse = (colour * (1 - share)).astype(np.float32)
    specular = np.clip(head_on * (1 - share) + colour * share, 0, 1).astype(np.float32)
    if is_constant(diffuse):
        return tuple(Texture(texels=each, source=source) for each in (diffuse, specular))  # type: ignore[return-value]
    return colour_textures(diffuse, specular, source)


def _one_texel(texture: Texture) -> bool:
    return is_constant(texture.texels)  # type: ignore[arg-type]


def _is_output(attribute: Any) -> bool:
    from pxr import UsdShade

    return bool(UsdShade.Output.IsOutput(attribute))
