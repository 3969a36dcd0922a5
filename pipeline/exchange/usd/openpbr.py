"""The OpenPBR shader of a material: what is written for its columns, and which columns it states.

OpenPBR's base has one index of refraction: it is set so that the strongest channel reflects the
specular albedo head-on, and the tint gives the other channels. OpenPBR counts emission in nits; it
gets the radiance.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import Attributes
from pipeline.foreign.usd.shaders import (
    note_unsupported,
    parse_color,
    reflect_head_on,
    surface_shader,
)
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import convert_to_rec709, find_sources, is_output

Color = tuple[float, float, float]

_SHADER = "ND_open_pbr_surface_surfaceshader"

_MOST_REFLECTING = 0.98
"""Maximum head-on reflectance that sets the index of refraction: 0.98 needs 199."""

_INPUTS = {
    "diffuse": ("base_weight", "base_color"),
    "specular": ("specular_weight", "specular_color", "specular_ior"),
    "roughness": ("specular_roughness",),
    "emission": ("emission_luminance", "emission_color"),
}
"""Inputs whose product is a column; an index of refraction counts as its reflectance."""


def openpbr_inputs(
    diffuse: Color, specular: Color, roughness: float, emission: Color
) -> Attributes:
    """Return the attributes of the shader of a material's columns."""
    max_specular = max(specular)
    max_emission = max(emission)
    root = math.sqrt(min(max_specular, _MOST_REFLECTING))
    return {
        "info:id": ("uniform token", _SHADER),
        "inputs:base_color": ("color3f", diffuse),
        "inputs:base_weight": ("float", 1.0),
        "inputs:base_diffuse_roughness": ("float", 0.0),
        "inputs:specular_weight": ("float", 1.0 if max_specular > 0 else 0.0),
        "inputs:specular_color": ("color3f", _divide_by_largest(specular, max_specular)),
        "inputs:specular_roughness": ("float", roughness),
        "inputs:specular_ior": ("float", _round_to_float32((1 + root) / (1 - root))),
        "inputs:emission_luminance": ("float", max_emission),
        "inputs:emission_color": ("color3f", _divide_by_largest(emission, max_emission)),
    }


def written_columns(columns: Mapping[str, NDArray]) -> dict[str, NDArray[np.float64]]:
    """Return the columns [3] that the shader written for a material's columns states."""
    diffuse, specular, roughness, emission = (
        tuple(np.maximum(columns[name], 0).tolist()) for name in _INPUTS
    )
    table = openpbr_inputs(diffuse, specular, roughness[0], emission)
    constants = {name.removeprefix("inputs:"): value for name, (_, value) in table.items()}
    return _multiply(constants)


def read_openpbr(material: Any, time: Any, opened: OpenedStage) -> dict[str, NDArray[np.float64]]:
    """Return the columns [3] that the OpenPBR shader beside a preview states; none without both.

    Columns with an input that is missing, or no constant, are left out; notes name the latter.
    """
    shader = material.ComputeSurfaceSource("mtlx")[0]
    preview = surface_shader(material)
    if not shader or shader.GetShaderId() != _SHADER or shader.GetPath() == preview.GetPath():
        return {}
    values = dict[str, NDArray[Any]]()
    for name in (each for inputs in _INPUTS.values() for each in inputs):
        sources = find_sources(shader, name)
        if not sources:
            continue
        stated = None if is_output(sources[0]) else sources[0].Get(time)
        value = parse_color(
            None if stated is None else convert_to_rec709(sources[0], np.array(stated))
        )
        if value is None:
            opened.lost.append(f"{shader.GetPath()}.{name}: no finite constant; it is not read")
        else:
            values[name] = value
    note_unsupported(shader, time, opened, ("specular_weight", "specular_color"))
    return _multiply(values)


def _multiply(values: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    columns = {}
    for column, names in _INPUTS.items():
        if all(name in values for name in names):
            factors = [np.broadcast_to(values[name], 3).astype(float) for name in names]
            if column == "specular":
                factors[-1] = reflect_head_on(factors[-1])
            columns[column] = np.prod(factors, axis=0)
    return columns


def _divide_by_largest(rgb: Color, largest: float) -> Color:
    """Return a color divided by its largest channel; white for black."""
    if largest <= 0:
        return 1.0, 1.0, 1.0
    red, green, blue = (_round_to_float32(value / largest) for value in rgb)
    return red, green, blue


def _round_to_float32(value: float) -> float:
    return float(np.float32(value))
