"""What the shader of a material states: constants and textures by the names of UsdPreviewSurface.

OpenPBR and Standard Surface, which MaterialX brings, are read by the same names as far as they mean
the same.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.usd.stage import OpenedUsd
from pipeline.foreign.usd.texture_nodes import TextureNode, texture_node

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

_NEUTRAL = {
    "opacity": 1.0,
    "clearcoat": 0.0,
    "displacement": 0.0,
    "transmission_weight": 0.0,
    "transmission": 0.0,
    "coat_weight": 0.0,
    "coat": 0.0,
    "subsurface_weight": 0.0,
}
"""Inputs that have no place here, with the value at which they do nothing."""


def surface_shader(material: Any) -> Any:
    """Return the shader of a material that is understood, a preview before others; else None."""
    found = None
    for context in ("", "mtlx"):
        source = material.ComputeSurfaceSource(context)[0]
        known = source and source.GetShaderId() in NAMES
        if known and (found is None or source.GetShaderId() == PREVIEW):
            found = source
    return found


def without_place(shader: Any, time: Any) -> list[str]:
    """Return the inputs of a shader that do something, and have no place here."""
    found = []
    for name, neutral in _NEUTRAL.items():
        known = shader.GetInput(name)
        if known and (known.HasConnectedSource() or known.Get(time) not in (None, neutral)):
            found.append(name)
    bump = shader.GetInput("normal")
    return [*found, "normal"] if bump and bump.HasConnectedSource() else found


class StatedInputs:
    """The inputs of a shader as it states them."""

    def __init__(self, shader: Any, time: Any, opened: OpenedUsd) -> None:
        """Remember it; nothing is read yet.

        Args:
            shader: one of NAMES.
            time: of the values.
            opened: the file; what is lost is noted there.
        """
        self._shader, self._time, self._opened = shader, time, opened
        self._names = NAMES[shader.GetShaderId()]
        self._nodes: dict[str, TextureNode | None] = {}

    def has(self, name: str) -> bool:
        """Return whether this kind of shader has the input under a name of its own."""
        return name in self._names

    def texture(self, name: str) -> TextureNode | None:
        """Return the texture that an input is connected to.

        Raises:
            TrilightError: as `texture_node`.
        """
        if name not in self._nodes:
            self._nodes[name] = self._node(name)
        return self._nodes[name]

    def constant(self, name: str) -> NDArray[np.float32]:
        """Return the value [3] of an input without a texture; a number stands in every channel."""
        sources = self._sources(name)
        stated = sources[0].Get(self._time) if sources and not _is_output(sources[0]) else None
        return self.finite(name, DEFAULTS[name] if stated is None else stated)

    def finite(self, name: str, stated: Any) -> NDArray[np.float32]:
        """Return a number or colour as a colour [3]; the default of the input for anything else."""
        value = np.array(stated, np.float32)
        if value.ndim > 1 or value.shape not in ((), (3,)) or not np.isfinite(value).all():
            self._lose(name, "no finite number or colour")
            value = np.array(DEFAULTS[name], np.float32)
        return np.broadcast_to(value, 3).astype(np.float32)

    def _node(self, name: str) -> TextureNode | None:
        from pxr import UsdShade

        sources = self._sources(name)
        if not sources or not _is_output(sources[0]):
            return None
        output = UsdShade.Output(sources[0])
        node = UsdShade.Shader(sources[0].GetPrim())
        if node.GetShaderId() == "UsdUVTexture":
            return texture_node(node, output.GetBaseName(), self._time, self._opened)
        self._lose(name, "a network that is not read")
        return None

    def _sources(self, name: str) -> Any:
        from pxr import UsdShade

        known = self._shader.GetInput(self._names.get(name, name))
        return UsdShade.Utils.GetValueProducingAttributes(known) if known else []

    def _lose(self, name: str, why: str) -> None:
        called = self._names.get(name, name)
        self._opened.lost.append(
            f"{self._shader.GetPath()}.{called}: {why}; {DEFAULTS[name]} taken"
        )


def _is_output(attribute: Any) -> bool:
    from pxr import UsdShade

    return bool(UsdShade.Output.IsOutput(attribute))
