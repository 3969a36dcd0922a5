"""Evaluates the inputs of a material on a mesh: textures, constants and primvars."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import (
    color_textures,
    constant_map,
    is_constant,
    linear_map,
    may_exceed_one,
    resample_to_largest,
)
from pipeline.exchange.usd.foreign_meshes import TriangleSoup
from pipeline.exchange.usd.foreign_textures import ForeignTexture, read_texture
from pipeline.exchange.usd.foreign_uv_textures import CHANNELS
from pipeline.foreign.usd.shaders import StatedMaterial, parse_color, reflect_head_on
from pipeline.foreign.usd.stage import OpenedStage
from storage.records.texture import MapSource, Texture


class ShaderInputs:
    """Inputs of a material on one mesh, read on demand."""

    def __init__(
        self, stated: StatedMaterial, surface: TriangleSoup, time: Any, opened: OpenedStage
    ) -> None:
        """Store the sources of the inputs; nothing is read yet.

        Args:
            stated: the material.
            surface: the mesh.
            time: time code of the values.
            opened: the open file, which collects notes on losses.
        """
        self.stated = stated
        self._surface = surface
        self._time = time
        self._opened = opened
        self._read: dict[str, ForeignTexture | None] = {}

    def textures(self, names: Collection[str]) -> dict[str, ForeignTexture]:
        """Return the textures of inputs, by the names of the inputs."""
        textures = {name: self._texture(name) for name in names}
        return {name: each for name, each in textures.items() if each is not None}

    def constant(self, name: str) -> NDArray[np.float32]:
        """Return the value [3] of an input without a texture; a number fills every channel."""
        node = self.stated.textures.get(name)
        if node is not None and node.fallback is not None and self._texture(name) is None:
            value = parse_color(node.fallback[:3])
            if value is not None:
                return value
        return self.stated.constants[name]

    def build_constant(self, name: str, channels: int, source: MapSource) -> Texture:
        """Return a constant input as a texture of one texel, with 1 or 3 channels in [0, 1]."""
        texels = constant_map(np.clip(self.constant(name)[:channels], 0, 1))
        return Texture(texels=texels, source=source)

    def compute_varying(self, name: str) -> NDArray[np.float32] | None:
        """Return the means [T, 3] of an input's primvar over triangles; None without one."""
        values = self.stated.read_values(name, self._surface.cut, self._time)
        return None if values is None else values.mean(axis=1).astype(np.float32)

    def emission(self) -> NDArray[np.float32]:
        """Return the radiance [T, 3] of triangles; a texture counts by its mean over each."""
        count = len(self._surface.positions)
        texture = self._texture("emissiveColor")
        glow = self.compute_varying("emissiveColor")
        if texture is not None:
            uv = self._surface.read_coordinates(texture.chart, self._time)
            if uv is None:
                uv = np.broadcast_to(np.float64(0.5), (count, 3, 2))
            glow = texture.means(uv)
            self._opened.lost.append(
                f"{self._surface.prim.GetPath()}: texture of emissiveColor became one value "
                "for each triangle"
            )
        elif glow is None:
            glow = np.broadcast_to(self.constant("emissiveColor"), (count, 3))
        strength = self.constant("strength") if self.stated.has_strength else np.float32(1)
        return np.maximum(glow * strength, 0).astype(np.float32)

    def _texture(self, name: str) -> ForeignTexture | None:
        if name not in self._read:
            node = self.stated.textures.get(name)
            self._read[name] = None if node is None else read_texture(node, self._opened)
        return self._read[name]


