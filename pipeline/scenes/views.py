"""Chooses camera views: tries up to sixteen proposals per view until one sees enough.

Proposals are numbered, and each is a pure function of (seed, scene, attempt, view, number). A view
whose picture turns out black can therefore continue with the next one, long after composition and
in another process.

`Visibility` estimates what a camera sees, by ray casting on a coarse grid. A grid of 32 x 32 rays
costs about a millisecond, and decides only if a picture is worth rendering: it may miss anything
smaller than a grid cell. Everything is computed in the single precision of storage.raycast:
the cameras of a dataset depend on each bit of it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_templates.sample_camera import path_position, sample_camera
from scene_templates.settings import SceneSettings, ViewLaws
from scene_templates.templates import TEMPLATES
from storage.conventions import camera_rays, latlong_direction
from storage.errors import Rejected, TrilightError
from storage.raycast import MISS, MetSurfaces, Surfaces
from storage.records.scene import Scene
from storage.seeds import rng_for


def require_valid(scene: Scene, settings: SceneSettings, *, in_budget: bool = True) -> None:
    """Raise Rejected if a scene is invalid, over its budget, or has a light within an object.

    Args:
        in_budget: True to limit the number of triangles too.

    Raises:
        Rejected: "law_broken" with the message of `Scene.check`, "over_budget", or
            "emitter_inside" if an emitter reaches into the bounding box of an object.
    """
    try:
        scene.check()
    except TrilightError as error:
        uids = {entry.uid for entry in scene.objects if entry.uid}
        named = ", ".join(sorted(uids.union(scene.provenance.get("maps", ())))) or "none"
        raise Rejected("law_broken", f"{error} Its objects and maps are {named}.") from error
    if in_budget and scene.num_triangles > settings.max_triangles:
        message = f"{scene.num_triangles} triangles; at most {settings.max_triangles} were allowed"
        raise Rejected("over_budget", message)
    boxes = object_boxes(scene)
    lamps = [row for row, entry in enumerate(scene.objects) if entry.is_lamp]
    for row in lamps[settings.lights.num_inside :]:
        low, high = _box(scene, row)
        if ((low < boxes[:, 1]) & (boxes[:, 0] < high)).all(axis=1).any():
            name = scene.objects[row].name
            raise Rejected("emitter_inside", f"{name} reaches into the box of an object")


def object_boxes(scene: Scene) -> NDArray[np.float32]:
    """Return the bounding boxes [K, 2, 3] of objects, without shell and emitters."""
    rows = [row for row, entry in enumerate(scene.objects) if entry.kind == "object"]
    return np.array([_box(scene, row) for row in rows], np.float32).reshape(-1, 2, 3)


def _box(scene: Scene, row: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    points = scene.vertex_positions[scene.faces[scene.object_index == row].ravel()]
    return points.min(axis=0), points.max(axis=0)


SHADOW_OFFSET = 1e-4
"""Height of a shadow ray's start above its surface; hits in single precision are exact to about
1e-6."""

LIT_STEP = 2
"""Step of the rows and columns of the grid whose light is tested: eight emitters cost eight rays
per hit."""

SKY_RAYS = 8
"""Number of directions that sample the light of a sky: each stands for an eighth of it."""


@dataclass(frozen=True, kw_only=True)
class ViewFacts:
    """Measures of one camera's view."""

    coverage: float
    """Fraction of the rays whose first hit is an object."""
    shell_back: float
    """Fraction of the rays whose first hit is the back of a floor or wall."""
    lit: float
    """Fraction of the hit points whose visible side is lit by the center of an emitter, or by one
    of SKY_RAYS directions of a sky."""
    depth: float
    """Distance in meters to the nearest ray hit or bounding box of an object."""


