"""`SceneWorker`: composes scenes and renders their views, inside a worker process.

`render_workers` starts these processes; `pipeline.isolation` survives their crashes.
"""

import contextlib
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.assets.asset_store import AssetStore
from pipeline.generation.frozen_pool import AssetMissing, ComposedScenes, SplitPool, user_maps
from pipeline.generation.render_sample import RenderInput, ViewProgress, failure_of, render_sample
from pipeline.generation.scene_origins import RevisitedScenes, SceneOrigin
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import Variant, activate
from pipeline.renders.renderer import set_threads
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.settings import SceneSettings
from scene_templates.textures import OwnMaps
from storage.dataset.layout import DatasetFolder
from storage.errors import Rejected
from storage.records.objects import Failure
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene
from storage.seeds import SceneKey

MAX_ATTEMPTS = 16
"""Attempts at a scene before it is given up."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneAttempt:
    """The result of one attempt."""

    sample: Sample | None
    """The finished sample; None if the attempt was rejected."""
    failures: list[Failure]
    """Rejections of the attempt, and of cameras on the way to a sample."""
    missing_asset: tuple[str, str] | None = None
    """uid and file name of an object that must be prepared again before this attempt."""


class SceneWorker:
    """Object that a render child holds: makes attempts at scenes, and opens each split once."""

    def __init__(
        self,
        settings: DatasetSettings,
        origin: SceneOrigin,
        assets: AssetStore,
        variant: Variant,
        threads: int,
        gpu: str | None = None,
        folder: DatasetFolder | None = None,
    ) -> None:
        """Prepare this process: its GPU, Mitsuba's variant, and its threads.

        Args:
            assets: store of the objects' prepared files, as the worker sees it.
            variant: Mitsuba variant and denoiser device.
            gpu: GPU of this child, as CUDA_VISIBLE_DEVICES names it; None without one.
            folder: gets the progress of a scene; None reports none.
        """
        if gpu is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = gpu
        activate(variant)
        set_threads(threads)
        self._settings = settings
        self._origin = origin
        self._assets = assets
        self._folder = folder
        self._pool = functools.cache(self._open_pool)
        self._maps = functools.cache(self._open_maps)

    def attempt(
        self, split: str, scene_index: int, attempt: int, from_file: Scene | None = None
    ) -> SceneAttempt:
        """Make one attempt at a scene; equal arguments give equal results in every child.

        Args:
            from_file: the scene if it comes from a file, which a confined child has read.
        """
        key = sample_key(scene_index)
        settings = self._settings
        failures: list[Failure] = []
        progress = ViewProgress(self._folder, scene_index)
        stage = "scenes"
        try:
            render_input = self._render_input(split, scene_index, attempt, from_file)
            stage = "renders"
            sample = render_sample(key, render_input, settings, failures, progress)
        except Rejected as rejection:
            failures.append(failure_of(stage, key, rejection, attempt))
            return SceneAttempt(sample=None, failures=failures)
        except AssetMissing as missing:
            return SceneAttempt(
                sample=None, failures=[], missing_asset=(missing.uid, missing.asset_name)
            )
        finally:
            progress.end()
        return SceneAttempt(sample=sample, failures=failures)

    def compose_first(
        self, settings: SceneSettings, scene_index: int, seed: int, split: str
    ) -> Scene | None:
        """Compose the first accepted attempt at a scene without the user's maps; None if none is.

        Args:
            settings: the ranges to draw from, which may differ from the dataset's.
        """
        for attempt in range(MAX_ATTEMPTS):
            with contextlib.suppress(Rejected):
                return compose_scene(
                    settings, self._pool(split), SceneKey(seed, scene_index, attempt)
                )
        return None

    def _render_input(
        self, split: str, scene_index: int, attempt: int, from_file: Scene | None
    ) -> RenderInput:
        settings = self._settings
        if isinstance(self._origin, RevisitedScenes):
            return self._origin.scene(scene_index, attempt, settings)
        if from_file is not None:
            return RenderInput(scene=from_file, kept_cameras=settings.scenes.num_views)
        scene = compose_scene(
            settings.scenes,
            self._pool(split),
            SceneKey(settings.seed, scene_index, attempt),
            user_maps=self._maps(split),
        )
        return RenderInput(scene=scene)

    @functools.cached_property
    def _frozen(self) -> ComposedScenes:
        assert isinstance(self._origin, ComposedScenes), "only composed scenes draw objects"
        return self._origin

    def _open_pool(self, split: str) -> Sequence[PooledAsset]:
        """Return the objects of a split, sorted by uid; each is opened on first access."""
        return SplitPool(self._frozen, split, self._assets)

    def _open_maps(self, split: str) -> OwnMaps:
        """Return the user's textures and maps of a split; each is read when a scene takes it."""
        return user_maps(self._frozen.maps, split)
