"""Objects of a pool without the asset stage, and what tests ask of a scene, in plain numpy."""

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.compose import compose_scene
from pipeline.scenes.pieces import ScenePiece, Skin, shell_piece, surface_piece
from pipeline.scenes.triangle_budget import FitTable, ObjectPool, PooledAsset, least_triangles
from scene_templates.layout import ShellPart, SurfaceLook
from scene_templates.rooms import PATCH_FACES, SIDES, patch
from scene_templates.scene_maps import UserMaps
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.records.asset import Asset, Level, LevelQuality, LevelRecord, SourceFacts
from storage.records.object_index import camp_sizes
from storage.records.objects import LockedObject
from storage.records.scene import Scene, SceneObject
from storage.records.scene_file import encode_scene
from storage.seeds import SceneKey
from tests.scene_templates.balls import STILL

QUALITY = LevelQuality(
    error_mean=0.0,
    error_p99=0.0,
    error_max=0.0,
    normal_error_deg=0.0,
    area_ratio=1.0,
    silhouette_iou=1.0,
    lost_area=0.0,
    area_variation=0.5,
    min_angle_p5_deg=30.0,
    open_edges=0,
)
"""Of a level that is its source."""

SOURCE = SourceFacts(
    num_faces_read=1280,
    num_faces=1280,
    num_faces_turned=0,
    num_parts=1,
    open_edges=0,
    nonmanifold_edges=0,
    front_share=1.0,
)
"""Of a closed object that needed no repair."""

STEP_ERROR = 0.02
"""Error of each level beyond that of the next finer one: far above what any preset calls enough, so
that finer levels are wanted wherever they fit."""

BLIND = {
    "views.min_coverage": 0.0, "views.min_lit": 0.0, "views.max_shell_back": 1.0,
    "views.min_depth": 0.0,
}  # fmt: skip
"""Every view is good enough."""

TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""

LOOK = SurfaceLook(
    diffuse_scale=1.0,
    diffuse_rgb=(0.1, 0.2, 0.3),
    specular_rgb=(0, 0, 0),
    roughness=0.5,
    smooth=False,
    colours="one",
)
"""A surface of one colour."""


def with_error(quality: LevelQuality, error: float) -> LevelQuality:
    """Return a quality at another distance to the source."""
    return dataclasses.replace(quality, error_mean=error / 2, error_p99=error, error_max=2 * error)


def level(mesh: trimesh.Trimesh, error: float = 0.0) -> Level:
    """Return a mesh in the unit box as a level with a stated distance to its source."""
    centred = mesh.vertices - mesh.bounds.mean(axis=0)
    count = len(mesh.faces)
    return Level(
        record=LevelRecord(budget=count, method="source", quality=with_error(QUALITY, error)),
        positions=(centred / mesh.extents.max()).astype(np.float32),
        faces=mesh.faces.astype(np.uint32),
    )


def pooled(uid: str, meshes: Iterable[trimesh.Trimesh]) -> PooledAsset:
    """Return an asset whose levels are the meshes, the largest first."""
    digest = hashlib.sha256(uid.encode()).hexdigest()
    return PooledAsset(
        locked=LockedObject(
            uid=uid,
            asset_sha256=digest,
            split="train",
            licence="CC0-1.0",
            licence_source="tests",
            title=uid,
            attribution=f"maker of {uid}",
            source_url=f"https://example.org/{uid}",
        ),
        asset=Asset(
            geometry_sha256=digest,
            source_sha256=digest,
            recipe="trimesh creation",
            source=SOURCE,
            levels=tuple(level(mesh, rung * STEP_ERROR) for rung, mesh in enumerate(meshes)),
        ),
    )


def small_pool() -> list[PooledAsset]:
    """Return five objects of 12 to 1280 triangles, sorted by uid; one is called like a wall."""
    create = trimesh.creation
    return [
        pooled("made/ball", [create.icosphere(n) for n in (3, 2, 1)]),
        pooled("made/box", [create.box(extents=(1, 2, 0.5))]),
        pooled("made/rod", [create.cylinder(0.1, 1, sections=n) for n in (64, 24)]),
        pooled("made/ring", [create.torus(0.5, 0.2, n, n) for n in (24, 16, 8)]),
        pooled("made/wall1", [create.cone(0.5, 1, sections=n) for n in (48, 12)]),
    ]


