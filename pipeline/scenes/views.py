"""Chooses cameras: the first of sixteen proposals per view that sees enough.

Proposals are numbered, and each is a pure function of (seed, scene, attempt, view, number). A view
whose picture turns out black can therefore ask for the next one, long after composition and in
another process.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.sight import Sight, ViewFacts
from scene_templates.settings import SceneSettings, ViewLaws
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.records.scene import Scene
from storage.seeds import rng_for

CAMERA_ATTEMPTS = 16
"""Proposals per view."""

PoseAndAngle = tuple[NDArray[np.float32], np.float32]


def with_first_cameras(scene: Scene, settings: SceneSettings) -> Scene:
    """Return the scene with `settings.num_views` cameras; raises Rejected("no_camera")."""
    sight = Sight(scene)
    chosen = [_first_camera(scene, sight, settings, view, 0) for view in range(settings.num_views)]
    return _with_cameras(
        scene, [camera for camera, _ in chosen], [attempt for _, attempt in chosen]
    )


def next_camera(scene: Scene, settings: SceneSettings, *, view: int) -> Scene:
    """Return the same scene with the camera of `view` replaced by the next that passes.

    Args:
        scene: as compose_scene or this function returned it.
        settings: those that the scene was composed with.
        view: row of `scene.c2w`.

    Raises:
        Rejected: "no_camera" when the sixteen proposals of the view are used up.
    """
    settings = settings.of_scene(scene.provenance["scene_index"])
    attempts = list(scene.provenance["camera_attempts"])
    camera, attempt = _first_camera(scene, Sight(scene), settings, view, attempts[view] + 1)
    cameras: list[PoseAndAngle] = list(zip(scene.c2w, scene.fov_deg, strict=True))
    cameras[view], attempts[view] = camera, attempt
    return _with_cameras(scene, cameras, attempts)


def complaint(facts: ViewFacts, settings: ViewLaws, *, has_objects: bool) -> str | None:
    """Return what is wrong with a view, or None."""
    if facts.depth < settings.min_depth:
        return "too near"
    if has_objects and facts.coverage < settings.min_coverage:
        return "sees too little of the objects"
    if facts.shell_back > settings.max_shell_back:
        return "sees the back of the shell"
    if facts.lit < settings.min_lit:
        return "sees too little light"
    return None


def _first_camera(
    scene: Scene, sight: Sight, settings: SceneSettings, view: int, first: int
) -> tuple[PoseAndAngle, int]:
    has_objects = any(entry.kind == "object" for entry in scene.objects)
    complaints: list[str] = []
    for attempt in range(first, CAMERA_ATTEMPTS):
        c2w, fov_deg = _proposal(scene, settings, view, attempt)
        facts = sight.facts(c2w, float(fov_deg), settings.views.coverage_grid)
        found = complaint(facts, settings.views, has_objects=has_objects)
        if found is None:
            return (c2w, fov_deg), attempt
        complaints.append(found)
    counts = ", ".join(f"{text} x{complaints.count(text)}" for text in sorted(set(complaints)))
    raise Rejected(
        "no_camera", f"view {view}: none of attempts {first} to {CAMERA_ATTEMPTS - 1}: {counts}"
    )


def _proposal(scene: Scene, settings: SceneSettings, view: int, attempt: int) -> PoseAndAngle:
    origin = scene.provenance
    rng = rng_for(origin["seed"], "camera", origin["scene_index"], origin["attempt"], view, attempt)
    pose = TEMPLATES[origin["template"]].camera_rand(rng, settings.cameras)
    return pose.c2w.astype(np.float32), np.float32(pose.fov_deg)


def _with_cameras(scene: Scene, cameras: list[PoseAndAngle], attempts: list[int]) -> Scene:
    posed = scene.with_cameras(
        np.stack([c2w for c2w, _ in cameras]), np.array([fov_deg for _, fov_deg in cameras])
    )
    provenance = {**scene.provenance, "camera_attempts": attempts}
    return dataclasses.replace(posed, provenance=provenance)
