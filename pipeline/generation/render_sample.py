"""Renders the sample of a scene: each view by its first camera whose picture is accepted.

The choice of a camera wraps rendering. A `SceneRenderer` renders or rejects one camera and knows no
other; `cameras_of_view` proposes cameras and knows no picture.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.presets.settings import DatasetSettings
from pipeline.renders.noise_floor import MeasuredFloor
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.scenes.views import ViewCamera, cameras_of, cameras_of_view, with_cameras
from pipeline.scenes.visibility import Visibility
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import forget_views, tell_views
from storage.errors import Rejected
from storage.records.lights import Parts
from storage.records.objects import Failure
from storage.records.passes.pictures import passes_exr
from storage.records.sample import PartFloor, Sample, ViewRecord
from storage.records.scene import Scene
from storage.renderer import Sampling
from storage.seeds import seed_for

_EVERY_S = 0.5
"""Seconds between two writes."""


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
            self._write(view, step)
        raise AssertionError("a rendering yields its picture last")

    def _write(self, view: int, now: Sampling) -> None:
        if self._folder is not None and time.monotonic() - self._written_s >= _EVERY_S:
            self._written_s = time.monotonic()
            fraction = min(1.0, now.spp / now.expected_spp)
            tell_views(self._folder, self._scene_index, view + fraction)

    def end(self) -> None:
        """Delete the progress of the scene."""
        if self._folder is not None:
            forget_views(self._folder, self._scene_index)


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptPictures:
    """Finished pictures of a scene's first `num_views` cameras."""

    num_views: int
    """Number of cameras whose pictures are kept."""
    sample: Sample
    """The sample that holds the pictures."""
    members: Mapping[str, bytes]
    """Packed files of the kept pictures, by suffix."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderInput:
    """A scene to render, with the cameras and pictures that stay."""

    scene: Scene
    """The scene, with a camera for each view."""
    kept_cameras: int = 0
    """Number of first cameras that are never replaced: their rejection rejects the scene."""
    kept_pictures: KeptPictures | None = None
    """Pictures that need not be rendered again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _AcceptedView:
    """An accepted picture."""

    camera: ViewCamera
    record: ViewRecord
    radiance_rgb: NDArray[np.float32]
    lights_rgb: NDArray[np.float32] | None
    parts_rgb: Parts | None


def render_sample(
    key: str,
    render_input: RenderInput,
    settings: DatasetSettings,
    failures: list[Failure],
    progress: ViewProgress,
) -> Sample:
    """Render every view of a scene.

    Args:
        key: key of the sample.
        render_input: the scene, and the cameras and pictures that stay.
        settings: settings of the dataset.
        failures: receives a row for each camera that was rejected and replaced.
        progress: reports the progress of the views.

    Raises:
        Rejected: the scene cannot be rendered, or a view has no camera left.
    """
    scene = render_input.scene
    kept_pictures = render_input.kept_pictures
    num_kept = kept_pictures.num_views if kept_pictures else 0
    visibility = Visibility(scene)
    renderer = None
    if num_kept < scene.num_views:
        light_seed = seed_for(settings.seed, "light paths", int(key))
        renderer = SceneRenderer(scene, settings.renders, light_seed=light_seed)

    def render_view(view: int) -> _AcceptedView:
        if kept_pictures and view < num_kept:
            return _kept_view(kept_pictures.sample, view)
        assert renderer is not None
        for camera in cameras_of_view(scene, visibility, settings.scenes, view):
            seed = seed_for(settings.seed, "samples", int(key), view, camera.attempt)
            try:
                steps = renderer.view_steps(camera.c2w, float(camera.fov_deg), seed)
                return _accepted_view(
                    camera, progress.render_view(view, steps), seed, visibility, settings
                )
            except Rejected as rejection:
                reason = rejection.reason
                message = rejection.message
            if view < render_input.kept_cameras:
                raise Rejected(reason, f"view {view}: {message}")
            item = f"{key}.{view}"
            attempt = camera.attempt
            failures.append(
                Failure(stage="renders", item=item, reason=reason, message=message, attempt=attempt)
            )
        raise AssertionError("cameras_of_view ends by raising Rejected")

    views = [render_view(view) for view in range(scene.num_views)]
    seen = with_cameras(scene, [view.camera for view in views])
    seen.check()
    members = kept_pictures.members if kept_pictures else {}
    return _stack_views(key, seen, views, settings, members)


def _stack_views(
    key: str,
    scene: Scene,
    views: Sequence[_AcceptedView],
    settings: DatasetSettings,
    members: Mapping[str, bytes],
) -> Sample:
    lights = [view.lights_rgb for view in views if view.lights_rgb is not None]
    parts = [view.parts_rgb for view in views if view.parts_rgb is not None]
    return Sample(
        key=key,
        scene=scene.with_provenance({**scene.provenance, "settings_sha256": settings.digest}),
        radiance_rgb=np.stack([view.radiance_rgb for view in views]),
        views=tuple(view.record for view in views),
        lights_rgb=np.stack(lights) if lights else None,
        parts_rgb=_stack_parts(parts) if parts else None,
        passes_exr=_passes_exr(scene, settings),
        kept_members=members,
    )


def _kept_view(sample: Sample, view: int) -> _AcceptedView:
    parts = {name: pictures[view] for name, pictures in (sample.parts_rgb or {}).items()}
    return _AcceptedView(
        camera=cameras_of(sample.scene)[view],
        record=sample.views[view],
        radiance_rgb=sample.radiance_rgb[view],
        lights_rgb=None if sample.lights_rgb is None else sample.lights_rgb[view],
        parts_rgb=parts or None,
    )


def _passes_exr(scene: Scene, settings: DatasetSettings) -> tuple[bytes, ...] | None:
    names = settings.storage.passes
    resolution = settings.renders.resolution
    if not names:
        return None
    return tuple(
        passes_exr(scene, names, view=view, resolution=resolution)
        for view in range(scene.num_views)
    )


def _accepted_view(
    camera: ViewCamera,
    rendered: RenderedView,
    seed: int,
    sight: Visibility,
    settings: DatasetSettings,
) -> _AcceptedView:
    grid = settings.scenes.views.coverage_grid
    facts = sight.facts(camera.c2w, float(camera.fov_deg), grid)
    record = ViewRecord(
        spp=rendered.spp,
        noise_floor_db=round(rendered.noise_floor_db, 3),
        noise_floor_linear_db=round(rendered.noise_floor_linear_db, 3),
        object_noise_floor_db=round(rendered.object_noise_floor_db, 3),
        coverage=round(facts.coverage, 6),
        at_cap=rendered.at_cap,
        seed=seed,
        camera_attempt=camera.attempt,
        expected=None if rendered.expected_error is None else _part_floor(rendered.expected_error),
        parts={name: _part_floor(each) for name, each in (rendered.part_floors or {}).items()}
        or None,
        lights=tuple(map(_part_floor, rendered.light_floors or ())) or None,
    )
    return _AcceptedView(
        camera=camera,
        record=record,
        radiance_rgb=rendered.radiance_rgb,
        lights_rgb=rendered.lights_rgb,
        parts_rgb=rendered.parts_rgb,
    )


def _part_floor(floor: MeasuredFloor) -> PartFloor:
    return PartFloor(
        noise_floor_db=round(floor.log_db, 3),
        noise_floor_linear_db=round(floor.linear_db, 3),
        object_noise_floor_db=round(floor.object_log_db, 3),
    )


def _stack_parts(views: Sequence[Parts]) -> dict[str, NDArray[np.float32]]:
    return {name: np.stack([parts[name] for parts in views]) for name in views[0]}
