"""Chooses camera views: tries up to sixteen proposals per view until one sees enough.

Proposals are numbered, and each is a pure function of (seed, scene, attempt, view, number). A view
whose picture turns out black can therefore continue with the next one, long after composition and
in another process.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.visibility import ViewFacts, Visibility
from scene_templates.sample_camera import path_position, sample_camera
from scene_templates.settings import SceneSettings, ViewLaws
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.records.scene import Scene
from storage.seeds import rng_for

CAMERA_ATTEMPTS = 16
"""Number of proposals per view."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewCamera:
    """A camera of a view."""

    c2w: NDArray[np.float32]
    """[4, 4] camera to world."""
    fov_deg: np.float32
    """Full field of view in degrees."""
    attempt: int
    """Number of the camera's proposal, from 0."""


def with_first_cameras(
    scene: Scene, settings: SceneSettings, first_cameras: Sequence[ViewCamera] = ()
) -> Scene:
    """Return the scene with `settings.num_views` cameras: `first_cameras`, then drawn ones.

    Raises:
        Rejected: "no_camera", or "no_layout" if its template draws none.
    """
    visibility = Visibility(scene)
    views = range(len(first_cameras), settings.num_views)
    drawn = [next(_accepted_proposals(scene, visibility, settings, view, 0)) for view in views]
    return with_cameras(scene, [*first_cameras, *drawn])


def cameras_of_view(
    scene: Scene, visibility: Visibility, settings: SceneSettings, view: int
) -> Iterator[ViewCamera]:
    """Yield the camera of a view, and then each following proposal that sees enough.

    Args:
        scene: scene as `compose_scene` returned it.
        visibility: visibility of this scene.
        settings: settings that the scene was composed with.
        view: row of `scene.c2w`.

    Raises:
        Rejected: "no_camera" when the sixteen proposals of the view are used up.
    """
    attempt = int(scene.provenance["camera_attempts"][view])
    yield ViewCamera(c2w=scene.c2w[view], fov_deg=scene.fov_deg[view], attempt=attempt)
    of_scene = settings.of_scene(scene.provenance["scene_index"])
    yield from _accepted_proposals(scene, visibility, of_scene, view, attempt + 1)


def cameras_of(scene: Scene) -> list[ViewCamera]:
    """Return the cameras of a scene."""
    attempts = scene.provenance.get("camera_attempts", [0] * scene.num_views)
    rows = zip(scene.c2w, scene.fov_deg, attempts, strict=True)
    return [ViewCamera(c2w=c2w, fov_deg=fov, attempt=attempt) for c2w, fov, attempt in rows]


def with_cameras(scene: Scene, cameras: Sequence[ViewCamera]) -> Scene:
    """Return the scene with these cameras; its provenance records their attempts."""
    posed = scene.with_cameras(
        np.stack([camera.c2w for camera in cameras]),
        np.array([camera.fov_deg for camera in cameras]),
    )
    attempts = [camera.attempt for camera in cameras]
    provenance = {**scene.provenance, "camera_attempts": attempts}
    return dataclasses.replace(posed, provenance=provenance)


def visibility_problem(facts: ViewFacts, settings: ViewLaws, *, has_objects: bool) -> str | None:
    """Return why a view is rejected, or None; a camera inside an object is too near."""
    if facts.depth < settings.min_depth:
        return "too near"
    if has_objects and facts.coverage < settings.min_coverage:
        return "sees too little of the objects"
    if facts.shell_back > settings.max_shell_back:
        return "sees the back of the shell"
    if facts.lit < settings.min_lit:
        return "sees too little light"
    return None


def _accepted_proposals(
    scene: Scene, sight: Visibility, settings: SceneSettings, view: int, first: int
) -> Iterator[ViewCamera]:
    """Yield proposals from `first` on that see enough; raises Rejected after the last one."""
    has_objects = any(entry.kind == "object" for entry in scene.objects)
    problems: list[str] = []
    for attempt in range(first, CAMERA_ATTEMPTS):
        camera = _proposal(scene, settings, view, attempt)
        facts = sight.facts(camera.c2w, float(camera.fov_deg), settings.views.coverage_grid)
        problem = visibility_problem(facts, settings.views, has_objects=has_objects)
        if problem is None:
            yield camera
            first = attempt + 1
            problems = []
        else:
            problems.append(problem)
    counts = ", ".join(f"{text} x{problems.count(text)}" for text in sorted(set(problems)))
    raise Rejected(
        "no_camera", f"view {view}: none of attempts {first} to {CAMERA_ATTEMPTS - 1}: {counts}"
    )


def _proposal(scene: Scene, settings: SceneSettings, view: int, attempt: int) -> ViewCamera:
    """Return proposal number `attempt` of a view (scene_templates.sample_camera.sample_camera).

    The first proposal of a view stands on the path of the settings, if they have one.
    """
    origin = scene.provenance
    template = origin.get("template", "unknown")
    names = (origin["scene_index"], origin["attempt"], view, attempt)
    seed = origin["seed"]
    purpose = "camera"
    if (new := origin.get("new_cameras")) is not None:
        template = new["layout"]
        seed = new["seed"]
        purpose = "new camera"
    if template not in TEMPLATES:
        raise Rejected(
            "no_layout", f"{template!r} is no layout that draws cameras; name one, or give cameras"
        )
    position = None
    if attempt == 0:
        of_path = rng_for(seed, f"{purpose} path", *names[:2])
        position = path_position(settings.cameras.path, view, settings.num_views, of_path)
    rng = rng_for(seed, purpose, *names)
    pose = sample_camera(rng, settings.cameras, TEMPLATES[template].cameras, position)
    return ViewCamera(
        c2w=pose.c2w.astype(np.float32), fov_deg=np.float32(pose.fov_deg), attempt=attempt
    )
