"""Composes scenes: meshes within the triangle budget, in a layout, with cameras that see them.

A scene is a pure function of (settings, pool, scene key).

FCL (Pan, Chitta, Manocha 2012) tests triangle against triangle in float64 over bounding volume
trees; distant objects are separated by their bounding spheres alone. A mesh inside another one does
not touch it, so a mesh also meets every mesh whose box contains its own. This rejects a ball in a
bowl.
"""

import dataclasses
import heapq
import itertools
from collections.abc import Iterator, Sequence
from types import MappingProxyType
from typing import Any, Literal

import fcl
import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.pieces import (
    ScenePiece,
    Skin,
    concatenate_pieces,
    emitter_piece,
    shell_piece,
    source_skins,
    surface_piece,
    with_drawn_columns,
    with_drawn_textures,
    with_source_emission,
)
from pipeline.scenes.shading_normals import ShadedMesh
from pipeline.scenes.triangle_budget import ObjectPool, PooledAsset, draw_rows, levels_within
from pipeline.scenes.views import require_valid, with_first_cameras
from scene_templates.layout import Layout, Pose
from scene_templates.rotations import rotate_points
from scene_templates.sample_layout import ScenePlan, sample_layout, scene_plan
from scene_templates.scene_maps import UserMaps, scene_sky
from scene_templates.settings import SceneSettings
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level
from storage.records.material import EMISSION
from storage.records.objects import SKY, TEXTURE
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene, SceneObject
from storage.seeds import SceneKey


