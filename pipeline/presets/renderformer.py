"""Dataset presets: RenderFormer V1's distribution, as far as known and in accord with itself.

Every number of the published recipes that is known stands in the settings (reference:
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

from pipeline.presets.frozen_v1 import SETTINGS_V1
from pipeline.presets.settings import DatasetPreset, DatasetSettings
from scene_templates.families import Family
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from storage.settings.overrides import apply_overrides

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


def renderformer_v1_256(policy: Policy = "de-biased") -> DatasetSettings:
    """The published first stage: 21 families, 256 pixels, at most 1572 triangles."""
    changes = {
        "assets.budgets": [1188, 840, 594, 396, 297, 198],
        "scenes.max_triangles": 1572,
    }
    return _published("renderformer-v1-256", policy, stage_1_families(policy), changes)


def renderformer_v1_512(policy: Policy = "de-biased") -> DatasetSettings:
    """The published second stage: 14 families, 512 pixels, at most 4192 triangles."""
    changes = {
        "assets.budgets": [3968, 2380, 1188, 840, 594, 396],
        "scenes.max_triangles": 4192,
        "renders.resolution": 512,
        "splits.scenes_per_shard": 64,
    }
    return _published("renderformer-v1-512", policy, stage_2_families(policy), changes)


def _published(
    name: str, policy: Policy, families: tuple[Family, ...], changes: Mapping[str, Any]
) -> DatasetSettings:
    build = {"build": f"{name}-original" if policy == "original" else name}
    settings = apply_overrides(SETTINGS_V1, {**build, **_PUBLISHED_SCENES, **changes})
    scenes = dataclasses.replace(settings.scenes, families=families)
    return dataclasses.replace(settings, scenes=scenes)


RENDERFORMER_PRESETS = {
    "renderformer-v1-256": DatasetPreset(
        settings=renderformer_v1_256, num_scenes=65_536, device="cpu"
    ),
    "renderformer-v1-512": DatasetPreset(
        settings=renderformer_v1_512, num_scenes=16_384, device="cpu"
    ),
    "renderformer-v1-256-original": DatasetPreset(
        settings=functools.partial(renderformer_v1_256, "original"), num_scenes=65_536, device="cpu"
    ),
    "renderformer-v1-512-original": DatasetPreset(
        settings=functools.partial(renderformer_v1_512, "original"), num_scenes=16_384, device="cpu"
    ),
}
