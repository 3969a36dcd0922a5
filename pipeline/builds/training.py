"""Builds for the training of networks: `smoke`, `pretrain-256`, `finetune-512` and others.

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

from pipeline.assets.settings import AssetSettings
from pipeline.builds.settings import BuildSettings, NamedBuild
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.renders.settings import RenderSettings
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from scene_templates.skies.settings import SkySettings
from scene_templates.textures import TextureSettings
from storage.dataset.settings import SplitSettings


def smoke() -> BuildSettings:
    """A set of minutes on a laptop: small shards, 256 pixels, pictures to 38 dB or 256 samples."""
    return BuildSettings(
        build="smoke",
        seed=0,
        allowed_licences=DEFAULT_ALLOWED,
        assets=AssetSettings(budgets=(1400, 1000, 700, 500, 340, 240)),
        scenes=SceneSettings(families=DEFAULT_FAMILIES, max_triangles=1536, num_views=4),
        renders=RenderSettings(
            resolution=256,
            noise_floor_db=38.0,
            min_spp=32,
            min_spp_px=256,
            max_spp=256,
            light_paths="scene",
            arithmetic="device",
            stated_error="calibrated",
            picture_within_db=2.0,
        ),
        splits=SplitSettings(scenes_per_shard=4),
    )


def pretrain_256() -> BuildSettings:
    """The first training stage: 256 pixels, up to 1536 triangles, pictures to 46 dB."""
    build = smoke()
    return dataclasses.replace(
        build,
        build="pretrain-256",
        renders=dataclasses.replace(build.renders, noise_floor_db=46.0, max_spp=4096, aux_spp=64),
        splits=SplitSettings(scenes_per_shard=256, shards_per_cycle=64, held_out_objects=0.02),
    )


def finetune_512() -> BuildSettings:
    """The second training stage: 512 pixels, up to 4096 triangles, pictures to 46 dB."""
    build = pretrain_256()
    return dataclasses.replace(
        build,
        build="finetune-512",
        assets=dataclasses.replace(build.assets, budgets=(3900, 2600, 1700, 1100, 700, 400)),
        scenes=dataclasses.replace(build.scenes, max_triangles=4096, enough_error=0.0025),
        renders=dataclasses.replace(build.renders, resolution=512),
        splits=dataclasses.replace(build.splits, scenes_per_shard=64),
    )


def textured_256() -> BuildSettings:
    """`pretrain-256` with procedural textures on half of the objects, floors and walls."""
    build = pretrain_256()
    return dataclasses.replace(
        build,
        build="textured-256",
        scenes=dataclasses.replace(build.scenes, textures=TextureSettings(share=0.5)),
    )


def sky_256() -> BuildSettings:
    """Scenes of `pretrain-256`, three in four below a sky as well."""
    build = pretrain_256()
    scenes = dataclasses.replace(build.scenes, skies=SkySettings(share=0.75))
    return dataclasses.replace(build, build="sky-256", scenes=scenes)


TRAINING_BUILDS = {
    "smoke": NamedBuild(settings=smoke, num_scenes=24, device="cpu"),
    "pretrain-256": NamedBuild(settings=pretrain_256, num_scenes=65_536),
    "finetune-512": NamedBuild(settings=finetune_512, num_scenes=16_384),
    "textured-256": NamedBuild(settings=textured_256, num_scenes=16_384),
    "sky-256": NamedBuild(settings=sky_256, num_scenes=65_536),
}
