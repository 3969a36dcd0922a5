"""One attempt at one scene, inside a render child: compose it, render its views."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.assets.store import AssetStore
from pipeline.builds.settings import BuildSettings
from pipeline.making.frozen_pool import AssetAway, FrozenPool
from pipeline.making.own_maps import own_maps
from pipeline.making.prepare_isolated import asset_store
from pipeline.making.render_sample import BegunScene, render_sample
from pipeline.making.revisited_scenes import RevisitedScenes
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.renderer import set_threads
from pipeline.renders.variant import Variant, activate
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pool import PooledAsset
from scene_templates.own_maps import OwnMaps
from storage.dataset.layout import DatasetFolder
from storage.errors import Rejected
from storage.records.objects import Failure, LockedObject
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene

MAX_ATTEMPTS = 16
"""Attempts at a scene before it is given up."""


@dataclass(frozen=True, kw_only=True)
class SceneRecipe:
    """What a render child needs to know once."""

    settings: BuildSettings
    """The build."""
    variant: Variant
    """What Mitsuba runs on."""
    threads: int
    """Threads of this child."""
    gpu: str | None = None
    """Graphics card of this child, as CUDA_VISIBLE_DEVICES names it; None where none is used."""
    pool: FrozenPool | None = None
    """The frozen objects, where scenes are composed of them."""
    assets: AssetStore = field(default_factory=asset_store)
    """Where their prepared files are, as the maker sees it."""
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """A user's own textures and skies with their prepared files."""
    revisited: RevisitedScenes | None = None
    """Where scenes are those of a finished dataset."""
    folder: DatasetFolder | None = None
    """Where it is told how far a scene is; None where nobody looks."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneAttempt:
    """What became of one attempt."""

    sample: Sample | None
    """The finished sample, or nothing where the attempt was rejected."""
    failures: list[Failure]
    """The rejection of the attempt, and of cameras on the way to a sample."""
    away: tuple[str, str] | None = None
    """uid and file of an object that must be prepared again before this attempt can be made."""


class _ChildState:
    """The objects and maps of a render child by split, each opened where a scene takes it."""

    source: SceneRecipe
    pool: dict[str, Sequence[PooledAsset]]
    own: dict[str, OwnMaps]


_state = _ChildState()


def set_up_child(source: SceneRecipe) -> None:
    """Prepare a render child: its graphics card, Mitsuba's variant, its threads, and the assets."""
    if source.gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = source.gpu
    activate(source.variant)
    set_threads(source.threads)
    _state.source = source
    _state.pool, _state.own = {}, {}


def attempt_scene(
    split: str, scene_index: int, attempt: int, from_file: Scene | None = None
) -> SceneAttempt:
    """Make one attempt at a scene; equal arguments give equal results in every child.

    Args:
        split: of the scene.
        scene_index: which.
        attempt: from 0.
        from_file: the scene, where it comes from a file: a confined child has read that.
    """
    key = sample_key(scene_index)
    settings = _state.source.settings
    failures: list[Failure] = []
    told = ViewProgress(_state.source.folder, scene_index)
    stage = "scenes"
    try:
        begun = _scene(split, scene_index, attempt, from_file)
        stage = "renders"
        sample = render_sample(key, begun, settings, failures, told)
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
    except AssetAway as missing:
        return SceneAttempt(sample=None, failures=[], away=(missing.uid, missing.asset_name))
    finally:
        told.end()
    return SceneAttempt(sample=sample, failures=failures)


def _scene(split: str, scene_index: int, attempt: int, from_file: Scene | None) -> BegunScene:
    source, settings = _state.source, _state.source.settings
    if source.revisited is not None:
        return source.revisited.scene(scene_index, attempt, settings)
    if from_file is not None:
        return BegunScene(scene=from_file, kept_cameras=settings.scenes.num_views)
    scene = compose_scene(
        settings.scenes,
        assets_of(split),
        seed=settings.seed,
        scene_index=scene_index,
        attempt=attempt,
        own=maps_of(split),
    )
    return BegunScene(scene=scene)


def assets_of(split: str) -> Sequence[PooledAsset]:
    """Return the objects of a split, sorted by uid; each is opened when it is taken."""
    if split not in _state.pool:
        frozen = _state.source.pool
        assert frozen is not None, "only composed scenes draw objects"
        _state.pool[split] = frozen.opened(split, _state.source.assets)
    return _state.pool[split]


def maps_of(split: str) -> OwnMaps:
    """Return a user's own textures and maps of a split; each is read when a scene takes it."""
    if split not in _state.own:
        _state.own[split] = own_maps(_state.source.maps, split)
    return _state.own[split]
