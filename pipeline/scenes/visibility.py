"""`Visibility`: estimates what a camera sees, by ray casting on a coarse grid.

A grid of 32 x 32 rays costs about a millisecond, and decides only if a picture is worth rendering:
it may miss anything smaller than a grid cell. Everything is computed in the single precision of
storage.raycast.caster: the cameras of a dataset depend on each bit of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.scene_checks import object_boxes
from storage.conventions import camera_rays, latlong_direction
from storage.raycast.caster import MISS, MetSurfaces, Surfaces
from storage.records.scene import Scene

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
        return ViewFacts(
            coverage=float(is_object.mean()),
            shell_back=float((behind & ~is_object).mean()),
            lit=self._lit_fraction(start, toward, hits, is_hit, grid),
            depth=min(nearest, _distance_to_boxes(origin, self._boxes)),
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


def _distance_to_boxes(point: NDArray[np.float64], boxes: NDArray[np.float64]) -> float:
    """Return the distance to the nearest box; 0 inside of one, infinite without boxes."""
    outside = np.maximum(np.maximum(boxes[:, 0] - point, point - boxes[:, 1]), 0)
    return float(np.sqrt(np.sum(np.square(outside), axis=1)).min(initial=np.inf))
