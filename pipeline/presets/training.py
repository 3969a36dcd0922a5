"""Dataset presets for the training of networks: `smoke`, `pretrain-256`, `finetune-512` and others.

They keep the published ranges of sizes, materials, lights and cameras, and deviate where the
published scenes have defects (reference: renderformer.md, G):

- floor and walls are one room whose seams are closed, instead of squares placed each by itself:
  light leaks through gaps; half of the rooms are exact, which takes the place of the `patch`
  families;
- one range of floor heights for all layouts: a fixed height can be learnt;
- rotations are uniform on SO(3): Euler angles prefer the poles;
- half of the objects rest on the floor and half float, clear of walls and of each other, but for
  one scene in ten whose objects may overlap: most real objects do not interpenetrate;
- an object's centre is the middle of its bounding box: the mean of its vertices moves when the
  mesh is made coarser;
- views of nothing, of unlit things and of walls from behind are replaced: they teach nothing; nor
  are there scenes without objects;
- one budget for each scene, spent by error, instead of one for each object, which overflows;
- colours are linear floats, where one number means one albedo; a colour for each triangle or for
  each shading group is equally likely, as the paper says and the code does not do;
- emitters reflect nothing: what shines at 300 need not.
"""

import dataclasses

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.presets.settings import DatasetPreset, DatasetSettings
from pipeline.renders.settings import CALIBRATED_LOOKS, RenderSettings
from scene_templates.families import DEFAULT_FAMILIES, alone
from scene_templates.placement import PlacementSettings
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.settings import SceneSettings, ViewLaws
from scene_templates.skies.procedural_skies import SkyMapSettings, SkySettings
from storage.dataset.settings import SplitSettings
from storage.settings.overrides import apply_overrides


def smoke() -> DatasetSettings:
    """A set of minutes on a laptop: small shards, 256 pixels, pictures to 38 dB or 256 samples."""
    return DatasetSettings(
        build="smoke",
        seed=0,
        allowed_licences=DEFAULT_ALLOWED,
        assets=AssetSettings(budgets=(1400, 1000, 700, 500, 340, 240)),
        scenes=SceneSettings(families=DEFAULT_FAMILIES, max_triangles=1536, num_views=4),
        renders=RenderSettings(
            resolution=256,
            noise_floor_db=38.0,
            max_spp=256,
            light_paths="scene",
            arithmetic="device",
            **CALIBRATED_LOOKS,
        ),
        splits=SplitSettings(scenes_per_shard=4),
    )


def pretrain_256() -> DatasetSettings:
    """The first training stage: 256 pixels, up to 1536 triangles, pictures to 46 dB."""
    changes = {
        "build": "pretrain-256",
        "assets.decimator": "libigl",
        "renders.noise_floor_db": 46.0,
        "renders.max_spp": 4096,
        "renders.aux_spp": 64,
        "splits.scenes_per_shard": 256,
        "splits.shards_per_cycle": 64,
        "splits.held_out_objects": 0.02,
    }
    return apply_overrides(smoke(), changes)


def finetune_512() -> DatasetSettings:
    """The second training stage: 512 pixels, up to 4096 triangles, pictures to 46 dB."""
    changes = {
        "build": "finetune-512",
        "assets.budgets": [3900, 2600, 1700, 1100, 700, 400],
        "scenes.max_triangles": 4096,
        "scenes.enough_error": 0.0025,
        "renders.resolution": 512,
        "splits.scenes_per_shard": 64,
    }
    return apply_overrides(pretrain_256(), changes)


def textured_256() -> DatasetSettings:
    """`pretrain-256` with procedural textures on half of the objects, floors and walls."""
    return apply_overrides(pretrain_256(), {"build": "textured-256", "scenes.textures.share": 0.5})


def sky_256() -> DatasetSettings:
    """Scenes of `pretrain-256`, three in four below a sky as well."""
    return apply_overrides(pretrain_256(), {"build": "sky-256", "scenes.skies.share": 0.75})


def object_views() -> DatasetSettings:
    """One object with its own materials and normal maps, alone below a sky: 24 views, 38 dB."""
    base = smoke()
    return dataclasses.replace(
        base,
        build="object-views",
        assets=AssetSettings(
            budgets=(16_384, 8_192, 4_096, 2_048, 1_024, 512),
            own_materials=OwnMaterialSettings(normal_maps=True),
        ),
        scenes=SceneSettings(
            families=(alone(),),
            max_triangles=16_384,
            enough_error=0.001,
            num_views=24,
            placement=PlacementSettings(orientation="kept", overlap_share=0.0),
            materials=MaterialSettings(source="object"),
            lights=LightSettings(count=(0, 0)),
            # An object of radius 0.5 fills nine tenths of the width of its pictures.
            cameras=CameraSettings(
                distance=(1.6, 1.6),
                target_jitter=0.0,
                up_jitter=0.0,
                fov_deg=(40.0, 40.0),
                path="fibonacci",
            ),
            # Its views are the stated ones, whatever is seen from there.
            views=ViewLaws(min_coverage=0.0, min_lit=0.0, max_shell_back=1.0),
            skies=SkySettings(
                share=1.0, over_lamps_log=(0.5, 2.0), maps=SkyMapSettings(height=128)
            ),
        ),
        renders=dataclasses.replace(
            base.renders,
            resolution=512,
            noise_floor_db=None,
            noise_floor_objects_db=38.0,
            max_spp=1024,
            min_mean_radiance=0.0,
        ),
        splits=SplitSettings(scenes_per_shard=16, shards_per_cycle=64, held_out_objects=0.02),
    )


def olat() -> DatasetSettings:
    """One light at a time: rooms with 2 to 6 lamps, half of them below a sky too, each light alone.

    Lamps are white, so that a reader colors them.
    """
    changes = {
        "build": "olat",
        "scenes.lights.count": [2, 6],
        "scenes.skies.share": 0.5,
        "renders.noise_floor_db": 42.0,
        "renders.max_spp": 1024,
        "renders.per_light": True,
        "splits.scenes_per_shard": 64,
    }
    return apply_overrides(pretrain_256(), changes)


PRESETS_FOR_TRAINING = {
    "smoke": DatasetPreset(settings=smoke, num_scenes=24, device="cpu"),
    "pretrain-256": DatasetPreset(settings=pretrain_256, num_scenes=65_536),
    "finetune-512": DatasetPreset(settings=finetune_512, num_scenes=16_384),
    "textured-256": DatasetPreset(settings=textured_256, num_scenes=16_384),
    "sky-256": DatasetPreset(settings=sky_256, num_scenes=65_536),
    "olat": DatasetPreset(settings=olat, num_scenes=2_048),
    "object-views": DatasetPreset(settings=object_views, num_scenes=1_024),
}
