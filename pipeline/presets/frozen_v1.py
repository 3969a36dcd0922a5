"""Frozen preset settings of the published sets, all numbers stated: no default may change them.

See scene_templates.frozen_v1. A preset for training may change in later versions; these may not, so
they use no settings that do.
"""

from pipeline.assets.settings import AssetSettings, GateSettings, OwnMaterialSettings
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.settings import RenderSettings
from scene_templates.frozen_v1 import SCENES_V1
from storage.dataset.settings import SplitSettings, StorageSettings

_LICENCES = (
    "CC0-1.0",
    "CC-PDDC",
    "PDDL-1.0",
    "Unlicense",
    "CC-BY-2.0",
    "CC-BY-2.5",
    "CC-BY-3.0",
    "CC-BY-4.0",
    "CC-BY-SA-3.0",
    "CC-BY-SA-4.0",
    "ODC-By-1.0",
    "MIT",
    "MIT-0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "Apache-2.0",
    "LicenseRef-user-provided",
)

SETTINGS_V1 = DatasetSettings(
    build="v1",
    seed=0,
    source=None,
    allowed_licences=_LICENCES,
    assets=AssetSettings(
        profile="faithful",
        decimator="pymeshlab",
        budgets=(1400, 1000, 700, 500, 340, 240),
        epsilon=None,
        watertight=False,
        gate=GateSettings(
            max_error_p99=0.03,
            max_outside=0.01,
            area_ratio=(0.75, 1.25),
            max_normal_error_deg=35.0,
            min_silhouette_iou=0.9,
            max_lost_area=0.01,
        ),
        max_source_bytes=200_000_000,
        max_source_faces=1_500_000,
        max_instances=10_000,
        own_materials=OwnMaterialSettings(
            keep=False,
            texels=256,
            size=512,
            max_pixels=67_108_864,
            max_colour_error=0.05,
            max_missed=0.1,
            emission=False,
            normal_maps=False,
            transmission="opaque",
            if_lost="drawn",
        ),
    ),
    scenes=SCENES_V1,
    renders=RenderSettings(
        resolution=256,
        noise_floor_db=46.0,
        noise_floor_linear_db=None,
        noise_floor_objects_db=None,
        min_spp=32,
        max_spp=4096,
        reject_at_cap=False,
        max_depth=10,
        rr_depth=2,
        aux_spp=64,
        denoiser="high",
        min_mean_radiance=0.01,
        per_light=False,
        split=False,
        split_lobes=False,
        min_spp_px=128,
        light_paths="view",
        arithmetic="numpy",
        stated_error="bound",
        picture_within_db=None,
    ),
    splits=SplitSettings(
        scenes_per_shard=256,
        shards_per_cycle=64,
        held_out_objects=0.02,
        one_split=False,
        listed_scenes=None,
        listed_shards=(),
    ),
    storage=StorageSettings(profile="compact", passes=()),
    revisit=None,
)
"""Common settings of the published sets; each set states its changes."""

JUDGING_SPLITS = SplitSettings(
    scenes_per_shard=20,
    shards_per_cycle=8,
    held_out_objects=0.125,
    one_split=True,
    listed_scenes=None,
    listed_shards=(),
)
"""Split settings of sets whose scenes all belong to the split `test`."""
