"""`SceneWorker`: composes scenes and renders their samples, inside a worker process.

`render_workers` starts these processes; `pipeline.isolation` survives their crashes. A worker
trusts the lock and the asset store: it starts without opening any object. It opens the one to three
objects of a scene, checks their digests against the lock, and keeps a few open. If an object's file
is missing on this machine, `render_workers.restore_object` prepares it again. The choice of
a camera wraps rendering: a view is rendered by its first camera whose picture is accepted. A
`SceneRenderer` renders or rejects one camera and knows no other; `cameras_of_view` proposes cameras
and knows no picture.
"""

import contextlib
import functools
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.asset_store import AssetStore
from pipeline.generation.scene_origins import (
    ComposedScenes,
    RenderInput,
    RevisitedScenes,
    SceneOrigin,
)
from pipeline.objects.maps.prepared import decode_prepared
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import Variant, activate
from pipeline.renders.renderer import RenderedView, SceneRenderer, set_threads
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.triangle_budget import FitTable, ObjectPool, PooledAsset, least_triangles
from pipeline.scenes.views import ViewCamera, Visibility, cameras_of, cameras_of_view, with_cameras
from scene_templates.scene_maps import UserMap, UserMaps
from scene_templates.settings import SceneSettings
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import tell_views
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError
from storage.records.asset import decode_asset
from storage.records.object_index import ObjectIndex
from storage.records.objects import SKY, TEXTURE, Failure, LockedObject, LockRows, failure_of
from storage.records.passes import passes_exr
from storage.records.sample import PictureErrors, Sample, ViewRecord, sample_key
from storage.records.scene import Scene
from storage.records.texture import MapSource
from storage.renderer import Sampling
from storage.seeds import SceneKey, seed_for

MAX_ATTEMPTS = 16
"""Attempts at a scene before it is given up."""
_MOST_OPEN = 8
"""Objects that a child keeps open for each split; most scenes have three at most."""
_EVERY_S = 0.5
"""Seconds between two writes of the progress of a scene."""


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
        self._folder = folder
        self._pool = functools.cache(lambda split: SplitPool(self._frozen, split, assets))
        """Objects of a split, sorted by uid; each is opened on first access."""
        self._maps = functools.cache(lambda split: user_maps(self._frozen.maps, split))
        """The user's textures and maps of a split; each is read when a scene takes it."""

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
        self, settings: SceneSettings, scene_index: int, seed: int = 0, split: str = "train"
    ) -> Scene:
        """Compose the first accepted attempt at a scene without the user's maps.

        Args:
            settings: the ranges to draw from, which may differ from the dataset's.

        Raises:
            Rejected: every attempt at it was rejected.
        """
        for attempt in range(MAX_ATTEMPTS):
            with contextlib.suppress(Rejected):
                return compose_scene(
                    settings, self._pool(split), SceneKey(seed, scene_index, attempt)
                )
        raise Rejected("no_scene", f"scene {scene_index}: every attempt at it was rejected")

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


class AssetMissing(Exception):
    """The store lacks the prepared file of an object, or has another than the lock's.

    Attributes:
        uid: uid of the object.
        asset_name: name of the missing file.
    """

    def __init__(self, uid: str, asset_name: str) -> None:
        super().__init__(f"object {uid!r}: its prepared file is not in the asset store")
        self.uid = uid
        self.asset_name = asset_name


class SplitPool(ObjectPool):
    """The objects of one split, sorted by uid, each opened on access."""

    def __init__(self, frozen: ComposedScenes, split: str, store: AssetStore) -> None:
        index = ObjectIndex(frozen.index)
        if split not in index.facts.splits:
            raise TrilightError(f"split {split!r}: no frozen object belongs to it; expected one.")
        rows = index.facts.splits[split]
        self.fits = FitTable(
            index.column("least", rows), index.column("camp", rows), index.facts.camps, rows.camps
        )
        self._offsets = index.column("offset", rows)
        self._index = index
        self._first = rows.start
        self._split = split
        self._lock = LockRows(frozen.lock)
        self._store = store
        self._open = functools.lru_cache(_MOST_OPEN)(self._read)

    def __len__(self) -> int:
        return len(self._offsets)

    def __getitem__(self, row: int) -> PooledAsset:  # type: ignore[override]
        """Return an object; read its file unless it is still open.

        Raises:
            AssetMissing: it has to be prepared again.
            TrilightError: the index is not that of the lock.
        """
        if not 0 <= row < len(self):
            raise IndexError(row)
        return self._open(row)

    def _read(self, row: int) -> PooledAsset:
        locked = self._lock.at(int(self._offsets[row : row + 1][0]))
        name = self._index.asset_name(self._first + row)
        try:
            data = self._store.asset_path(name).read_bytes()
        except FileNotFoundError as error:
            raise AssetMissing(locked.uid, name) from error
        if sha256_hex(data) != locked.asset_sha256:
            raise AssetMissing(locked.uid, name)
        asset = decode_asset(data)
        pooled = PooledAsset(locked=locked, asset=asset)
        stored = locked.split, least_triangles(asset), pooled.camp
        if stored != (self._split, self.fits.size(row), self.fits.camp(row)):
            raise TrilightError(
                f"objects.index: says otherwise of {locked.uid!r} than objects.lock.jsonl and its "
                "file; expected the index of this lock. Delete .staging/objects.index, and it is "
                "made again."
            )
        return pooled


