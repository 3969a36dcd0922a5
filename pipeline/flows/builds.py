"""The named builds: each a function that returns the full settings of a dataset."""

import dataclasses
from collections.abc import Callable, Mapping

from pipeline.assets.settings import AssetSettings
from pipeline.flows.settings import BuildSettings
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.renders.settings import RenderSettings
from scene_templates.settings import SceneSettings
from storage.errors import TrilightError
from storage.splits import SplitSettings


def smoke() -> BuildSettings:
    """Minutes on a laptop: small shards, 256 pixels, pictures to 40 dB or 256 samples."""
    return BuildSettings(
        build="smoke",
        seed=0,
        allowed_licences=DEFAULT_ALLOWED,
        assets=AssetSettings(budgets=(1400, 1000, 700, 500, 340, 240)),
        scenes=SceneSettings(max_triangles=1536, num_views=4),
        renders=RenderSettings(resolution=256, noise_floor_db=40.0, min_spp=128, max_spp=256),
        splits=SplitSettings(scenes_per_shard=4),
    )


def pretrain_256() -> BuildSettings:
    """The first training stage: 256 pixels, up to 1536 triangles, pictures to 46 dB."""
    build = smoke()
    return dataclasses.replace(
        build,
        build="pretrain-256",
        renders=dataclasses.replace(build.renders, noise_floor_db=46.0, max_spp=4096),
        splits=SplitSettings(scenes_per_shard=256, shards_per_cycle=64, held_out_objects=0.02),
    )


def finetune_512() -> BuildSettings:
    """The second training stage: 512 pixels, up to 4096 triangles, pictures to 46 dB."""
    build = pretrain_256()
    return dataclasses.replace(
        build,
        build="finetune-512",
        assets=dataclasses.replace(build.assets, budgets=(3900, 2600, 1700, 1100, 700, 400)),
        scenes=dataclasses.replace(build.scenes, max_triangles=4096),
        renders=dataclasses.replace(build.renders, resolution=512),
        splits=dataclasses.replace(build.splits, scenes_per_shard=64),
    )


BUILDS: Mapping[str, Callable[[], BuildSettings]] = {
    "smoke": smoke,
    "pretrain-256": pretrain_256,
    "finetune-512": finetune_512,
}


def named_build(
    name: str,
    *,
    seed: int | None = None,
    resolution: int | None = None,
    noise_floor_db: float | None = None,
    allow_licences: tuple[str, ...] = (),
) -> BuildSettings:
    """Return the settings of a build with what the caller wants otherwise.

    Args:
        name: one of BUILDS.
        seed, resolution, noise_floor_db: replace the build's value where not None.
        allow_licences: allowed in addition to the build's.

    Raises:
        TrilightError: an unknown name, or values that contradict each other.
    """
    if name not in BUILDS:
        raise TrilightError(f"build {name!r} is unknown; expected one of {', '.join(BUILDS)}.")
    build = BUILDS[name]()
    renders = build.renders
    if resolution is not None:
        renders = dataclasses.replace(renders, resolution=resolution)
    if noise_floor_db is not None:
        renders = dataclasses.replace(renders, noise_floor_db=noise_floor_db)
    licences = tuple(sorted({*build.allowed_licences, *allow_licences}))
    return dataclasses.replace(
        build,
        seed=build.seed if seed is None else seed,
        renders=renders,
        allowed_licences=licences,
    )