class MeshShape:
    """One level of an asset in the unit sphere; see scene_templates.placement.Shape."""

    def __init__(self, uid: str, level: Level, centring: Literal["vertex_mean", "box"]) -> None:
        """Scale a level of the object `uid` to the unit sphere.

        Raises:
            Rejected: "no_faces" if it is a single point or not finite.
        """
        self.points = normalize_to_unit_sphere(level.positions, centring)
        if not np.isfinite(self.points).all():
            raise Rejected("no_faces", f"{uid}: the level has no extent, or is not finite")
        self.faces = level.faces
        self._tree: tuple[float, Any] | None = None

    def overlaps(self, pose: Pose, other: "MeshShape", its_pose: Pose) -> bool:
        """Return True if two posed meshes share a point, or one's box contains the other's."""
        offset = pose.centre - its_pose.centre
        if np.sum(np.square(offset)) > (pose.radius + its_pose.radius) ** 2:
            return False
        low, high = self._box(pose)
        its_low, its_high = other._box(its_pose)
        if (low > its_high).any() or (its_low > high).any():
            return False
        inside = (low >= its_low).all() and (high <= its_high).all()
        outside = (low <= its_low).all() and (high >= its_high).all()
        if inside or outside:
            return True
        result = fcl.CollisionResult()
        fcl.collide(self._body(pose), other._body(its_pose), fcl.CollisionRequest(), result)
        return bool(result.is_collision)

    def _body(self, pose: Pose) -> Any:
        """Return FCL's object; its tree is cached, since poses change more often than sizes."""
        if self._tree is None or self._tree[0] != pose.radius:
            tree = fcl.BVHModel()
            tree.beginModel(len(self.points), len(self.faces))
            tree.addSubModel(pose.radius * self.points, self.faces.astype(np.int32))
            tree.endModel()
            self._tree = (pose.radius, tree)
        return fcl.CollisionObject(self._tree[1], fcl.Transform(pose.rotation, pose.centre))

    def _box(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = pose.radius * rotate_points(self.points, pose.rotation) + pose.centre
        return points.min(axis=0), points.max(axis=0)


def normalize_to_unit_sphere(
    positions: NDArray[np.float32], centring: Literal["vertex_mean", "box"]
) -> NDArray[np.float64]:
    """Return the vertices [V, 3] of a level scaled so that the farthest lies on the unit sphere.

    Args:
        positions: [V, 3] in the unit box of the asset, whose middle is that of its source.
        centring: the new center: that middle, which is the same for all levels of an asset, or as
            published the mean of the vertices, which moves with the tessellation.

    Returns:
        float64; not finite if a position is not, or if all positions are the same point.
    """
    points = positions.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        if centring == "vertex_mean":
            points -= points.mean(axis=0)
        return points / np.sqrt(np.sum(np.square(points), axis=1).max())


def pose_points(points: NDArray[np.float64], pose: Pose) -> NDArray[np.float32]:
    """Return points [V, 3] of the unit sphere in world space."""
    return (pose.radius * rotate_points(points, pose.rotation) + pose.centre).astype(np.float32)


def compose_scene(
    settings: SceneSettings,
    pool: ObjectPool,
    scene_key: SceneKey,
    *,
    user_maps: UserMaps = MappingProxyType({}),
) -> Scene:
    """Compose one scene.

    Args:
        pool: the objects of the scene's split.
        user_maps: the user's textures and maps of the scene's split.

    Returns:
        A checked scene with `settings.num_views` cameras. Its provenance holds template, family,
        scene_index, attempt, seed and camera_attempts (per view, the accepted proposal); for an
        excursion its axis and value; for a scene with a sky its drawn parameters; "maps" are the
        uids of the user's textures and map, if it has any.

    Raises:
        Rejected: no_room, over_budget, no_faces, no_camera, emitter_inside or law_broken; equal
            arguments always give the same result.
        TrilightError: the pool is empty.
    """
    if not pool:
        raise TrilightError("scenes: the pool holds 0 objects; expected at least 1: add objects.")
    plan = scene_plan(settings, seed=scene_key.seed, scene_index=scene_key.index)
    provenance = _provenance(settings, plan, scene_key)
    settings = settings.of_scene(scene_key.index)
    rng = scene_key.rng("scene")
    budget = settings.max_triangles - plan.family.shell_triangles - plan.num_lights
    chosen = [pool[row] for row in draw_rows(rng, pool.fits, plan.num_objects, budget)]
    levels = levels_within([entry.asset for entry in chosen], budget, settings.enough_error)
    shapes = [
        MeshShape(entry.locked.uid, level, settings.centring)
        for entry, level in zip(chosen, levels, strict=True)
    ]
    layout = sample_layout(rng, settings, plan, shapes)
    skins = source_skins(chosen, levels, settings.materials, scene_key)
    pieces = scene_pieces(layout, chosen, shapes, settings, rng, skins)
    pieces = with_drawn_textures(
        pieces, layout, settings.textures, scene_key, user_textures=user_maps.get(TEXTURE, ())
    )
    arrays = concatenate_pieces(pieces)
    arrays["materials"] = with_drawn_columns(arrays["materials"], scene_key)
    scene = Scene(
        **arrays,
        c2w=np.zeros((0, 4, 4), np.float32),
        fov_deg=np.zeros(0, np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance=provenance,
    )
    uids = {piece.skin.uid for piece in pieces if piece.skin and piece.skin.uid}
    scene = _with_sky(scene, settings, scene_key, user_maps, uids)
    scene = with_first_cameras(without_constant_textures(scene), settings)
    require_valid(scene, settings)
    return scene


def _with_sky(
    scene: Scene,
    settings: SceneSettings,
    scene_key: SceneKey,
    user_maps: UserMaps,
    uids: set[str],
) -> Scene:
    """Return a scene with its sky, if any, and with the uids of the user's maps in it."""
    emits = scene.triangle_emits
    sky = scene_sky(
        settings.skies,
        scene.vertex_positions[scene.faces[emits]].astype(np.float64),
        scene.materials[scene.material_index[emits], EMISSION].astype(np.float64),
        scene_key,
        user_skies=user_maps.get(SKY, ()),
        licences=scene.licences,
    )
    provenance = dict(scene.provenance)
    if sky is not None:
        environment, provenance["sky"], uid = sky
        scene = dataclasses.replace(scene, environment=environment)
        uids = uids | ({uid} if uid else set())
    if uids:
        provenance["maps"] = sorted(uids)
    return scene.with_provenance(provenance)


def _provenance(settings: SceneSettings, plan: ScenePlan, scene_key: SceneKey) -> dict[str, Any]:
    origin = {
        "template": plan.family.template,
        "family": plan.family.name,
        "scene_index": scene_key.index,
        "attempt": scene_key.attempt,
        "seed": scene_key.seed,
        "camera_attempts": [],
    }
    excursion = settings.excursion_of(scene_key.index)
    if excursion is not None:
        origin["excursion"] = {"axis": excursion.axis, "value": excursion.value}
    return origin


def scene_pieces(
    layout: Layout,
    chosen: Sequence[PooledAsset],
    shapes: Sequence[MeshShape],
    settings: SceneSettings,
    rng: np.random.Generator,
    skins: Sequence[Skin | None],
) -> list[ScenePiece]:
    """Return floor and walls, objects and emitters of a layout, the objects as `shapes`.

    An object with one of `skins` gets its textures; its emitting components become emitters at the
    end, if the settings say so.

    Raises:
        Rejected: "no_faces" if no triangle of an object has an area.
    """
    angle_deg = settings.materials.smooth_angle_deg
    shell = [shell_piece(part, rng, angle_deg) for part in layout.shell]
    emitters = [emitter_piece(emitter, row) for row, emitter in enumerate(layout.emitters)]
    taken = [piece.entry.name for piece in [*shell, *emitters]]
    objects = []
    for pooled, shape, placement, skin in zip(chosen, shapes, layout.objects, skins, strict=True):
        entry = _entry(pooled, taken)
        taken.append(entry.name)
        positions = pose_points(shape.points, placement.pose)
        surface = placement.surface
        objects.append(surface_piece(entry, positions, shape.faces, surface, rng, angle_deg, skin))
    objects, lights = with_source_emission(objects, emitters, settings.materials.own_emission)
    pieces = [*shell, *objects, *emitters, *lights]
    return pieces if settings.fill_to is None else fill_triangles(pieces, settings.fill_to)


def _entry(pooled: PooledAsset, taken: Sequence[str]) -> SceneObject:
    """Return the row of an object, named by the end of its uid or its first free variant."""
    locked = pooled.locked
    stem = locked.uid.rsplit("/", 1)[-1]
    variants = [stem, *(f"{stem}_{number}" for number in range(2, len(taken) + 3))]
    return SceneObject(
        name=next(name for name in variants if name not in taken),
        kind="object",
        uid=locked.uid,
        **locked.rights,
    )


Edge = tuple[int, int]


def fill_triangles(pieces: Sequence[ScenePiece], fill_to: int) -> list[ScenePiece]:
    """Return the pieces with the objects subdivided until the scene has `fill_to` triangles.

    Objects grow in proportion to their triangles. The sum falls short of `fill_to` by a few; pieces
    with more triangles than that stay as they are.
    """
    counts = [len(piece.mesh.faces) for piece in pieces]
    is_object = [piece.entry.kind == "object" for piece in pieces]
    of_objects = sum(count for count, yes in zip(counts, is_object, strict=True) if yes)
    remaining = fill_to - (sum(counts) - of_objects)
    return [
        subdivide(piece, remaining * count // of_objects) if yes else piece
        for piece, count, yes in zip(pieces, counts, is_object, strict=True)
    ]


def subdivide(piece: ScenePiece, num_faces: int) -> ScenePiece:
    """Return a piece with at most `num_faces` faces, short of it by less than one edge's faces.

    The longest edge is halved in every face that has it, so that no gap opens. Triangles are flat,
    so new vertices stay on the surface up to the rounding of float32. They get the mean of their
    neighbors' normals, and new triangles keep their material. A piece that has as many faces
    already is returned as it is.
    """
    mesh, origin = _halve_longest(piece.mesh, num_faces)
    skin = piece.skin
    if skin is not None:
        corner_uv = skin.uv.reshape(-1, 3, 2)
        uv = _interpolate_uv(piece.mesh, mesh, origin, corner_uv).astype(np.float32)
        skin = dataclasses.replace(skin, uv=uv.reshape(-1, 2))
    return dataclasses.replace(
        piece, mesh=mesh, material_index=piece.material_index[origin], skin=skin
    )


def _interpolate_uv(
    before: ShadedMesh, after: ShadedMesh, origin: NDArray[np.int64], uv: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return uv [T, 3, 2] of subdivided triangles, interpolated from `uv` [F, 3, 2]."""
    triangles = before.positions[before.faces].astype(np.float64)[origin]
    parts = after.positions[after.faces].astype(np.float64)
    sides = triangles[:, 1:] - triangles[:, :1]  # [T, 2, 3]
    steps = np.einsum("tpx,tsx->tps", parts - triangles[:, :1], sides)
    gram = np.einsum("tax,tbx->tab", sides, sides)
    across = np.linalg.solve(gram, steps.transpose(0, 2, 1)).transpose(0, 2, 1)  # [T, 3, 2]
    weights = np.concatenate([1 - across.sum(axis=2, keepdims=True), across], axis=2)
    return np.einsum("tpc,tcu->tpu", np.clip(weights, 0, 1), uv[origin].astype(np.float64))


def _halve_longest(mesh: ShadedMesh, num_faces: int) -> tuple[ShadedMesh, NDArray[np.int64]]:
    """Return a mesh of at most `num_faces` faces, and the face that each is a part of.

    Positions identify edges: flat faces share no vertices.
    """
    vertices = list(np.column_stack([mesh.positions, mesh.normals]).astype(np.float64))
    _, ids = np.unique(mesh.positions, axis=0, return_inverse=True)
    places: list[int] = ids.ravel().tolist()
    new_places = itertools.count(1 + max(places))
    faces: list[list[int]] = mesh.faces.tolist()
    origin = list(range(len(faces)))
    rows: dict[Edge, set[int]] = {}
    longest: list[tuple[float, Edge]] = []

    def edges(row: int) -> Iterator[tuple[int, int, Edge]]:
        for a, b in itertools.pairwise([*faces[row], faces[row][0]]):
            yield a, b, (min(places[a], places[b]), max(places[a], places[b]))

    def enter(row: int) -> None:
        for a, b, edge in edges(row):
            if edge not in rows:
                rows[edge] = set()
                offset = vertices[a][:3] - vertices[b][:3]
                heapq.heappush(longest, (-float(np.sum(offset * offset)), edge))
            rows[edge].add(row)

    for row in range(len(faces)):
        enter(row)
    while len(faces) + len(rows[longest[0][1]]) <= num_faces:
        _, halved = heapq.heappop(longest)
        place = next(new_places)
        middles: dict[Edge, int] = {}
        for row in sorted(rows.pop(halved)):
            for _, _, edge in edges(row):
                rows.get(edge, set()).discard(row)
            face = faces[row]
            first, second = sorted(v for v in face if places[v] in halved)
            if (first, second) not in middles:
                middles[first, second] = len(vertices)
                vertices.append((vertices[first] + vertices[second]) / 2)
                places.append(place)
            middle = middles[first, second]
            faces[row] = [middle if v == first else v for v in face]
            faces.append([middle if v == second else v for v in face])
            origin.append(origin[row])
            enter(row)
            enter(len(faces) - 1)
    positions, normals = np.split(np.array(vertices), 2, axis=1)
    normals = normals / np.sqrt(np.sum(np.square(normals), axis=1, keepdims=True))
    finer = ShadedMesh(
        positions=positions.astype(np.float32),
        normals=normals.astype(np.float32),
        faces=np.array(faces, np.uint32),
        groups=mesh.groups[origin],
    )
    return finer, np.array(origin)
