"""Frozen preset settings of the published sets, all numbers stated: no default may change them.

See scene_templates.frozen_v1. A preset for training may change in later versions; these may not, so
they use no settings that do. Presets for judging are for the evaluation of networks, never for
training: all their scenes belong to `test`. Their pictures are stored without loss: there are few,
and all figures are measured against them.

The presets `renderformer-...` have RenderFormer V1's distribution, as far as known and in accord
with itself. Every number of the published recipes that is known stands in the settings (reference:
renderformer.md, A.1 to A.9), and so in the manifest of every dataset. What is not known, or cannot
be meant, with what is done here:

- **Templates.** That 21 and 14 families map to four layouts, and their weights, is known; a few
  object sizes, counts and lists are not (`scene_templates.renderformer_v1` names each).
- **Triangles.** The recipes cap each object at 1188 and 3968 faces, while the loader pads scenes to
  1572 and 4192: three objects do not fit, and the public loader fails on them. Here the whole scene
  keeps within the padding; objects are drawn among those that fit, and take the finest levels that
  do (`enough_error` 0), of at most 1188 and 3968 faces.
- **Meshes.** Published objects were voxelised to be watertight and decimated by tools that are not
  recoverable. Here they are cleaned and decimated by our own stage, which keeps open surfaces open.
- **Light and camera shells.** The corner's light shell and the azimuths of most cameras are known;
  the light shells of the other layouts are not: ours (`scene_templates.templates`).
- **Colours** pass through 8-bit vertex colours there, truncated, and are decoded as sRGB by one of
  two readers; here they are linear floats everywhere.
- **Seeds**, lists of objects, and the number of scenes are lost.
- **Pictures.** Cycles at 4096 samples with a denoiser; here Mitsuba, until the measured floor
  is reached or at the same number of samples.

The `-original` presets have the background policy from before the authors' repair: squares hardly
turn in their plane, so that the diagonals of floor and walls run one way.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

from pipeline.assets.settings import AssetSettings, GateSettings, OwnMaterialSettings
from pipeline.objects.generated import BENCHMARK
from pipeline.presets.settings import DatasetPreset, DatasetSettings
from pipeline.renders.settings import RenderSettings
from scene_templates.families import Family
from scene_templates.frozen_v1 import SCENES_V1, out_of_range_settings
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from storage.dataset.settings import SplitSettings, StorageSettings
from storage.settings.overrides import apply_overrides

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

_JUDGING = {
    "splits.scenes_per_shard": 20,
    "splits.shards_per_cycle": 8,
    "splits.held_out_objects": 0.125,
    "splits.one_split": True,
    "storage.profile": "lossless",
}
"""Settings of sets whose scenes all belong to the split `test`, by dotted name."""


def out_of_range() -> DatasetSettings:
    """Scenes with one axis beyond the trained range: 37 values of nine axes in four layouts."""
    changes = {
        **_JUDGING,
        "build": "out-of-range",
        "assets.budgets": [3900, 2600, 1700, 1100, 700, 400],
        # Lights of a hundredth of the area: a view is black where it is a thousand times darker.
        "renders.max_spp": 2048,
        "renders.min_mean_radiance": 1e-5,
        "splits.scenes_per_shard": 37,
    }
    scenes = out_of_range_settings()
    return dataclasses.replace(apply_overrides(SETTINGS_V1, changes), scenes=scenes)


def out_of_range_2() -> DatasetSettings:
    """`out-of-range` with twelve more values: five axes of textures and skies.

    It is another set: the first nine axes have the same distribution, and different scenes.
    """
    changes = {"build": "out-of-range-2", "splits.scenes_per_shard": 49}
    scenes = out_of_range_settings(has_maps=True)
    return dataclasses.replace(apply_overrides(out_of_range(), changes), scenes=scenes)


def benchmark_v1() -> DatasetSettings:
    """200 frozen scenes, 50 of each layout, one view each, to 48 dB or 2048 samples.

    The settings, the seed and the built-in objects are frozen: every run gives the same scenes
    (their digest is below, and in docs/reference). For the second resolution use
    `--resolution 512`.
    """
    changes = {
        **_JUDGING,
        "build": "benchmark-v1",
        "seed": 20261121,
        "source": BENCHMARK,
        "renders.noise_floor_db": 48.0,
        "renders.max_spp": 2048,
    }
    return apply_overrides(SETTINGS_V1, changes)


PRESETS_FOR_JUDGING = {
    "out-of-range": DatasetPreset(settings=out_of_range, num_scenes=148, device="cpu"),
    "out-of-range-2": DatasetPreset(settings=out_of_range_2, num_scenes=196, device="cpu"),
    "benchmark-v1": DatasetPreset(
        settings=benchmark_v1,
        num_scenes=200,
        device="cpu",
        scene_digest="5c77fcc0c9a5cb2859a0433befce8ae15d7cd4ad6fd26b8775494fde4fd8c14f",
    ),
    "benchmark-v1-mini": DatasetPreset(
        settings=benchmark_v1,
        num_scenes=20,
        device="cpu",
        scene_digest="c2d2baa3de32b89bc0b1eca3588ffe9d841ec5881879cf97bc69340abb3ebc49",
    ),
}
"""`out-of-range` counts 37 values times four layouts, its second version 49; the mini is the
beginning of the other, and grows into it with more `--scenes`."""

_PUBLISHED_SCENES = {
    "scenes.families_in_turn": False,
    "scenes.enough_error": 0.0,
    "scenes.centring": "vertex_mean",
    "scenes.num_views": 4,
    "scenes.placement.orientation": "euler",
    "scenes.placement.resting_share": 0.0,
    "scenes.placement.overlap_share": 1.0,
    "scenes.placement.inside": False,
    "scenes.materials.triangle_colours_share": 0.0,
    "scenes.lights.orientation": "euler",
    "scenes.lights.reflectance": 1.0,
    "scenes.views.min_coverage": 0.0,
    "scenes.views.min_lit": 0.0,
    "scenes.views.max_shell_back": 1.0,
}


def renderformer_v1_256(policy: Policy) -> DatasetSettings:
    """The published first stage: 21 families, 256 pixels, at most 1572 triangles."""
    changes = {
        "assets.budgets": [1188, 840, 594, 396, 297, 198],
        "scenes.max_triangles": 1572,
    }
    return _settings_of_stage("renderformer-v1-256", policy, stage_1_families(policy), changes)


def renderformer_v1_512(policy: Policy) -> DatasetSettings:
    """The published second stage: 14 families, 512 pixels, at most 4192 triangles."""
    changes = {
        "assets.budgets": [3968, 2380, 1188, 840, 594, 396],
        "scenes.max_triangles": 4192,
        "renders.resolution": 512,
        "splits.scenes_per_shard": 64,
    }
    return _settings_of_stage("renderformer-v1-512", policy, stage_2_families(policy), changes)


def _settings_of_stage(
    name: str, policy: Policy, families: tuple[Family, ...], changes: Mapping[str, Any]
) -> DatasetSettings:
    build = {"build": f"{name}-original" if policy == "original" else name}
    settings = apply_overrides(SETTINGS_V1, {**build, **_PUBLISHED_SCENES, **changes})
    scenes = dataclasses.replace(settings.scenes, families=families)
    return dataclasses.replace(settings, scenes=scenes)


_POLICIES: Mapping[str, Policy] = {"": "de-biased", "-original": "original"}
RENDERFORMER_PRESETS = {
    f"renderformer-v1-{width}{suffix}": DatasetPreset(
        settings=functools.partial(stage, policy), num_scenes=num_scenes, device="cpu"
    )
    for suffix, policy in _POLICIES.items()
    for width, stage, num_scenes in (
        (256, renderformer_v1_256, 65_536),
        (512, renderformer_v1_512, 16_384),
    )
}
