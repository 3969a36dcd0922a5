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
from pipeline.foreign.usd.shaders import StatedInputs
from pipeline.foreign.usd.stage import OpenedUsd
from storage.records.texture import MapSource, Texture


class ShaderInputs:
    """What a shader is fed with."""

    def __init__(self, shader: Any, time: Any, opened: OpenedUsd) -> None:
        """Remember it; nothing is read yet.

        Args:
            shader: the shader of a material.
            time: of the values.
            opened: the file; what is lost is noted there.
        """
        self._stated, self._time, self._opened = StatedInputs(shader, time, opened), time, opened
        self._read: dict[str, ForeignTexture | None] = {}

    def textures(self, names: Collection[str]) -> dict[str, ForeignTexture]:
        """Return the textures that inputs are connected to, by their names."""
        found = {name: self._texture(name) for name in names}
        return {name: each for name, each in found.items() if each is not None}

    def constant(self, name: str) -> NDArray[np.float32]:
        """Return the value [3] of an input without a texture; a number stands in every channel."""
        node = self._stated.texture(name)
        if node is not None and node.fallback is not None and self._texture(name) is None:
            return self._stated.finite(name, node.fallback[:3])
        return self._stated.constant(name)

    def emission(self, surface: MeshToShade) -> NDArray[np.float32]:
        """Return the radiance [T, 3] of triangles: of a texture its mean over each."""
        count = len(surface.soup.polygons)
        texture = self._texture("emissiveColor")
        if texture is not None:
            uv = coordinates(texture.chart, surface, self._time)
            if uv is None:
                uv = np.broadcast_to(np.float64(0.5), (count, 3, 2))
            glow = texture.means(uv)
            self._opened.lost.append(
                f"{surface.prim.GetPath()}: texture of emissiveColor became one value a triangle"
            )
        else:
            glow = np.broadcast_to(self.constant("emissiveColor"), (count, 3))
        strength = self.constant("strength") if self._stated.has("strength") else np.float32(1)
        return np.maximum(glow * strength, 0).astype(np.float32)

    def _texture(self, name: str) -> ForeignTexture | None:
        if name not in self._read:
            node = self._stated.texture(name)
            self._read[name] = None if node is None else read_texture(node, self._opened)
        return self._read[name]


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
