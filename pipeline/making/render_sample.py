"""The sample of a scene: every view by the first of its cameras whose picture is accepted.

Choosing a camera wraps rendering. A `SceneRenderer` makes the picture of one camera or refuses it,
and knows of no other camera; `cameras_of_view` knows of no picture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.builds.settings import BuildSettings
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.scenes.sight import Sight
from pipeline.scenes.views import ViewCamera, cameras_of, cameras_of_view, with_cameras
from storage.errors import Rejected
from storage.records.objects import Failure
from storage.records.parts import Parts
from storage.records.passes.stored import passes_exr
from storage.records.sample import PartFloor, Sample, ViewRecord
from storage.records.scene import Scene
from storage.seeds import seed_for


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptPictures:
    """Pictures that a scene has already, of its first `num_views` cameras."""

    num_views: int
    """How many."""
    sample: Sample
    """The sample that they are of."""
    members: Mapping[str, bytes]
    """Packed as they are, by suffix."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BegunScene:
    """A scene to make pictures of."""

    scene: Scene
    """With a camera for each view."""
    kept_cameras: int = 0
    """Number of its first cameras that end the scene where their pictures are refused; any other is
    replaced."""
    kept: KeptPictures | None = None
    """What need not be rendered again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _TakenView:
    """An accepted picture."""

    camera: ViewCamera
    record: ViewRecord
    radiance_rgb: NDArray[np.float32]
    lights_rgb: NDArray[np.float32] | None
    parts_rgb: Parts | None


def render_sample(
    key: str,
    begun: BegunScene,
    settings: BuildSettings,
    failures: list[Failure],
    told: ViewProgress,
) -> Sample:
    """Render every view of a scene.

    Args:
        key: of the sample.
        begun: the scene, and which of its cameras and pictures stay.
        settings: of the build.
        failures: takes a row for each camera that was refused and replaced.
        told: hears how far the views are.

    Raises:
        Rejected: the scene cannot be rendered, or a view has no camera left.
    """
    scene, kept = begun.scene, begun.kept
    num_kept = kept.num_views if kept else 0
    sight = Sight(scene)
    renderer = SceneRenderer(scene, settings.renders) if num_kept < scene.num_views else None

    def take(view: int) -> _TakenView:
        if kept and view < num_kept:
            return _kept_view(kept.sample, view)
        assert renderer is not None
        for camera in cameras_of_view(scene, sight, settings.scenes, view):
            seed = seed_for(settings.seed, "samples", int(key), view, camera.attempt)
            try:
                steps = renderer.view_steps(camera.c2w, float(camera.fov_deg), seed)
                return _taken_view(camera, told.view(view, steps), seed, sight, settings)
            except Rejected as rejection:
                reason, message = rejection.reason, rejection.message
            if view < begun.kept_cameras:
                raise Rejected(reason, f"view {view}: {message}")
            item, attempt = f"{key}.{view}", camera.attempt
            failures.append(
                Failure(stage="renders", item=item, reason=reason, message=message, attempt=attempt)
            )
        raise AssertionError("cameras_of_view ends by raising Rejected")

    views = [take(view) for view in range(scene.num_views)]
    seen = with_cameras(scene, [view.camera for view in views])
    seen.check()
    lights = [view.lights_rgb for view in views if view.lights_rgb is not None]
    parts = [view.parts_rgb for view in views if view.parts_rgb is not None]
    return Sample(
        key=key,
        scene=seen.with_provenance({**seen.provenance, "settings_sha256": settings.digest}),
        radiance_rgb=np.stack([view.radiance_rgb for view in views]),
        views=tuple(view.record for view in views),
        lights_rgb=np.stack(lights) if lights else None,
        parts_rgb=_stacked(parts) if parts else None,
        passes_exr=_passes_exr(seen, settings),
        kept_members=kept.members if kept else {},
    )


def _kept_view(sample: Sample, view: int) -> _TakenView:
    parts = {name: pictures[view] for name, pictures in (sample.parts_rgb or {}).items()}
    return _TakenView(
        camera=cameras_of(sample.scene)[view],
        record=sample.views[view],
        radiance_rgb=sample.radiance_rgb[view],
        lights_rgb=None if sample.lights_rgb is None else sample.lights_rgb[view],
        parts_rgb=parts or None,
    )


def _passes_exr(scene: Scene, settings: BuildSettings) -> tuple[bytes, ...] | None:
    names, resolution = settings.storage.passes, settings.renders.resolution
    if not names:
        return None
    return tuple(
        passes_exr(scene, names, view=view, resolution=resolution)
        for view in range(scene.num_views)
    )


def _taken_view(
    camera: ViewCamera, rendered: RenderedView, seed: int, sight: Sight, settings: BuildSettings
) -> _TakenView:
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
        parts=_part_floors(rendered),
    )
    return _TakenView(
        camera=camera,
        record=record,
        radiance_rgb=rendered.radiance_rgb,
        lights_rgb=rendered.lights_rgb,
        parts_rgb=rendered.parts_rgb,
    )


def _part_floors(rendered: RenderedView) -> dict[str, PartFloor] | None:
    if rendered.part_floors is None:
        return None
    return {
        name: PartFloor(
            noise_floor_db=round(floor.log_db, 3),
            noise_floor_linear_db=round(floor.linear_db, 3),
            object_noise_floor_db=round(floor.object_log_db, 3),
        )
        for name, floor in rendered.part_floors.items()
    }


def _stacked(views: Sequence[Parts]) -> dict[str, NDArray[np.float32]]:
    return {name: np.stack([parts[name] for parts in views]) for name in views[0]}
