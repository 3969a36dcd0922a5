"""The sample of a scene: every view by the first of its cameras whose picture is accepted.

Choosing a camera wraps rendering. A `SceneRenderer` makes the picture of one camera or refuses it,
and knows of no other camera; `cameras_of_view` knows of no picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.builds.settings import BuildSettings
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.scenes.sight import Sight
from pipeline.scenes.views import ViewCamera, cameras_of_view, with_cameras
from storage.errors import Rejected
from storage.records.objects import Failure
from storage.records.parts import Parts
from storage.records.passes.stored import passes_exr
from storage.records.sample import PartFloor, Sample, ViewRecord
from storage.records.scene import Scene
from storage.seeds import seed_for


@dataclass(frozen=True, kw_only=True, eq=False)
class _TakenView:
    """An accepted picture."""

    camera: ViewCamera
    seed: int
    """Of its samples."""
    rendered: RenderedView


def render_sample(
    key: str,
    scene: Scene,
    settings: BuildSettings,
    failures: list[Failure],
    told: ViewProgress,
    *,
    keeps_cameras: bool = False,
) -> Sample:
    """Render every view of a scene.

    Args:
        key: of the sample.
        scene: with a camera for each view.
        settings: of the build.
        failures: takes a row for each camera that was refused and replaced.
        told: hears how far the views are.
        keeps_cameras: whether a refused camera ends the scene instead, as one of a file does.

    Raises:
        Rejected: the scene cannot be rendered, or a view has no camera left.
    """
    renderer, sight = SceneRenderer(scene, settings.renders), Sight(scene)

    def take(view: int) -> _TakenView:
        for camera in cameras_of_view(scene, sight, settings.scenes, view):
            seed = seed_for(settings.seed, "samples", int(key), view, camera.attempt)
            try:
                steps = renderer.view_steps(camera.c2w, float(camera.fov_deg), seed)
                return _TakenView(camera=camera, seed=seed, rendered=told.view(view, steps))
            except Rejected as rejection:
                reason, message = rejection.reason, rejection.message
            if keeps_cameras:
                raise Rejected(reason, f"view {view}: {message}")
            item, attempt = f"{key}.{view}", camera.attempt
            failures.append(
                Failure(stage="renders", item=item, reason=reason, message=message, attempt=attempt)
            )
        raise AssertionError("cameras_of_view ends by raising Rejected")

    views = [take(view) for view in range(scene.num_views)]
    seen = with_cameras(scene, [view.camera for view in views])
    seen.check()
    lights = [view.rendered.lights_rgb for view in views if view.rendered.lights_rgb is not None]
    parts = [view.rendered.parts_rgb for view in views if view.rendered.parts_rgb is not None]
    return Sample(
        key=key,
        scene=seen.with_provenance({**seen.provenance, "settings_sha256": settings.digest}),
        radiance_rgb=np.stack([view.rendered.radiance_rgb for view in views]),
        views=tuple(_record(view, sight, settings.scenes.views.coverage_grid) for view in views),
        lights_rgb=np.stack(lights) if lights else None,
        parts_rgb=_stacked(parts) if parts else None,
        passes_exr=_passes_exr(seen, settings),
    )


def _passes_exr(scene: Scene, settings: BuildSettings) -> tuple[bytes, ...] | None:
    names, resolution = settings.storage.passes, settings.renders.resolution
    if not names:
        return None
    return tuple(
        passes_exr(scene, names, view=view, resolution=resolution)
        for view in range(scene.num_views)
    )


def _record(view: _TakenView, sight: Sight, coverage_grid: int) -> ViewRecord:
    camera, rendered = view.camera, view.rendered
    facts = sight.facts(camera.c2w, float(camera.fov_deg), coverage_grid)
    return ViewRecord(
        spp=rendered.spp,
        noise_floor_db=round(rendered.noise_floor_db, 3),
        noise_floor_linear_db=round(rendered.noise_floor_linear_db, 3),
        object_noise_floor_db=round(rendered.object_noise_floor_db, 3),
        coverage=round(facts.coverage, 6),
        at_cap=rendered.at_cap,
        seed=view.seed,
        camera_attempt=camera.attempt,
        parts=_part_floors(rendered),
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
