"""Scenes beyond the trained range, one axis at a time, with everything else at its median.

A picture that a network gets wrong here says which quantity it was, since nothing else is unusual.
What has no median stays drawn: which objects, how they are turned, where they and the lights are,
colours, and from which side the camera looks.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from scene_templates.checks import Range
from scene_templates.families import Family
from scene_templates.frozen_v1 import ONE_FAMILY_EACH, SCENES_V1
from scene_templates.rooms import SharedRoom
from scene_templates.settings import Excursion, SceneSettings

_MEDIAN_EMISSION = 3750.0
_MEDIAN_SIZE = 2.25

_TEXTURED: Mapping[str, Any] = {
    "textures.share": 1.0,
    "textures.tile_m": (0.8, 0.8),
    "textures.surfaces.families": (
        "checker", "stripes", "bricks", "tiles", "hexagons", "planks", "wood", "marble",
        "terrazzo", "cobbles", "concrete", "rust", "brushed_metal", "fabric", "camouflage",
    ),
    "textures.surfaces.size": 256,
    "textures.surfaces.natural_share": 0.7,
    "textures.surfaces.albedo": (0.02, 0.9),
    "textures.surfaces.roughness_clip": (0.01, 1.0),
}  # fmt: skip
"""Every number of the surfaces is stated, since textures are in no scene of the base."""

_BELOW_SKY: Mapping[str, Any] = {
    "skies.share": 1.0,
    "skies.over_lamps_log": (1.0, 1.0),
    "skies.seen_share": 0.0,
    "skies.maps.families": (
        "sun_and_sky", "clouds", "night", "softboxes", "window_wall", "lobes", "gradient",
        "constant",
    ),
    "skies.maps.height": 256,
    "skies.maps.mean_radiance": (0.2, 2.0),
    "skies.maps.coloured_share": 0.1,
    "skies.maps.sun_elevation_deg": (2.0, 75.0),
    "skies.maps.sun_to_sky": (2.0, 2.0),
}  # fmt: skip
"""Every number of the skies is stated, since the base has none."""


def median_settings(max_triangles: int) -> SceneSettings:
    """Return scenes of two objects under four lights, every range at its middle."""
    rough = SCENES_V1.materials
    median_roughness = math.sqrt(math.prod(rough.roughness_log)) - rough.roughness_bias
    return dataclasses.replace(
        SCENES_V1,
        families=tuple(_median_family(family) for family in ONE_FAMILY_EACH),
        max_triangles=max_triangles,
        placement=dataclasses.replace(SCENES_V1.placement, overlap_share=0.0),
        materials=dataclasses.replace(
            rough,
            albedo_sum=_point(0.95),
            specular_ratio=_point(0.5),
            roughness_clip=_point(round(median_roughness, 4)),
        ),
        lights=dataclasses.replace(
            SCENES_V1.lights,
            count=(4, 4),
            total_emission=_point(_MEDIAN_EMISSION),
            scale=_point(_MEDIAN_SIZE),
            distance=_point(2.4),
        ),
        cameras=dataclasses.replace(SCENES_V1.cameras, distance=_point(1.75), fov_deg=_point(45.0)),
    )


_Axes = tuple[tuple[str, tuple[float, ...], Callable[[float], dict[str, Any]]], ...]
"""Name and values of each axis, and the settings that a value changes."""

_FACTORS = (0.1, 0.3, 3.0, 10.0)

_AXES: _Axes = (
    # finer triangles of the same surfaces: a difference is the number's and not the shape's
    ("triangles", (6144, 8192, 12288, 16384), lambda v: {"max_triangles": v, "fill_to": v}),
    ("fov_deg", (10.0, 20.0, 75.0, 90.0, 110.0), lambda v: {"cameras.fov_deg": _point(v)}),
    ("distance", (1.0, 1.25, 2.5, 3.0, 4.0), lambda v: {"cameras.distance": _point(v)}),
    ("lights", (9, 16, 24, 32), lambda v: {"lights.count": _point(v)}),
    ("lights_inside", (1, 2), lambda v: {"lights.num_inside": v}),
    ("light_size", _FACTORS, lambda v: {"lights.scale": _point(v * _MEDIAN_SIZE)}),
    ("light_strength", _FACTORS, lambda v: {"lights.total_emission": _point(v * _MEDIAN_EMISSION)}),
    # so many objects of median size do not fit without overlap; published ones overlap too
    (
        "objects",
        (4, 5, 6, 7, 8),
        lambda v: {"families.num_objects": _point(v), "placement.overlap_share": 1.0},
    ),
    ("roughness", (0.01, 0.02, 0.03, 0.04), lambda v: {"materials.roughness_clip": _point(v)}),
)

_BELOW_SUN = {**_BELOW_SKY, "skies.maps.families": ("sun_and_sky",)}

_AXES_OF_MAPS: _Axes = (
    ("textured", (0.5, 1.0), lambda v: {**_TEXTURED, "textures.share": v}),
    ("texture_tile_m", (0.1, 0.4, 1.6, 6.4), lambda v: {**_TEXTURED, "textures.tile_m": _point(v)}),
    ("sky", (0.1, 1.0, 10.0), lambda v: {**_BELOW_SKY, "skies.over_lamps_log": _point(v)}),
    ("sky_seen", (1,), lambda v: {**_BELOW_SKY, "skies.seen_share": float(v)}),
    ("sun_to_sky", (8.0, 64.0), lambda v: {**_BELOW_SUN, "skies.maps.sun_to_sky": _point(v)}),
)


def out_of_range_settings(max_triangles: int) -> SceneSettings:
    """Return the median scenes with every excursion; a whole turn is 37 values of nine axes."""
    return dataclasses.replace(median_settings(max_triangles), excursions=_excursions(_AXES))


def out_of_range_2_settings(max_triangles: int) -> SceneSettings:
    """Return the same with excursions of what came later: 12 values of five axes of maps."""
    excursions = _excursions(_AXES + _AXES_OF_MAPS)
    return dataclasses.replace(median_settings(max_triangles), excursions=excursions)


def _excursions(axes: _Axes) -> tuple[Excursion, ...]:
    return tuple(
        Excursion(axis=axis, value=value, changes=tuple(changes(value).items()))
        for axis, values, changes in axes
        for value in values
    )


def _median_family(family: Family) -> Family:
    room = SharedRoom(
        square_share=1.0, scale=_point(1.175), shift=0.0, raise_z=_point(0.1), tilt_deg=0.0
    )
    return dataclasses.replace(family, shell=room, num_objects=(2, 2), object_scale=_point(1.3))


def _point(value: float) -> Range:
    return (value, value)