def compute_varying_columns(
    inputs: ShaderInputs, textures: Mapping[str, Texture]
) -> dict[str, NDArray[np.float32]]:
    """Return the material columns [T, 3] or [T, 1] that primvars of the mesh vary.

    Args:
        inputs: inputs of the material.
        textures: textures by input; their means count.
    """
    values = {name: inputs.compute_varying(name) for name in CHANNELS}
    varying = {name: each for name, each in values.items() if each is not None}

    def of(name: str) -> NDArray[np.float32]:
        if name in varying:
            return varying[name]
        constant = textures[name].mean if name in textures else inputs.constant(name)
        return np.broadcast_to(constant, 3).astype(np.float32)[None]

    columns = {}
    if "roughness" in varying:
        columns["roughness"] = np.clip(varying["roughness"][:, :1], 0, 1)
    if varying.keys() - {"roughness"}:
        albedos = of("diffuseColor"), of("specularColor")
        if not inputs.stated.is_specular:
            albedos = _split_albedos(of("diffuseColor"), of("metallic"), reflect_head_on(of("ior")))
        count = max(len(each) for each in varying.values())
        for name, albedo in zip(("diffuse", "specular"), albedos, strict=True):
            columns[name] = np.broadcast_to(np.clip(albedo, 0, 1), (count, 3))
    return columns


def build_textures(
    inputs: ShaderInputs,
    textures: Mapping[str, Texture],
    source: MapSource,
    where: str,
    lost: list[str],
) -> tuple[Texture, Texture, Texture]:
    """Return diffuse, specular and roughness of a material; a constant is a texture of one texel.

    Args:
        inputs: inputs of the shader.
        textures: textures by input.
        source: name and rights of computed textures.
        where: path of the mesh, for notes.
        lost: receives a sentence for each loss.
    """

    def of(name: str, channels: int) -> Texture:
        return textures.get(name) or inputs.build_constant(name, channels, source)

    base = of("diffuseColor", 3)
    roughness = of("roughness", 1)
    if inputs.stated.is_specular:
        diffuse = base
        specular = of("specularColor", 3)
    else:
        diffuse, specular = _build_metallic(base, of("metallic", 1), inputs, textures, source)
    if may_exceed_one(diffuse, specular) and not (_one_texel(diffuse) and _one_texel(specular)):
        diffuse, specular = lower_diffuse(diffuse, specular, source, where, lost)
    return diffuse, specular, roughness


def lower_diffuse(
    diffuse: Texture, specular: Texture, source: MapSource, where: str, lost: list[str]
) -> tuple[Texture, Texture]:
    """Return two albedos that add up to at most 1, and note it; see `build_textures`."""
    lost.append(f"{where}: textured diffuse lowered where diffuse + specular is over 1")
    return color_textures(linear_map(diffuse), linear_map(specular), source)


def _build_metallic(
    base: Texture,
    metal: Texture,
    inputs: ShaderInputs,
    textures: Mapping[str, Texture],
    source: MapSource,
) -> tuple[Texture, Texture]:
    """Return the albedos of the metallic workflow: a metal reflects its base color head-on."""
    ior = inputs.constant("ior")
    if "ior" in textures:
        ior = np.broadcast_to(textures["ior"].mean, 3)
    dielectric = reflect_head_on(ior).astype(np.float32)
    if not metal.greatest.any():
        return base, Texture(texels=constant_map(np.clip(dielectric, 0, 1)), source=source)
    color, metalness = resample_to_largest(linear_map(base), linear_map(metal))
    diffuse, specular = _split_albedos(color, metalness, dielectric)
    specular = np.clip(specular, 0, 1)
    if is_constant(diffuse):
        return tuple(Texture(texels=each, source=source) for each in (diffuse, specular))  # type: ignore[return-value]
    return color_textures(diffuse, specular, source)


def _split_albedos(
    base: NDArray[np.float32], metal: NDArray[np.float32], dielectric: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return diffuse and head-on albedo of a surface that is metal to the fraction `metal`."""
    specular = dielectric * (1 - metal) + base * metal
    return (base * (1 - metal)).astype(np.float32), specular.astype(np.float32)


def _one_texel(texture: Texture) -> bool:
    return is_constant(texture.texels)  # type: ignore[arg-type]
