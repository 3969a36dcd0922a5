"""One attempt at one scene, inside a render child: composes it and renders its views."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.assets.store import AssetStore
from pipeline.builds.settings import BuildSettings
from pipeline.generation.frozen_pool import AssetMissing, FrozenPool
from pipeline.generation.prepare_isolated import asset_store
from pipeline.generation.render_sample import RenderInput, render_sample
from pipeline.generation.revisited_scenes import RevisitedScenes
from pipeline.generation.user_maps import user_maps
from pipeline.generation.view_progress import ViewProgress
from pipeline.renders.renderer import set_threads
from pipeline.renders.variant import Variant, activate
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from scene_templates.user_maps import OwnMaps
from storage.dataset.layout import DatasetFolder
from storage.errors import Rejected
from storage.records.objects import Failure, LockedObject
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene

MAX_ATTEMPTS = 16
"""Attempts at a scene before it is given up."""


@dataclass(frozen=True, kw_only=True)
class SceneRecipe:
    """Configuration of a render child, sent once when it starts."""

    settings: BuildSettings
    """Settings of the dataset."""
    variant: Variant
    """Mitsuba variant and denoiser device."""
    threads: int
    """Number of CPU threads of this child."""
    gpu: str | None = None
    """GPU of this child, as CUDA_VISIBLE_DEVICES names it; None without one."""
    pool: FrozenPool | None = None
    """The frozen objects, if scenes are composed of them."""
    assets: AssetStore = field(default_factory=asset_store)
    """Store of the objects' prepared files, as the worker sees it."""
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """The user's textures and skies with their prepared files."""
    revisited: RevisitedScenes | None = None
    """Reader of a finished dataset, if scenes are those of one."""
    folder: DatasetFolder | None = None
    """Folder that gets the progress of a scene; None reports none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneAttempt:
    """The result of one attempt."""

    sample: Sample | None
    """The finished sample; None if the attempt was rejected."""
    failures: list[Failure]
    """Rejections of the attempt, and of cameras on the way to a sample."""
    missing_asset: tuple[str, str] | None = None
    """uid and file name of an object that must be prepared again before this attempt."""


class _ChildState:
    """Objects and maps of a render child by split, each opened when a scene takes it."""

    recipe: SceneRecipe
    pool: dict[str, Sequence[PooledAsset]]
    maps: dict[str, OwnMaps]


_state = _ChildState()


def set_up_child(recipe: SceneRecipe) -> None:
    """Set up a render child: its GPU, Mitsuba's variant, its threads, and the assets."""
    if recipe.gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = recipe.gpu
    activate(recipe.variant)
    set_threads(recipe.threads)
    _state.recipe = recipe
    _state.pool = {}
    _state.maps = {}


def attempt_scene(
    split: str, scene_index: int, attempt: int, from_file: Scene | None = None
) -> SceneAttempt:
    """Make one attempt at a scene; equal arguments give equal results in every child.

    Args:
        split: split of the scene.
        scene_index: index of the scene, from 0.
        attempt: number of the attempt, from 0.
        from_file: the scene if it comes from a file, which a confined child has read.
    """
    key = sample_key(scene_index)
    settings = _state.recipe.settings
    failures: list[Failure] = []
    progress = ViewProgress(_state.recipe.folder, scene_index)
    stage = "scenes"
    try:
        render_input = _scene(split, scene_index, attempt, from_file)
        stage = "renders"
        sample = render_sample(key, render_input, settings, failures, progress)
    except Rejected as rejection:
        failures.append(
            Failure(
                stage=stage,
                item=key,
                reason=rejection.reason,
                message=rejection.message,
                attempt=attempt,
            )
        )
        return SceneAttempt(sample=None, failures=failures)
    except AssetMissing as missing:
        return SceneAttempt(
            sample=None, failures=[], missing_asset=(missing.uid, missing.asset_name)
        )
    finally:
        progress.end()
    return SceneAttempt(sample=sample, failures=failures)


def _scene(split: str, scene_index: int, attempt: int, from_file: Scene | None) -> RenderInput:
    recipe = _state.recipe
    settings = _state.recipe.settings
    if recipe.revisited is not None:
        return recipe.revisited.scene(scene_index, attempt, settings)
    if from_file is not None:
        return RenderInput(scene=from_file, kept_cameras=settings.scenes.num_views)
    scene = compose_scene(
        settings.scenes,
        assets_of(split),
        seed=settings.seed,
        scene_index=scene_index,
        attempt=attempt,
        user_maps=maps_of(split),
    )
    return RenderInput(scene=scene)


def assets_of(split: str) -> Sequence[PooledAsset]:
    """Return the objects of a split, sorted by uid; each is opened on first access."""
    if split not in _state.pool:
        frozen = _state.recipe.pool
        assert frozen is not None, "only composed scenes draw objects"
        _state.pool[split] = frozen.open_split(split, _state.recipe.assets)
    return _state.pool[split]


def maps_of(split: str) -> OwnMaps:
    """Return the user's textures and maps of a split; each is read when a scene takes it."""
    if split not in _state.maps:
        _state.maps[split] = user_maps(_state.recipe.maps, split)
    return _state.maps[split]
