"""Building blocks of extensions: templates, presets, sources and metrics.

An extension imports from `trilight` alone, because the packages behind it have other names in a
checkout than in an installed wheel. Entries of a table (TEMPLATES, METRICS ...) are added with
`TABLE.register(name, entry)`; docs/how-to has a page and examples/ a file for each table. A module
is loaded when one of its names is first used, so a template needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from trilight.lazy import offered_names

if TYPE_CHECKING:
    from model.config import SIZES as SIZES
    from model.config import ModelConfig as ModelConfig
    from pipeline.assets.settings import AssetSettings as AssetSettings
    from pipeline.exchange.formats import FORMATS as FORMATS
    from pipeline.exchange.formats import LoadedScene as LoadedScene
    from pipeline.exchange.formats import Pictures as Pictures
    from pipeline.exchange.formats import SceneFormat as SceneFormat
    from pipeline.exchange.formats import SceneSource as SceneSource
    from pipeline.executors.registry import EXECUTORS as EXECUTORS
    from pipeline.executors.registry import Executor as Executor
    from pipeline.executors.threads import ThreadRunner as ThreadRunner
    from pipeline.generation.generate_options import GenerateOptions as GenerateOptions
    from pipeline.generation.generate_options import generate_words as generate_words
    from pipeline.generation.generation_run import Outcome as Outcome
    from pipeline.generation.generation_run import Runner as Runner
    from pipeline.generation.pipeline import make_dataset as make_dataset
    from pipeline.generation.pipeline import prepare_dataset as prepare_dataset
    from pipeline.objects.generated import encode_ply as encode_ply
    from pipeline.objects.listing import Listing as Listing
    from pipeline.objects.sources import SOURCES as SOURCES
    from pipeline.objects.sources import ObjectSource as ObjectSource
    from pipeline.objects.sources import SourceQuery as SourceQuery
    from pipeline.presets.registry import DATASET_PRESETS as DATASET_PRESETS
    from pipeline.presets.registry import preset_settings as preset_settings
    from pipeline.presets.settings import DatasetPreset as DatasetPreset
    from pipeline.presets.settings import DatasetSettings as DatasetSettings
    from pipeline.renders.settings import RenderSettings as RenderSettings
    from scene_templates.families import FAMILIES as FAMILIES
    from scene_templates.families import Family as Family
    from scene_templates.rooms import SeparateSides as SeparateSides
    from scene_templates.rooms import SharedRoom as SharedRoom
    from scene_templates.rooms import SideRanges as SideRanges
    from scene_templates.sample_camera import Sector as Sector
    from scene_templates.sample_lights import LightSettings as LightSettings
    from scene_templates.settings import SceneSettings as SceneSettings
    from scene_templates.skies.procedural_skies import SKIES as SKIES
    from scene_templates.skies.procedural_skies import SkyDraws as SkyDraws
    from scene_templates.skies.procedural_skies import SkyTexels as SkyTexels
    from scene_templates.surfaces.maps import Finish as Finish
    from scene_templates.surfaces.maps import SurfaceDraws as SurfaceDraws
    from scene_templates.surfaces.maps import Texels as Texels
    from scene_templates.surfaces.procedural_textures import SURFACES as SURFACES
    from scene_templates.templates import TEMPLATES as TEMPLATES
    from scene_templates.templates import Template as Template
    from storage.atomic import write_atomically as write_atomically
    from storage.dataset.settings import SplitSettings as SplitSettings
    from storage.dataset.settings import StorageSettings as StorageSettings
    from storage.errors import TrilightError as TrilightError
    from storage.extensions import load_extension as load_extension
    from storage.records.material import COLUMNS as COLUMNS
    from storage.records.material import EMISSION as EMISSION
    from storage.records.material import MaterialColumn as MaterialColumn
    from storage.records.objects import Failure as Failure
    from storage.records.objects import ObjectRecord as ObjectRecord
    from storage.records.scene import Scene as Scene
    from storage.records.scene import SceneObject as SceneObject
    from storage.seeds import rng_for as rng_for
    from storage.settings.described import checked as checked
    from storage.settings.overrides import apply_overrides as apply_overrides
    from storage.settings.ranges import Within as Within
    from train.evaluation.metrics import METRICS as METRICS
    from train.evaluation.metrics import JudgedPicture as JudgedPicture
    from train.evaluation.metrics import Metric as Metric
    from train.presets import TRAINING_PRESETS as TRAINING_PRESETS
    from train.presets import override_training_preset as override_training_preset
    from train.presets import training_preset as training_preset
    from train.settings import TrainSettings as TrainSettings

_HOME = offered_names(__file__)

__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, name_there = _HOME[name]
    return getattr(import_module(module), name_there)


def __dir__() -> list[str]:
    return list(__all__)