class Visibility:
    """A scene prepared for judging cameras."""

    def __init__(self, scene: Scene) -> None:
        kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
        self._face_is_object = kinds == "object"
        self._surfaces = Surfaces(scene)
        self._lights = scene.vertex_positions[scene.faces[scene.triangle_emits]].mean(axis=1)
        self._sky = _sky_directions(scene)
        self._boxes = object_boxes(scene).astype(np.float64)

    def facts(self, c2w: NDArray[np.float32], fov_deg: float, grid: int) -> ViewFacts:
        """Measure one camera, c2w [4, 4], by the rays of a picture of `grid` x `grid` pixels."""
        origin, directions = camera_rays(c2w, fov_deg, grid)
        toward = directions.reshape(-1, 3).astype(np.float32)
        start = np.tile(origin.astype(np.float32), (len(toward), 1))
        hits = self._surfaces.intersect(start, toward)
        is_hit = hits.triangle != MISS
        is_object = is_hit & self._face_is_object[hits.triangle]
        behind = is_hit & (np.sum(hits.normal * toward, axis=1) > 0)
        nearest = float(hits.distance_m[is_hit].min(initial=np.inf))
        outside = np.maximum(np.maximum(self._boxes[:, 0] - origin, origin - self._boxes[:, 1]), 0)
        to_box = float(np.sqrt(np.sum(np.square(outside), axis=1)).min(initial=np.inf))
        return ViewFacts(
            coverage=float(is_object.mean()),
            shell_back=float((behind & ~is_object).mean()),
            lit=self._lit_fraction(start, toward, hits, is_hit, grid),
            depth=min(nearest, to_box),
        )

    def _lit_fraction(
        self,
        start: NDArray[np.float32],
        toward: NDArray[np.float32],
        hits: MetSurfaces,
        is_hit: NDArray[np.bool_],
        grid: int,
    ) -> float:
        row, column = np.divmod(np.arange(grid * grid), grid)
        sampled = np.flatnonzero(is_hit & (row % LIT_STEP == 0) & (column % LIT_STEP == 0))
        if len(sampled) == 0:
            return 0.0
        geometric = hits.normal[sampled]
        normal = geometric / np.sqrt(np.sum(np.square(geometric), axis=1, keepdims=True))
        normal *= np.where(np.sum(normal * toward[sampled], axis=1, keepdims=True) > 0, -1, 1)
        point = (
            start[sampled]
            + hits.distance_m[sampled, None] * toward[sampled]
            + SHADOW_OFFSET * normal
        )
        ray = self._lights[None] - point[:, None]
        if len(self._sky):
            sky_rays = np.broadcast_to(self._sky, (len(point), *self._sky.shape))
            ray = np.concatenate([ray, sky_rays], axis=1)
        distance = np.sqrt(np.sum(np.square(ray), axis=-1))
        on_side = np.sum(ray * normal[:, None], axis=-1) > 0
        free = self._surfaces.is_free(
            np.repeat(point, ray.shape[1], axis=0).astype(np.float32),
            (ray / distance[..., None]).reshape(-1, 3).astype(np.float32),
            distance.reshape(-1).astype(np.float32),
        )
        return float((free.reshape(on_side.shape) & on_side).any(axis=1).mean())


def _sky_directions(scene: Scene) -> NDArray[np.float32]:
    """Return vectors [K, 3] towards the light of a sky, four times as long as the scene's extent.

    Texels are accumulated from the top by their light; one direction lies in the middle of each
    eighth of it. A black sky has none.
    """
    sky = scene.environment
    if sky is None or not sky.radiance_rgb.any():
        return np.zeros((0, 3), np.float32)
    rows, columns = sky.radiance_rgb.shape[:2]
    edges = np.cos(np.pi * np.arange(rows + 1) / rows)
    flux = sky.radiance_rgb.mean(axis=-1, dtype=np.float64) * (edges[:-1] - edges[1:])[:, None]
    below = np.cumsum(flux)
    middle = (np.arange(SKY_RAYS) + 0.5) / SKY_RAYS * below[-1]
    row, column = np.divmod(np.searchsorted(below, middle), columns)
    uv = np.stack([(column + 0.5) / columns, 1 - (row + 0.5) / rows], axis=-1)
    towards = latlong_direction(uv) @ sky.rotation.T.astype(np.float64)
    far = float(np.ptp(scene.vertex_positions, axis=0).max()) * 4
    return (towards * far).astype(np.float32)


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
        view: row of `scene.c2w`.

    Raises:
        Rejected: "no_camera" when the sixteen proposals of the view are used up.
    """
    camera = cameras_of(scene)[view]
    yield camera
    of_scene = settings.of_scene(scene.provenance["scene_index"])
    yield from _accepted_proposals(scene, visibility, of_scene, view, camera.attempt + 1)


def cameras_of(scene: Scene) -> list[ViewCamera]:
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
    return posed.with_provenance({**scene.provenance, "camera_attempts": attempts})


def visibility_problem(facts: ViewFacts, settings: ViewLaws, *, has_objects: bool) -> str | None:
    """Return why a view is rejected, or None; a camera inside an object is too near."""
    problems = {
        "too near": facts.depth < settings.min_depth,
        "sees too little of the objects": has_objects and facts.coverage < settings.min_coverage,
        "sees the back of the shell": facts.shell_back > settings.max_shell_back,
        "sees too little light": facts.lit < settings.min_lit,
    }
    return next((problem for problem, is_met in problems.items() if is_met), None)


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
    c2w, fov_deg = sample_camera(rng, settings.cameras, TEMPLATES[template].cameras, position)
    return ViewCamera(c2w=c2w.astype(np.float32), fov_deg=np.float32(fov_deg), attempt=attempt)
