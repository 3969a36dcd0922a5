"""For those who add a template, a build or a run of their own: what these are made of.

A file of a user's imports from `trilight` alone: the packages behind it have other names in a
checkout than in an installed wheel.
"""

from model.config import ModelConfig
from pipeline.assets.settings import AssetSettings
from pipeline.flows.builds import named_build
from pipeline.flows.settings import BuildSettings, NamedBuild
from pipeline.renders.settings import RenderSettings
from scene_templates.families.family import Family
from scene_templates.settings import SceneSettings
from scene_templates.shell.rooms import SharedRoom
from scene_templates.shell.separate_sides import SeparateSides
from scene_templates.templates.sectors import Sector
from scene_templates.templates.template import Template
from storage.errors import TrilightError
from storage.profiles import StorageSettings
from storage.ranges import Within, check_ranges
from storage.scene import Scene, SceneObject
from storage.seeds import rng_for
from storage.splits import SplitSettings
from train.runs import changed_run, named_run
from train.settings import TrainSettings

__all__ = [
    "AssetSettings",
    "BuildSettings",
    "Family",
    "ModelConfig",
    "NamedBuild",
    "RenderSettings",
    "Scene",
    "SceneObject",
    "SceneSettings",
    "Sector",
    "SeparateSides",
    "SharedRoom",
    "SplitSettings",
    "StorageSettings",
    "Template",
    "TrainSettings",
    "TrilightError",
    "Within",
    "changed_run",
    "check_ranges",
    "named_build",
    "named_run",
    "rng_for",
]
