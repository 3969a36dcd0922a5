"""Renders the sample of a scene: each view by its first camera whose picture is accepted.

The choice of a camera wraps rendering. A `SceneRenderer` renders or rejects one camera and knows no
other; `cameras_of_view` proposes cameras and knows no picture.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.presets.settings import DatasetSettings
from pipeline.renders.noise_floor import MeasuredFloor
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.scenes.views import ViewCamera, Visibility, cameras_of, cameras_of_view, with_cameras
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import tell_views
from storage.errors import Rejected
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
            if self._folder is not None and time.monotonic() - self._written_s >= _EVERY_S:
                self._written_s = time.monotonic()
                fraction = min(1.0, step.spp / step.expected_spp)
                tell_views(self._folder, self._scene_index, view + fraction)
        raise AssertionError("a rendering yields its picture last")

    def end(self) -> None:
        """Delete the progress of the scene."""
        if self._folder is not None:
            tell_views(self._folder, self._scene_index, None)


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderInput:
    """A scene to render, with the cameras and pictures that stay."""

    scene: Scene
    """The scene, with a camera for each view."""
    kept_cameras: int = 0
    """Number of first cameras that are never replaced: their rejection rejects the scene."""
    kept_views: int = 0
    """Number of first cameras whose pictures need not be rendered again."""
    kept_sample: Sample | None = None
    """The sample that holds the kept pictures."""
    kept_members: Mapping[str, bytes] = field(default_factory=dict)
    """Packed files of the kept pictures, by suffix."""


_AcceptedView = tuple[ViewCamera, ViewRecord, Mapping[str, NDArray[np.float32]]]
"""Camera, record, and pictures: `radiance_rgb`, `lights_rgb` if lights are apart, parts by name."""


def failure_of(stage: str, item: str, rejection: Rejected, attempt: int = 0) -> Failure:
    """Return the row of a rejection."""
    reason = rejection.reason
    return Failure(
        stage=stage, item=item, reason=reason, message=rejection.message, attempt=attempt
    )


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


def _part_floor(floor: MeasuredFloor) -> PartFloor:
    return PartFloor(
        noise_floor_db=round(floor.log_db, 3),
        noise_floor_linear_db=round(floor.linear_db, 3),
        object_noise_floor_db=round(floor.object_log_db, 3),
    )
