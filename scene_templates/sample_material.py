"""Samples GGX materials of surfaces: the published distribution, in linear colour throughout.

The published pipeline passes colours through 8-bit vertex colours whose transfer curve differs
between its renderer and its tokens (reference: renderformer.md, G.3); a number here means the same
albedo everywhere.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from scene_templates.checks import Range, require
from scene_templates.layout import SurfaceLook
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@checked("scene settings")
class MaterialSettings:
    """Ranges and shares from which the materials of surfaces are drawn."""

    albedo_sum: Annotated[Range, Within(0, 1)] = (0.9, 1.0)
    """Sum of the diffuse scale and the specular albedo of a surface."""
    specular_ratio: Annotated[Range, Within(0, 1)] = (0.0, 1.0)
    """Share of `albedo_sum` that is specular."""
    roughness_log: Annotated[Range, Within(1e-6, 2)] = (0.06, 1.055)
    """Log-uniform range of roughness, from which `roughness_bias` is then subtracted."""
    roughness_bias: Annotated[float, Within(0, 1)] = 0.05
    """Subtracted from the log-uniform roughness; makes smooth surfaces common without making many
    equal to the smallest value."""
    roughness_clip: Annotated[Range, Within(0, 1)] = (0.01, 1.0)
    """Minimum and maximum roughness."""
    coloured_share: Share = 0.5
    """Share of the surfaces with interpolated normals that have many colors: a floor or wall has
    one for each triangle, an object one for each shading group or triangle."""
    triangle_colours_share: Share = 0.5
    """Share of the many-colored objects with a color for each triangle instead of each shading
    group; one half as in the paper (the published code makes none)."""
    coloured_specular_share: Share = 0.0
    """Share of surfaces whose specular albedo is tinted: each channel is uniform between 0 and the
    untinted value. An option: the published scenes have none, and so no metal but gray ones."""
    smooth_angle_deg: Annotated[float, Within(0, 180, unit="degrees")] = 30.0
    """Angle between faces above which an edge separates shading groups."""
    source: Literal["drawn", "object"] = "drawn"
    """Where the materials of objects come from: `object` keeps those of their files, as textures;
    an object without any, and floors and walls, get drawn ones in either case."""
    own_share: Share = 1.0
    """Share of the objects that keep their own materials where `source` is `object`."""
    own_emission: Share = 0.0
    """Light that the emissive parts of such objects give together, as a share of that of the drawn
    lamps; 0 for none. Less where they would be brighter than the brightest lamp. A part that emits
    is a lamp: the camera does not see it."""

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the source where materials are drawn: digests of earlier presets stay."""
        record: dict[str, Any] = as_usual(self)
        absent = ("source", "own_share", "own_emission") if self.source == "drawn" else ()
        absent = absent if self.own_emission else (*absent, "own_emission")
        return {name: value for name, value in record.items() if name not in absent}

    def __post_init__(self) -> None:
        low = self.roughness_log[0]
        bias = self.roughness_bias
        require(low >= bias, "roughness_bias", bias, "at most roughness_log's low")


def sample_material(
    rng: np.random.Generator,
    settings: MaterialSettings,
    *,
    smooth_share: float,
    kind: Literal["shell", "object"],
) -> SurfaceLook:
    """Draw a surface: mostly white energy split between a coloured diffuse and a specular.

    Args:
        rng: where the numbers come from.
        settings: the ranges.
        smooth_share: probability of interpolated normals.
        kind: whether the triangles or the shading groups get the colours where there are many.
    """
    albedo_sum = rng.uniform(*settings.albedo_sum)
    specular = albedo_sum * rng.uniform(*settings.specular_ratio)
    diffuse_scale = albedo_sum - specular
    red, green, blue = diffuse_scale * rng.random(3)
    low, high = (math.log(bound) for bound in settings.roughness_log)
    roughness = math.exp(rng.uniform(low, high)) - settings.roughness_bias
    smooth = bool(rng.random() < smooth_share)
    coloured = smooth and rng.random() < settings.coloured_share
    by_triangle = kind == "shell" or rng.random() < settings.triangle_colours_share
    tint = rng.random(3) if rng.random() < settings.coloured_specular_share else np.ones(3)
    specular_red, specular_green, specular_blue = specular * tint
    return SurfaceLook(
        diffuse_scale=diffuse_scale,
        diffuse_rgb=(red, green, blue),
        specular_rgb=(specular_red, specular_green, specular_blue),
        roughness=float(np.clip(roughness, *settings.roughness_clip)),
        smooth=smooth,
        colours=("triangles" if by_triangle else "groups") if coloured else "one",
    )