def user_maps(rows: Iterable[tuple[LockedObject, Path]], split: str) -> UserMaps:
    """Return the maps that scenes of a split may use, sorted by uid; no file is read yet.

    Args:
        rows: rows of a lock with the prepared files.
        split: train, validation or test.
    """
    of_kind: dict[str, list[UserMap]] = {TEXTURE: [], SKY: []}
    for locked, path in sorted(rows, key=lambda row: row[0].uid):
        if locked.split == split:
            source = MapSource(name=locked.title, **locked.rights)
            load = functools.partial(_arrays, path)
            of_kind[locked.kind].append(UserMap(uid=locked.uid, source=source, load=load))
    return of_kind


def _arrays(path: Path) -> Mapping[str, NDArray[np.float32]]:
    return decode_prepared(path.read_bytes(), path.name).arrays


class ViewProgress:
    """Reports the progress of one scene; never affects the output."""

    def __init__(self, folder: DatasetFolder | None, scene_index: int) -> None:
        self._folder = folder
        self._scene_index = scene_index
        self._written_s = 0.0

    def render_view(self, view: int, steps: Iterator[Sampling | RenderedView]) -> RenderedView:
        """Render view number `view`, from 0, and report progress; raises as the renderer does."""
        for step in steps:
            if not isinstance(step, Sampling):
                return step
            if self._folder is not None and time.monotonic() - self._written_s >= _EVERY_S:
                self._written_s = time.monotonic()
                fraction = min(1.0, step.spp / step.expected_spp)
                tell_views(self._folder, self._scene_index, view + fraction)
        raise AssertionError("a rendering yields its picture last")

    def end(self) -> None:
        """Delete the progress of the scene."""
        if self._folder is not None:
            tell_views(self._folder, self._scene_index, None)


_AcceptedView = tuple[ViewCamera, ViewRecord, Mapping[str, NDArray[np.float32]]]
"""Camera, record, and pictures: `radiance_rgb`, `lights_rgb` if lights are apart, parts by name."""


def render_sample(
    key: str,
    render_input: RenderInput,
    settings: DatasetSettings,
    failures: list[Failure],
    progress: ViewProgress,
) -> Sample:
    """Render every view of a scene.

    Args:
        failures: receives a row for each camera that was rejected and replaced.

    Raises:
        Rejected: the scene cannot be rendered, or a view has no camera left.
    """
    scene = render_input.scene
    visibility = Visibility(scene)
    renderer = None
    if render_input.kept_views < scene.num_views:
        light_seed = seed_for(settings.seed, "light paths", int(key))
        renderer = SceneRenderer(scene, settings.renders, light_seed=light_seed)

    def render_view(view: int) -> _AcceptedView:
        if render_input.kept_sample and view < render_input.kept_views:
            sample = render_input.kept_sample
            kept_pictures = {name: pictures[view] for name, pictures in _pictures(sample).items()}
            return cameras_of(sample.scene)[view], sample.views[view], kept_pictures
        assert renderer is not None
        for camera in cameras_of_view(scene, visibility, settings.scenes, view):
            seed = seed_for(settings.seed, "samples", int(key), view, camera.attempt)
            try:
                steps = renderer.view_steps(camera.c2w, float(camera.fov_deg), seed)
                rendered = progress.render_view(view, steps)
                record = _record(camera, rendered, seed, visibility, settings)
                return camera, record, _pictures(rendered)
            except Rejected as rejection:
                if view < render_input.kept_cameras:
                    raise Rejected(rejection.reason, f"view {view}: {rejection.message}") from None
                failures.append(failure_of("renders", f"{key}.{view}", rejection, camera.attempt))
        raise AssertionError("cameras_of_view ends by raising Rejected")

    views = [render_view(view) for view in range(scene.num_views)]
    seen = with_cameras(scene, [camera for camera, _, _ in views])
    seen.check()
    return _stack_views(key, seen, views, settings, render_input.kept_members)


def _stack_views(
    key: str,
    scene: Scene,
    views: Sequence[_AcceptedView],
    settings: DatasetSettings,
    members: Mapping[str, bytes],
) -> Sample:
    _, records, pictures = zip(*views, strict=True)
    stacked = {name: np.stack([of[name] for of in pictures]) for name in pictures[0]}
    names = settings.storage.passes
    resolution = settings.renders.resolution
    rows = range(scene.num_views)
    passes = (passes_exr(scene, names, view=row, resolution=resolution) for row in rows)
    return Sample(
        key=key,
        scene=scene.with_provenance({**scene.provenance, "settings_sha256": settings.digest}),
        radiance_rgb=stacked.pop("radiance_rgb"),
        views=records,
        lights_rgb=stacked.pop("lights_rgb", None),
        parts_rgb=stacked or None,
        passes_exr=tuple(passes) if names else None,
        kept_members=members,
    )


def _pictures(of: Sample | RenderedView) -> dict[str, NDArray[np.float32]]:
    named = {"radiance_rgb": of.radiance_rgb, "lights_rgb": of.lights_rgb, **(of.parts_rgb or {})}
    return {name: picture for name, picture in named.items() if picture is not None}


def _record(
    camera: ViewCamera,
    rendered: RenderedView,
    seed: int,
    sight: Visibility,
    settings: DatasetSettings,
) -> ViewRecord:
    grid = settings.scenes.views.coverage_grid
    facts = sight.facts(camera.c2w, float(camera.fov_deg), grid)
    return ViewRecord(
        spp=rendered.spp,
        **rendered.rounded,
        coverage=round(facts.coverage, 6),
        at_cap=rendered.at_cap,
        seed=seed,
        camera_attempt=camera.attempt,
        expected=None
        if rendered.expected_error is None
        else _round_errors(rendered.expected_error),
        parts={name: _round_errors(each) for name, each in (rendered.part_floors or {}).items()}
        or None,
        lights=tuple(map(_round_errors, rendered.light_floors or ())) or None,
    )


def _round_errors(floor: PictureErrors) -> PictureErrors:
    return PictureErrors(**floor.rounded)
