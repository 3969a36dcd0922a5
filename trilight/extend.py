"""What files of your own are made of that add a template, a build, a source or a metric.

A file of a user's imports from `trilight` alone: the packages behind it have other names in a
checkout than in an installed wheel. What has a table (TEMPLATES, BUILDS, METRICS ...) is added with
`TABLE.register(name, entry)`; docs/how-to has a page for each, examples/ a file. A module is loaded
when one of its names is asked for: a template needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from storage.installation import module_name

if TYPE_CHECKING:
    from model.config import SIZES as SIZES
    from model.config import ModelConfig as ModelConfig
    from pipeline.assets.settings import AssetSettings as AssetSettings
    from pipeline.flows.builds import BUILDS as BUILDS
    from pipeline.flows.builds import named_build as named_build
    from pipeline.flows.dataset_run import Outcome as Outcome
    from pipeline.flows.dataset_run import make_dataset as make_dataset
    from pipeline.flows.dataset_run import prepare_dataset as prepare_dataset
    from pipeline.flows.executors import EXECUTORS as EXECUTORS
    from pipeline.flows.executors import Executor as Executor
    from pipeline.flows.order import DatasetOrder as DatasetOrder
    from pipeline.flows.order_words import generate_words as generate_words
    from pipeline.flows.runners import ThreadRunner as ThreadRunner
    from pipeline.flows.scene_formats import FORMATS as FORMATS
    from pipeline.flows.scene_formats import LoadedScene as LoadedScene
    from pipeline.flows.scene_formats import Pictures as Pictures
    from pipeline.flows.scene_formats import SceneFormat as SceneFormat
    from pipeline.flows.scene_formats import SceneSource as SceneSource
    from pipeline.flows.settings import BuildSettings as BuildSettings
    from pipeline.flows.settings import NamedBuild as NamedBuild
    from pipeline.objects.listing import Listing as Listing
    from pipeline.objects.registry import SOURCES as SOURCES
    from pipeline.objects.registry import ObjectSource as ObjectSource
    from pipeline.objects.registry import SourceQuery as SourceQuery
    from pipeline.renders.settings import RenderSettings as RenderSettings
    from scene_templates.contents.lights import LightSettings as LightSettings
    from scene_templates.families.default_families import FAMILIES as FAMILIES
    from scene_templates.families.family import Family as Family
    from scene_templates.settings import SceneSettings as SceneSettings
    from scene_templates.shell.rooms import SharedRoom as SharedRoom
    from scene_templates.shell.separate_sides import SeparateSides as SeparateSides
    from scene_templates.shell.separate_sides import SideRanges as SideRanges
    from scene_templates.templates.registry import TEMPLATES as TEMPLATES
    from scene_templates.templates.sectors import Sector as Sector
    from scene_templates.templates.template import Template as Template
    from storage.atomic import write_atomically as write_atomically
    from storage.changes import changed as changed
    from storage.dataset_settings import SplitSettings as SplitSettings
    from storage.dataset_settings import StorageSettings as StorageSettings
    from storage.errors import TrilightError as TrilightError
    from storage.extensions import load_extension as load_extension
    from storage.material import COLUMNS as COLUMNS
    from storage.material import EMISSION as EMISSION
    from storage.material import MaterialColumn as MaterialColumn
    from storage.ply import encode_ply as encode_ply
    from storage.ranges import Within as Within
    from storage.records import Failure as Failure
    from storage.records import ObjectRecord as ObjectRecord
    from storage.scene import Scene as Scene
    from storage.scene import SceneObject as SceneObject
    from storage.seeds import rng_for as rng_for
    from storage.settings import checked as checked
    from train.evaluation.metrics import METRICS as METRICS
    from train.evaluation.metrics import JudgedPicture as JudgedPicture
    from train.evaluation.metrics import Metric as Metric
    from train.runs import RUNS as RUNS
    from train.runs import changed_run as changed_run
    from train.runs import named_run as named_run
    from train.settings import TrainSettings as TrainSettings

_NAMES = {
    "model.config": "ModelConfig SIZES",
    "pipeline.assets.settings": "AssetSettings",
    "pipeline.flows.builds": "BUILDS named_build",
    "pipeline.flows.dataset_run": "Outcome make_dataset prepare_dataset",
    "pipeline.flows.executors": "EXECUTORS Executor",
    "pipeline.flows.order": "DatasetOrder",
    "pipeline.flows.order_words": "generate_words",
    "pipeline.flows.runners": "ThreadRunner",
    "pipeline.flows.scene_formats": "FORMATS LoadedScene Pictures SceneFormat SceneSource",
    "pipeline.flows.settings": "BuildSettings NamedBuild",
    "pipeline.objects.listing": "Listing",
    "pipeline.objects.registry": "SourceQuery ObjectSource SOURCES",
    "pipeline.renders.settings": "RenderSettings",
    "scene_templates.contents.lights": "LightSettings",
    "scene_templates.families.default_families": "FAMILIES",
    "scene_templates.families.family": "Family",
    "scene_templates.settings": "SceneSettings",
    "scene_templates.shell.rooms": "SharedRoom",
    "scene_templates.shell.separate_sides": "SeparateSides SideRanges",
    "scene_templates.templates.registry": "TEMPLATES",
    "scene_templates.templates.sectors": "Sector",
    "scene_templates.templates.template": "Template",
    "storage.atomic": "write_atomically",
    "storage.changes": "changed",
    "storage.dataset_settings": "SplitSettings StorageSettings",
    "storage.errors": "TrilightError",
    "storage.extensions": "load_extension",
    "storage.material": "COLUMNS EMISSION MaterialColumn",
    "storage.ply": "encode_ply",
    "storage.ranges": "Within",
    "storage.records": "Failure ObjectRecord",
    "storage.scene": "Scene SceneObject",
    "storage.seeds": "rng_for",
    "storage.settings": "checked",
    "train.evaluation.metrics": "JudgedPicture METRICS Metric",
    "train.runs": "RUNS changed_run named_run",
    "train.settings": "TrainSettings",
}
"""What there is, by the module that has it."""
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(module_name(_HOME[name])), name)


def __dir__() -> list[str]:
    return list(__all__)