def fit_table(least: Sequence[int], camps: Sequence[str] = ()) -> FitTable:
    """Return the table of some objects; without `camps` none has a camp."""
    names = sorted({*camps}) or [""]
    sizes = np.array(least, np.int64)
    numbers = np.array([names.index(camp) for camp in camps] or [0] * len(least), np.int64)
    return FitTable(sizes, numbers, names, camp_sizes(sizes, numbers, names))


class ListPool(list[PooledAsset], ObjectPool):
    """A pool whose objects are all in memory."""

    @property
    def fits(self) -> FitTable:  # type: ignore[override]
        return fit_table([least_triangles(each.asset) for each in self], [e.camp for e in self])


def composed(
    settings: SceneSettings, pool: Sequence[PooledAsset], key: SceneKey, **user_maps: UserMaps
) -> Scene:
    """Return the scene of a key."""
    each = pool if isinstance(pool, ObjectPool) else ListPool(pool)
    return compose_scene(settings, each, key, **user_maps)


def floor_piece(look: SurfaceLook, rng: np.random.Generator) -> ScenePiece:
    """Return the floor of a room, of 128 triangles, with a look."""
    positions = patch(SIDES["floor"], STILL)
    part = ShellPart(name="floor", positions=positions, faces=PATCH_FACES, surface=look)
    return shell_piece(part, rng, 30.0)


def piece_of(
    positions: NDArray[np.float32],
    faces: NDArray[np.uint32],
    look: SurfaceLook = LOOK,
    skin: Skin | None = None,
    name: str = "it",
) -> ScenePiece:
    """Return a mesh as the piece of an object."""
    entry = SceneObject(name=name, kind="object", uid=f"made/{name}")
    return surface_piece(entry, positions, faces, look, np.random.default_rng(0), 30.0, skin)


def first_scene(
    settings: SceneSettings, pool: Sequence[PooledAsset], *, seed: int, scene_index: int
) -> Scene:
    """Return the first attempt at a scene that is not rejected, as a run does."""
    for attempt in range(16):
        try:
            return composed(settings, pool, SceneKey(seed, scene_index, attempt))
        except Rejected:
            continue
    raise AssertionError(f"scene {scene_index} of seed {seed} was rejected sixteen times")


def digest(scene: Scene) -> str:
    """Return the sha256 over all that a scene holds."""
    return hashlib.sha256(encode_scene(scene)).hexdigest()


def rows_of(scene: Scene, kind: str) -> list[int]:
    """Return the rows of `scene.objects` of a kind."""
    return [row for row, entry in enumerate(scene.objects) if entry.kind == kind]


def triangles_of(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the corners [T, 3, 3] of one object."""
    return scene.vertex_positions[scene.faces[scene.object_index == row]].astype(np.float64)


def points_of(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the distinct vertices [V, 3] of one object."""
    return np.unique(triangles_of(scene, row).reshape(-1, 3), axis=0)


def planes_of(scene: Scene) -> NDArray[np.float64]:
    """Return the inward plane [K, 4] of each shell part, the floor first."""
    rows = []
    for row in rows_of(scene, "shell"):
        vertex = scene.faces[scene.object_index == row][0, 0]
        normal = scene.vertex_normals[vertex].astype(np.float64)
        rows.append(np.append(normal, -normal @ scene.vertex_positions[vertex]))
    return np.array(rows)


def counts_of(scene: Scene) -> dict[str, int]:
    """Return the number of triangles of each kind."""
    kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
    return {kind: int((kinds == kind).sum()) for kind in ("shell", "object", "emitter")}


def ray_distances(
    origins: NDArray[np.float64], directions: NDArray[np.float64], triangles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where rays [N, 3] meet triangles [T, 3, 3]: [N, T] in directions, inf for a miss.

    Moeller and Trumbore 1997, two-sided, double precision, every ray against every triangle.
    """
    a, ab, ac = triangles[:, 0], *(triangles[:, k] - triangles[:, 0] for k in (1, 2))
    found = [np.zeros((0, len(triangles)))]
    for rows in np.array_split(np.arange(len(origins)), len(origins) // 64 + 1):
        along, away = directions[rows, None], origins[rows, None] - a
        p, q = np.cross(along, ac[None]), np.cross(away, ab[None])
        det = np.sum(p * ab, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (np.sum(x * y, axis=-1) / det for x, y in ((p, away), (along, q), (q, ac)))
            is_met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        found.append(np.where(is_met, t, np.inf))
    return np.concatenate(found)
