"""Scenes beyond the trained range, one axis at a time, with everything else at its median.

A picture that a network gets wrong here says which quantity it was, since nothing else is unusual.
What has no median stays drawn: which objects, how they are turned, where they and the lights are,
colours, and from which side the camera looks.
"""

import dataclasses
import math
from collections.abc import Mapping
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


def out_of_range_settings(max_triangles: int) -> SceneSettings:
    """Return the median scenes with every excursion; a whole turn is 37 values of nine axes."""
    return dataclasses.replace(
        median_settings(max_triangles),
        excursions=(
            *(_triangles(count) for count in (6144, 8192, 12288, 16384)),
            *(_one("fov_deg", v, "cameras.fov_deg") for v in (10.0, 20.0, 75.0, 90.0, 110.0)),
            *(_one("distance", v, "cameras.distance") for v in (1.0, 1.25, 2.5, 3.0, 4.0)),
            *(_one("lights", v, "lights.count") for v in (9, 16, 24, 32)),
            *(_excursion("lights_inside", v, {"lights.num_inside": v}) for v in (1, 2)),
            *(
                _one(axis, factor, name, factor * median)
                for axis, name, median in (
                    ("light_size", "lights.scale", _MEDIAN_SIZE),
                    ("light_strength", "lights.total_emission", _MEDIAN_EMISSION),
                )
                for factor in (0.1, 0.3, 3.0, 10.0)
            ),
            *(_objects(count) for count in (4, 5, 6, 7, 8)),
            *(_one("roughness", v, "materials.roughness_clip") for v in (0.01, 0.02, 0.03, 0.04)),
        ),
    )


def out_of_range_2_settings(max_triangles: int) -> SceneSettings:
    """Return the same with excursions of what came later: 12 values of five axes of maps."""
    before = out_of_range_settings(max_triangles)
    below_sun = {**_BELOW_SKY, "skies.maps.families": ("sun_and_sky",)}
    return dataclasses.replace(
        before,
        excursions=(
            *before.excursions,
            *(
                _excursion("textured", share, {**_TEXTURED, "textures.share": share})
                for share in (0.5, 1.0)
            ),
            *(
                _excursion("texture_tile_m", v, {**_TEXTURED, "textures.tile_m": _point(v)})
                for v in (0.1, 0.4, 1.6, 6.4)
            ),
            *(
                _excursion("sky", v, {**_BELOW_SKY, "skies.over_lamps_log": _point(v)})
                for v in (0.1, 1.0, 10.0)
            ),
            _excursion("sky_seen", 1, {**_BELOW_SKY, "skies.seen_share": 1.0}),
            *(
                _excursion("sun_to_sky", v, {**below_sun, "skies.maps.sun_to_sky": _point(v)})
                for v in (8.0, 64.0)
            ),
        ),
    )


def _median_family(family: Family) -> Family:
    room = SharedRoom(
        square_share=1.0, scale=_point(1.175), shift=0.0, raise_z=_point(0.1), tilt_deg=0.0
    )
    return dataclasses.replace(family, shell=room, num_objects=(2, 2), object_scale=_point(1.3))


def _point(value: float) -> Range:
    return (value, value)


def _excursion(axis: str, value: float, changes: dict[str, Any]) -> Excursion:
    return Excursion(axis=axis, value=value, changes=tuple(changes.items()))


def _one(axis: str, value: float, name: str, at: float | None = None) -> Excursion:
    """One setting, a range, at one number: the value itself by default."""
    return _excursion(axis, value, {name: _point(value if at is None else at)})


def _triangles(count: int) -> Excursion:
    """Finer triangles of the same surfaces: a difference is the number's and not the shape's."""
    return _excursion("triangles", count, {"max_triangles": count, "fill_to": count})


def _objects(count: int) -> Excursion:
    """So many objects of median size do not fit without overlap; published ones overlap too."""
    changes = {"families.num_objects": (count, count), "placement.overlap_share": 1.0}
    return _excursion("objects", count, changes)
