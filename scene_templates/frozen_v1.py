"""Scene settings of the published sets, with every number stated.

A frozen set asks no list of families or layouts and takes no default: those may change, and sets
that networks are compared on may not. Test: tests/pipeline/presets/test_registry.py. The
layouts that are named here are frozen with it; another `plane` is registered under another name.
"""

from scene_templates.families import Family
from scene_templates.placement import PlacementSettings
from scene_templates.rooms import SharedRoom
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.scene_maps import TextureSettings
from scene_templates.settings import SceneSettings, ViewLaws
from scene_templates.skies.procedural_skies import SkyMapSettings, SkySettings
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings

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
