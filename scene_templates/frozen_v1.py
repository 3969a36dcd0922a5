"""Scene settings of the published sets, with every number stated.

A frozen set asks no list of families or layouts and takes no default: those may change, and sets
that networks are compared on may not. Test: tests/pipeline/presets/test_registry.py. The
layouts that are named here are frozen with it; another `plane` is registered under another name.

The out-of-range sets leave the trained range along one axis at a time, with everything else at its
median. A picture that a network gets wrong there says which quantity it was, since nothing else is
unusual. What has no median stays drawn: which objects, how they are turned, where they and the
lights are, colours, and from which side the camera looks.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from scene_templates.checks import Range
from scene_templates.families import Family
from scene_templates.placement import PlacementSettings
from scene_templates.rooms import SharedRoom
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.scene_maps import TextureSettings
from scene_templates.settings import Excursion, SceneSettings, ViewLaws
from scene_templates.skies.procedural_skies import SkyMapSettings, SkySettings
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings
from storage.settings.overrides import apply_overrides

_ROOM = SharedRoom(
    square_share=0.5, scale=(1.0, 1.35), shift=0.05, raise_z=(-0.05, 0.25), tilt_deg=3.0
)

ONE_FAMILY_EACH = tuple(
    Family(
        name=name,
        template=name,
        weight=1.0,
        shell=_ROOM,
        num_objects=(1, 3),
        object_scale=(0.8, 1.8),
        smooth_share=0.5,
    )
    for name in ("plane", "wall", "corner", "open_box")
)
"""One family for each layout, for sets in which the layouts take turns."""

SCENES_V1 = SceneSettings(
    families=ONE_FAMILY_EACH,
    families_in_turn=True,
    max_triangles=1536,
    enough_error=0.005,
    centring="box",
    fill_to=None,
    num_views=1,
    placement=PlacementSettings(
        orientation="uniform", resting_share=0.5, overlap_share=0.1, inside=True
    ),
    materials=MaterialSettings(
        albedo_sum=(0.9, 1.0),
        specular_ratio=(0.0, 1.0),
        roughness_log=(0.06, 1.055),
        roughness_bias=0.05,
        roughness_clip=(0.01, 1.0),
        coloured_share=0.5,
        triangle_colours_share=0.5,
        coloured_specular_share=0.0,
        smooth_angle_deg=30.0,
        source="drawn",
        own_share=1.0,
        own_emission=0.0,
    ),
    textures=TextureSettings(
        share=0.0, own_share=0.0, tile_m=(0.4, 1.6), surfaces=SurfaceMapSettings()
    ),
    lights=LightSettings(
        count=(1, 8),
        total_emission=(2500.0, 5000.0),
        scale=(2.0, 2.5),
        distance=(2.1, 2.7),
        target_jitter=0.2,
        spacing=0.3,
        orientation="uniform",
        coloured_share=0.0,
        reflectance=0.0,
        num_inside=0,
    ),
    cameras=CameraSettings(
        distance=(1.5, 2.0),
        target_jitter=0.2,
        up_jitter=0.1,
        fov_deg=(30.0, 60.0),
        path="random",
        elevation_deg=None,
    ),
    views=ViewLaws(
        coverage_grid=32, min_coverage=0.02, min_lit=0.05, max_shell_back=0.1, min_depth=0.01
    ),
    skies=SkySettings(
        share=0.0,
        own_share=0.0,
        over_lamps_log=(0.05, 5.0),
        seen_share=0.0,
        maps=SkyMapSettings(
            families=("constant",),
            height=256,
            mean_radiance=(0.2, 2.0),
            coloured_share=0.1,
            sun_elevation_deg=(2.0, 75.0),
            sun_to_sky=(0.5, 8.0),
        ),
    ),
    excursions=(),
)
"""Scenes of the benchmark; the other published sets say what they change of it."""

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


def median_settings() -> SceneSettings:
    """Return scenes of two objects under four lights, every range at its middle."""
    rough = SCENES_V1.materials
    median_roughness = math.sqrt(math.prod(rough.roughness_log)) - rough.roughness_bias
    changes = {
        "families.shell.square_share": 1.0,
        "families.shell.scale": _point(1.175),
        "families.shell.shift": 0.0,
        "families.shell.raise_z": _point(0.1),
        "families.shell.tilt_deg": 0.0,
        "families.num_objects": (2, 2),
        "families.object_scale": _point(1.3),
        "max_triangles": 4096,
        "placement.overlap_share": 0.0,
        "materials.albedo_sum": _point(0.95),
        "materials.specular_ratio": _point(0.5),
        "materials.roughness_clip": _point(round(median_roughness, 4)),
        "lights.count": (4, 4),
        "lights.total_emission": _point(_MEDIAN_EMISSION),
        "lights.scale": _point(_MEDIAN_SIZE),
        "lights.distance": _point(2.4),
        "cameras.distance": _point(1.75),
        "cameras.fov_deg": _point(45.0),
    }
    return apply_overrides(SCENES_V1, changes)


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


def out_of_range_settings(*, has_maps: bool = False) -> SceneSettings:
    """Return the median scenes with every excursion; a whole turn is 37 values of nine axes.

    With maps these are followed by what came later: 12 values of five axes.
    """
    excursions = tuple(
        Excursion(axis=axis, value=value, changes=tuple(changes(value).items()))
        for axis, values, changes in (_AXES + _AXES_OF_MAPS if has_maps else _AXES)
        for value in values
    )
    return dataclasses.replace(median_settings(), excursions=excursions)


def _point(value: float) -> Range:
    return (value, value)
