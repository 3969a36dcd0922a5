"""Settings of every class, and what else must hold where a field stands at an end of its range.

The laws between fields are why: an end is reached by changing its neighbours too.
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

from infra.improve.order import ImproveOrder
from infra.leaderboard.order import LeaderboardOrder
from infra.rendering.request import Asked
from infra.serving.train_model import TrainOrder
from infra.setup.settings_page import ROOTS, reachable
from model.base_widths import BaseWidths
from model.config import ModelConfig, smoke, tiny
from pipeline.assets.settings import AssetSettings, GateSettings, OwnMaterialSettings
from pipeline.builds.named import named_build
from pipeline.builds.revisit import GivenCamera, RevisitSettings
from pipeline.builds.settings import BuildSettings
from pipeline.flows.orders import DatasetInRuns
from pipeline.making.price import CorePrice
from pipeline.making.revisit_order import Revisit
from pipeline.renders.settings import MAX_SPP, RenderSettings
from scene_templates.cameras import CameraSettings
from scene_templates.families import Family
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.lights import LightSettings
from scene_templates.materials import MaterialSettings
from scene_templates.placement import PlacementSettings
from scene_templates.rooms import SharedRoom
from scene_templates.separate_sides import SideRanges
from scene_templates.settings import MAX_TRIANGLES, Excursion, SceneSettings, ViewLaws
from scene_templates.skies.draw import SkyMapSettings
from scene_templates.skies.settings import SkySettings
from scene_templates.strata import Stratum
from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.textures import TextureSettings
from storage.dataset.settings import ListedShard, SplitSettings
from storage.records.scene import Scene
from storage.settings.ranges import Declared, declared_ranges
from train.evaluation.order import EvaluationOrder
from train.runs import named_run
from train.settings import AugmentationSettings, LossSettings, TrainSettings
from train.watching.settings import WatchSettings

End = Literal["low", "high"]

ASKED = Asked(
    source="a.json", out=Path("a.exr"), engine="mitsuba", checkpoint=None, resolution=64,
    noise_floor_db=40.0, max_spp=64, view=0, orbit=None, arc_deg=360.0, cameras=None, fps=24,
    tone_map="plain", exposure_ev=0.0, precision="float32", lights_per_pass=8,
    seed=0, threads=None,
)  # fmt: skip
SMOKE = named_build("smoke")
RUN = named_run("smoke")

EXAMPLES: dict[type, Any] = {
    DatasetInRuns: DatasetInRuns(),
    BuildSettings: SMOKE,
    AssetSettings: SMOKE.assets,
    GateSettings: SMOKE.assets.gate,
    OwnMaterialSettings: SMOKE.assets.own_materials,
    SceneSettings: SMOKE.scenes,
    Family: ONE_FAMILY_EACH[0],
    SharedRoom: SharedRoom(),
    SideRanges: SideRanges(),
    PlacementSettings: SMOKE.scenes.placement,
    MaterialSettings: SMOKE.scenes.materials,
    LightSettings: SMOKE.scenes.lights,
    CameraSettings: SMOKE.scenes.cameras,
    ViewLaws: SMOKE.scenes.views,
    TextureSettings: TextureSettings(),
    SurfaceMapSettings: SurfaceMapSettings(),
    SkySettings: SkySettings(),
    SkyMapSettings: SkyMapSettings(),
    Excursion: Excursion(axis="fov_deg", value=10.0, changes=()),
    Stratum: Stratum(name="all", weight=1.0, earlier_weights=(1.0,)),
    RenderSettings: SMOKE.renders,
    SplitSettings: SMOKE.splits,
    ListedShard: ListedShard(split="train", scenes=4),
    Revisit: Revisit(dataset="a", out="b"),
    RevisitSettings: RevisitSettings(source_digest="", kept_cameras=4, lights="new", num_lights=2),
    GivenCamera: GivenCamera(c2w=(0.0,) * 16, fov_deg=40.0),
    Asked: ASKED,
    CorePrice: CorePrice(),
    TrainOrder: TrainOrder(),
    ImproveOrder: ImproveOrder(),
    TrainSettings: RUN,
    ModelConfig: tiny(),
    LossSettings: RUN.loss,
    AugmentationSettings: RUN.augmentation,
    BaseWidths: RUN.base_widths,
    EvaluationOrder: EvaluationOrder(checkpoint="a", data=("b",)),
    LeaderboardOrder: LeaderboardOrder(source="a", width=(64,)),
    WatchSettings: WatchSettings(),
}  # fmt: skip
"""A valid value of every class that declares a range, but for `Scene`."""

_LINEAR = {"head": "linear", "dpt_features": 0, "dpt_channels": (), "dpt_taps": ()}
_HITS = {"view_stage": "hits", "hit_rays": 1, "hit_anchors": 8, "pixel_width": 8}
_PLANE = dataclasses.replace(ONE_FAMILY_EACH[0], num_objects=(0, 0), template="plane")
_EVERY = 10**9

BESIDE: dict[tuple[type, str, End], dict[str, Any]] = {
    (DatasetInRuns, "views", "low"): {"scenes_from": "a"},
    (DatasetInRuns, "views", "high"): {"scenes_from": "a"},
    (AssetSettings, "epsilon", "high"): {"gate": GateSettings(max_error_p99=1.0)},
    (SceneSettings, "max_triangles", "low"): {
        "families": (_PLANE,), "lights": LightSettings(count=(1, 1)),
    },
    (SceneSettings, "fill_to", "high"): {"max_triangles": MAX_TRIANGLES},
    (MaterialSettings, "roughness_log", "low"): {"roughness_bias": 0.0},
    (MaterialSettings, "roughness_bias", "high"): {"roughness_log": (1.0, 2.0)},
    (RevisitSettings, "kept_cameras", "low"): {"new_cameras": 1},
    (RevisitSettings, "new_cameras", "high"): {"kept_cameras": 0},
    (Asked, "seconds", "low"): {"noise_floor_db": None},
    (Asked, "seconds", "high"): {"noise_floor_db": None},
    (Asked, "error_db", "low"): {"noise_floor_db": None},
    (Asked, "error_db", "high"): {"noise_floor_db": None},
    (Asked, "spp", "low"): {"noise_floor_db": None},
    (Asked, "spp", "high"): {"noise_floor_db": None},
    (RenderSettings, "min_spp", "high"): {"max_spp": MAX_SPP},
    (RenderSettings, "max_spp", "low"): {"min_spp": 8},
    (TrainSettings, "resolution", "low"): {"model": dataclasses.replace(smoke(), patch_px=1)},
    (TrainSettings, "num_steps", "low"): {"warmup_steps": 0},
    (TrainSettings, "warmup_steps", "high"): {"num_steps": _EVERY},
    (TrainSettings, "log_every", "high"): {"validate_every": _EVERY, "checkpoint_every": _EVERY},
    (TrainSettings, "validate_every", "low"): {"log_every": 1},
    (TrainSettings, "checkpoint_every", "low"): {"log_every": 1},
    (ModelConfig, "width", "low"): {"num_heads": 1, "rope_num_freqs": 1},
    (ModelConfig, "width", "high"): {"num_heads": 512, "rope_num_freqs": 1},
    (ModelConfig, "num_heads", "high"): {"width": 512 * 18, "rope_num_freqs": 1},
    (ModelConfig, "rope_num_freqs", "high"): {"width": 18 * 64, "num_heads": 1},
    (ModelConfig, "decoder_layers", "low"): {"dpt_taps": (0, 0, 0, 0)},
    (ModelConfig, "patch_px", "low"): _LINEAR,
    (ModelConfig, "patch_px", "high"): _LINEAR,
    (ModelConfig, "dpt_features", "low"): _LINEAR,
    (ModelConfig, "dpt_taps", "high"): {"decoder_layers": 256},
    **{(ModelConfig, name, "high"): _LINEAR | _HITS
       for name in ("hit_rays", "hit_anchors", "gather_rays", "pixel_width", "filter_width",
                    "sky_rays")},
}  # fmt: skip
"""What must stand beside an end."""

FIELDS = [
    (settings, field)
    for settings in reachable(*(root for roots in ROOTS.values() for root in roots))
    if settings is not Scene
    for field in declared_ranges(settings)
]
"""Every declared range of settings."""


def with_number(example: Any, field: Declared, end: End, number: float) -> Any:
    """Return the value of a field with a number at one end of it, where it is several."""
    old = getattr(example, field.name)
    if field.shape == "one":
        return number
    if field.shape == "pair":
        return (number, old[1]) if end == "low" else (old[0], number)
    return (*old[:-1], number) if end == "low" else (number, *old[1:])


def at_end(settings: type, field: Declared, end: End, number: float) -> Any:
    """Return valid settings with one number of a field replaced; raises what they raise."""
    example = EXAMPLES[settings]
    changes = {field.name: with_number(example, field, end, number)}
    return dataclasses.replace(example, **(BESIDE.get((settings, field.name, end), {}) | changes))


SCENE_REASONS = ("no_room", "over_budget", "no_faces", "no_camera", "emitter_inside")
"""Why a room may not be possible."""
