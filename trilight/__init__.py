"""Trilight from Python: scenes, pictures, datasets, networks. See docs/reference/python.md.

    import trilight

    scene = trilight.read_scene("scene.usdz")
    picture = trilight.render(scene, noise_floor_db=35)
    print(picture.radiance_rgb.shape, picture.noise_floor_db)

Every name here is one of the packages' names. Modules load on first use: `import trilight` takes
milliseconds, and no torch, Mitsuba, USD or Prefect. Mistakes raise `TrilightError`, whose message
names the value, the expectation and a remedy.

World: meters, +Z up, right-handed; networks were trained on scenes within [-0.5, 0.5]^3. Colors
are linear with Rec.709 primaries. `trilight.extend` serves extensions: templates, presets.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from trilight.lazy import offered_names

if TYPE_CHECKING:
    from infra.judging import Judgement as Judgement
    from infra.judging import judge_network as judge_network
    from infra.judging import write_judgement as write_judgement
    from model.inference import NeuralRenderer as NeuralRenderer
    from pipeline.generation.generate_options import GenerateOptions as GenerateOptions
    from pipeline.generation.generation_run import Outcome as Outcome
    from pipeline.renders.renderer import RenderedView as RenderedView
    from storage.conventions import preview_srgb8 as preview_srgb8
    from storage.dataset.dataset import Dataset as Dataset
    from storage.dataset.dataset import open_dataset as open_dataset
    from storage.dataset.statistics import Statistics as Statistics
    from storage.dataset.statistics import dataset_statistics as dataset_statistics
    from storage.errors import TrilightError as TrilightError
    from storage.raycast import FirstHits as FirstHits
    from storage.raycast import first_hits as first_hits
    from storage.records.passes import Pass as Pass
    from storage.records.passes import declared_passes as declared_passes
    from storage.records.passes import view_passes as view_passes
    from storage.records.sample import Sample as Sample
    from storage.records.scene import Scene as Scene
    from storage.records.scene import SceneObject as SceneObject
    from train.presets import training_preset as training_preset
    from train.run_training import TrainResult as TrainResult
    from train.settings import TrainSettings as TrainSettings
    from train.settings import WatchSettings as WatchSettings
    from trilight.compose import Material as Material
    from trilight.compose import SceneBuilder as SceneBuilder
    from trilight.learning import train_network as train_network
    from trilight.pictures import open_network as open_network
    from trilight.pictures import render as render
    from trilight.pictures import render_views as render_views
    from trilight.pictures import write_picture as write_picture
    from trilight.scenes import generate as generate
    from trilight.scenes import read_scene as read_scene
    from trilight.scenes import read_scenes as read_scenes
    from trilight.scenes import within_budget as within_budget
    from trilight.scenes import write_scene as write_scene

_HOME = offered_names(__file__)
"""Module and name there, for each name. No name equals a package of the checkout: an installed
wheel has `trilight.train` and the other packages as subpackages."""

_OF_TORCH = {"Judgement", "NeuralRenderer", "TrainResult", "judge_network", "write_judgement"}
"""Names whose modules import torch."""

__all__ = sorted(["__version__", *_HOME])  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("trilight")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, name_there = _HOME[name]
    if name in _OF_TORCH:
        from infra.torch_library import require_torch

        require_torch(name)
    value = getattr(import_module(module), name_there)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
