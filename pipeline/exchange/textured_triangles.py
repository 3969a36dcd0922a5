"""Joins triangles with materials and textures, and cameras, of other programs to a Scene.

Each triangle has three separate corners. Corners of equal position and normal become one vertex,
and equal materials one row. Textures are computed per texel, as maps of linear values; those of one
color become constants. `LoadedScene` is what every
reader of a scene format returns.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.shading_normals import ShadedMesh, face_normals, flat_shaded
from storage.conventions import linear_from_srgb8, look_at_c2w, srgb8
from storage.errors import TrilightError, prefix_errors
from storage.records.lookup import texture_values
from storage.records.material import EMISSION, ROUGHNESS, default_rows, distinct_rows
from storage.records.retextured import with_textures, without_constant_textures
from storage.records.scene import ObjectKind, Scene, SceneObject
from storage.records.texture import CONSTANT, NORMAL, TEXTURED, Environment, MapSource, Texture

Map = NDArray[np.float32]
"""Linear values [H, W, C] of a texture, the bottom row first; a constant is one texel.

numpy broadcasts constants. Where two maps are combined, the smaller one is interpolated at the
texels of the larger one. The resulting textures have 8 bits, as their sources have: float32 would
take four times the memory for digits that no source states.
"""

MAP_ROWS = 256
"""Number of rows of a map that are computed at a time."""

EXCESS = 1e-6
"""Tolerance for the rounding of two float32 albedos that add up to 1."""

Pictures = NDArray[np.float32] | None
"""[V, R, R, 3] linear radiance of all views, or None."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedScene:
    """A scene that was read, with notes on what it lacks."""

    scene: Scene
    """The scene, which passes `Scene.check`."""
    notes: tuple[str, ...]
    """Sentences about unknown fields of the file and what could not be read."""
    radiance_rgb: Pictures = None
    """Pictures of all views, where they were requested and the source has them."""


TextureSet = tuple[Texture | None, Texture | None, Texture | None]
"""Textures in the order of TEXTURED; None where the material column is the value."""

NO_TEXTURES: TextureSet = (None, None, None)

_FOV_DEG = 40.0
"""Field of view of the camera that is added to a scene without cameras."""

MAX_TRIANGLES = 1_500_000
MAX_ROWS = 1 << 16
"""Maximum number of objects, and of materials, in a scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedTriangles:
    """Triangles, each with a material and texture coordinates."""

    positions: NDArray[np.float32]
    """[T, 3, 3] corners in world space, in meters."""
    normals: NDArray[np.float32]
    """[T, 3, 3] unit normals at the corners."""
    rows: NDArray[np.float32]
    """[T, 10 or more] material columns; values of textured columns are ignored."""
    uv: NDArray[np.float32]
    """[T, 3, 2] texture coordinates of the corners; unused where nothing is textured."""
    texture_set_index: NDArray[np.int64]
    """[T] index of each triangle into `texture_sets`."""
    texture_sets: Sequence[TextureSet]
    """Distinct texture sets of the triangles."""

    def select(self, mask: NDArray[np.bool_]) -> "TexturedTriangles":
        """Return the triangles that a mask [T] selects."""
        arrays: dict[str, Any] = {name: getattr(self, name)[mask] for name in _PER_TRIANGLE}
        return dataclasses.replace(self, **arrays)


_PER_TRIANGLE = ("positions", "normals", "rows", "uv", "texture_set_index")


def join_triangles(
    parts: Sequence[TexturedTriangles], places: Sequence[NDArray[np.int64]]
) -> TexturedTriangles:
    """Return the triangles of several parts, in the order of `places` [T], which they cover."""
    order = np.argsort(np.concatenate(places), kind="stable")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])[order]
        for name in _PER_TRIANGLE
    }
    starts = np.cumsum([0, *(len(part.texture_sets) for part in parts)])[:-1]
    arrays["texture_set_index"] += np.repeat(starts, list(map(len, places)))[order]
    texture_sets = [each for part in parts for each in part.texture_sets]
    return TexturedTriangles(**arrays, texture_sets=texture_sets)


def index_corners(
    positions: NDArray[np.float32], normals: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
    """Return positions, normals and faces of corners [T, 3, 3], vertices in order of first use."""
    corners = np.concatenate([positions, normals], axis=2).reshape(-1, 6)
    first, rows = distinct_rows(corners)
    vertices = corners[first]
    faces = rows.astype(np.uint32).reshape(-1, 3)
    return vertices[:, :3].copy(), vertices[:, 3:].copy(), faces


def octahedron() -> NDArray[np.float64]:
    """Return the triangles [8, 3, 3] of an octahedron of radius 1, facing out."""
    faces = np.array(
        [[[x, 0, 0], [0, y, 0], [0, 0, z]] for x in (1, -1) for y in (1, -1) for z in (1, -1)],
        float,
    )
    faces_inward = np.prod(faces.sum(axis=1), axis=1) < 0
    faces[faces_inward] = faces[faces_inward][:, ::-1]
    return faces


def sum_area(triangles: NDArray[np.floating]) -> float:
    """Return the area of triangles [T, 3, 3]."""
    edges = np.diff(triangles.astype(np.float64), axis=1)
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def build_lamp(
    positions: NDArray[np.float32], radiance_rgb: NDArray[np.floating]
) -> TexturedTriangles:
    """Return black triangles [T, 3, 3] that emit a radiance [3]."""
    count = len(positions)
    rows = default_rows(count)
    rows[:, ROUGHNESS] = 1
    rows[:, EMISSION] = radiance_rgb
    corners = positions.reshape(-1, 3)
    flat = flat_shaded(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    return TexturedTriangles(
        positions=positions,
        normals=flat.normals.reshape(-1, 3, 3),
        rows=rows,
        uv=np.zeros((count, 3, 2), np.float32),
        texture_set_index=np.zeros(count, np.int64),
        texture_sets=(NO_TEXTURES,),
    )


def _fit_camera(points: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """Return the pose and angle of a camera that sees all points [N, 3], obliquely from above."""
    low = points.min(axis=0).astype(np.float64)
    high = points.max(axis=0).astype(np.float64)
    center = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    direction = np.array([0.6, -1.0, 0.6]) / np.linalg.norm([0.6, -1.0, 0.6])
    eye = center + direction * radius / math.sin(math.radians(_FOV_DEG) / 2)
    return look_at_c2w(eye=eye, target=center, up=[0, 0, 1]), _FOV_DEG


def rigid_pose(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a transform [4, 4] without its scale; None where it has no direction."""
    backward = matrix[:3, 2]
    right = matrix[:3, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        backward = backward / np.linalg.norm(backward)
        right = right - backward * np.einsum("i,i->", right, backward)
        right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    pose[:3, 3] = matrix[:3, 3]
    return pose if np.isfinite(pose).all() else None


def group_triangles(scene: Scene) -> list[tuple[int, int, NDArray[np.intp]]]:
    """Return (object, material, triangles), sorted by object and then by material."""
    keys = scene.object_index.astype(np.int64) * len(scene.materials) + scene.material_index
    order = np.argsort(keys, kind="stable")
    distinct, starts = np.unique(keys[order], return_index=True)
    return [
        (*divmod(int(key), len(scene.materials)), triangles)
        for key, triangles in zip(distinct, np.split(order, starts[1:]), strict=True)
    ]


def mesh_of_triangles(scene: Scene, triangles: NDArray[Any]) -> ShadedMesh:
    """Return triangles of a scene, by their rows or a mask [T], with the vertices that they use."""
    rows, corners = np.unique(scene.faces[triangles], return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.uint32)
    return ShadedMesh(
        positions=scene.vertex_positions[rows],
        normals=scene.vertex_normals[rows],
        faces=faces,
        groups=np.zeros(len(faces), np.int64),
    )


def is_smooth(mesh: ShadedMesh, tolerance: float) -> bool:
    """Return whether a normal differs by more than a tolerance from that of its triangle."""
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = face_normals(mesh.positions, mesh.faces)  # not finite without an area
        return bool((np.abs(mesh.normals[mesh.faces] - flat[:, None]) > tolerance).any())


class SceneParts:
    """Collects the objects of a scene under unique names, within limits."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._names: dict[str, int] = {}
        self._pieces: list[ScenePiece] = []
        self._surfaces: list[ScenePiece] = []
        self._uv: list[NDArray[np.float32]] = []
        self._texture_sets: list[TextureSet] = []  # of each material row
        self._num_triangles = 0

    def add(
        self, entry: SceneObject, triangles: TexturedTriangles, *, is_lamp: bool = False
    ) -> None:
        """Add the triangles of an object: those that reflect, and those that emit.

        Raises:
            TrilightError: more than MAX_TRIANGLES triangles, or MAX_ROWS objects or materials.
        """
        emits = (triangles.rows[:, EMISSION] > 0).any(axis=1)
        surface_kind: ObjectKind = "shell" if entry.kind == "shell" else "object"
        kinds: tuple[tuple[ObjectKind, Any], ...] = ((surface_kind, ~emits), ("emitter", emits))
        for kind, mask in kinds:
            if not mask.any():
                continue
            name = unique_name(entry.name, self._names)
            unique = dataclasses.replace(entry, name=name, kind=kind)
            self._add_piece(unique, triangles.select(mask))
            self._surfaces += [] if is_lamp else self._pieces[-1:]
        with prefix_errors(self._file):
            require_at_most(
                {
                    "triangles so far": (self._num_triangles, MAX_TRIANGLES),
                    "materials so far": (len(self._texture_sets), MAX_ROWS),
                    "objects so far": (len(self._pieces), MAX_ROWS),
                }
            )

    def _add_piece(self, entry: SceneObject, triangles: TexturedTriangles) -> None:
        positions, normals, faces = index_corners(triangles.positions, triangles.normals)
        rows = triangles.rows
        appearance = np.column_stack([rows, triangles.texture_set_index.astype(np.float32)])
        palette, index = distinct_rows(appearance)
        groups = np.zeros(len(faces), np.int64)
        mesh = ShadedMesh(positions=positions, normals=normals, faces=faces, groups=groups)
        self._pieces.append(
            ScenePiece(entry=entry, mesh=mesh, materials=rows[palette], material_index=index)
        )
        self._uv.append(triangles.uv)
        set_index = triangles.texture_set_index[palette]
        self._texture_sets += [triangles.texture_sets[row] for row in set_index]
        self._num_triangles += len(faces)

    @property
    def has_emitters(self) -> bool:
        """Return whether any triangle emits."""
        return any(piece.entry.kind == "emitter" for piece in self._pieces)

    def surface_points(self) -> NDArray[np.float32]:
        """Return the vertices [V, 3] of all objects; lamps count where nothing else is.

        Raises:
            TrilightError: there are no objects.
        """
        pieces = self._surfaces or self._pieces
        if not pieces:
            raise TrilightError(f"{self._file}: no triangle with an area is placed.")
        return np.concatenate([piece.mesh.positions for piece in pieces])

    def build(
        self,
        cameras: Sequence[tuple[NDArray[np.float64], float] | None],
        sky: Environment | None,
        provenance: Mapping[str, Any],
        lost: list[str],
    ) -> Scene:
        """Build and check the scene; a camera that sees everything is added where there is none.

        `cameras` has the pose [4, 4] and full angle in degrees of each, or None for one that is
        left out, `sky` the environment, if any; `lost` receives a sentence for each loss.
        """
        points = self.surface_points()
        usable = [camera for camera in cameras if camera is not None]
        if not usable:
            lost.append("no camera: one was added that sees everything")
            usable = [_fit_camera(points)]
        scene = Scene(
            **concatenate_pieces(self._pieces),
            objects=tuple(piece.entry for piece in self._pieces),
            c2w=np.stack([pose for pose, _ in usable]).astype(np.float32),
            fov_deg=np.array([angle for _, angle in usable], np.float32),
            provenance=provenance,
            environment=sky,
        )
        scene = add_textures(scene, np.concatenate(self._uv), self._texture_sets)
        scene.check()
        return scene


def add_textures(
    scene: Scene, uv: NDArray[np.floating], texture_sets: Sequence[TextureSet]
) -> Scene:
    """Return a scene with textures for each material, and coordinates [T, 3, 2] of the corners."""
    textures: dict[str, Texture] = {}
    for texture in (each for texture_set in texture_sets for each in texture_set if each):
        textures.setdefault(texture.sha256, texture)
    if not textures:
        return scene
    order = {sha256: row for row, sha256 in enumerate(textures)}
    index = [[order[each.sha256] if each else CONSTANT for each in row] for row in texture_sets]
    corners = uv.reshape(-1, 2).astype(np.float32)
    rows = np.array(index, np.int32)
    return without_constant_textures(with_textures(scene, corners, tuple(textures.values()), rows))


def require_at_most(counts: Mapping[str, tuple[int, int]]) -> None:
    """Raise TrilightError where a count of a scene is larger than its maximum, by what it is of."""
    for what, (count, most) in counts.items():
        if count > most:
            raise TrilightError(f"{count} {what}; expected at most {most} in a scene.")


def unique_name(base: str, counts: dict[str, int], key: Callable[[str], str] = str) -> str:
    """Return an unused name: the base, or with `.2` and so on; `counts` holds keys of all names."""
    count = counts.get(key(base), 0) + 1
    name = base if count == 1 else f"{base}.{count}"
    while count > 1 and key(name) in counts:
        count += 1
        name = f"{base}.{count}"
    counts[key(base)] = count
    counts.setdefault(key(name), 1)
    return name


def constant_map(value: ArrayLike) -> Map:
    """Return a number or a color as a map of one texel."""
    return np.atleast_1d(np.asarray(value, np.float32)).reshape(1, 1, -1)


def linear_map(texture: Texture) -> Map:
    """Return the linear values of a texture."""
    return texture.linear(texture.texels)


def used_textures(scene: Scene, material: int) -> dict[str, tuple[int, Texture]]:
    """Return row and texture of each textured column of a material, and of its normal map."""
    if scene.material_textures is None:
        return {}
    normal = CONSTANT if scene.normal_textures is None else int(scene.normal_textures[material])
    index = [*scene.material_textures[material].tolist(), normal]
    return {
        name: (row, scene.textures[row])
        for name, row in zip((*TEXTURED, NORMAL), index, strict=True)
        if row != CONSTANT
    }


def is_constant(values: Map) -> bool:
    """Return whether a map has one texel."""
    return values.shape[:2] == (1, 1)


def resample_to_largest(*maps: Map) -> tuple[Map, ...]:
    """Interpolate all maps but constants to the size of the largest in each direction.

    The values at the texel centers are those of texture look-ups.
    """
    sizes = {values.shape[:2] for values in maps if not is_constant(values)}
    if len(sizes) < 2:
        return maps
    size = tuple(map(max, zip(*sizes, strict=True)))
    return tuple(
        values if is_constant(values) or values.shape[:2] == size else _resample(values, *size)
        for values in maps
    )


def _resample(values: Map, height: int, width: int) -> Map:
    texture = Texture(texels=values)
    u, v = ((np.arange(count) + 0.5) / count for count in (width, height))
    resampled = np.zeros((height, width, values.shape[2]), np.float32)
    for first in range(0, height, MAP_ROWS):
        uv = np.stack(np.meshgrid(u, v[first : first + MAP_ROWS]), axis=-1)
        resampled[first : first + MAP_ROWS] = texture_values(texture, uv)
    return resampled


def number_texture(values: Map, source: MapSource) -> Texture:
    """Return a linear texture of numbers in [0, 1], in 8 bits unless it is a constant."""
    if is_constant(values):
        return Texture(texels=values, source=source)
    return Texture(texels=np.round(values * 255).astype(np.uint8), source=source)


def color_textures(diffuse: Map, specular: Map, source: MapSource) -> tuple[Texture, Texture]:
    """Return textures of two albedos whose sum is at most 1 at every look-up.

    The diffuse one is lowered where they would add up to more.
    """
    diffuse, specular = resample_to_largest(diffuse, specular)
    glossy = Texture(texels=specular, source=source)
    if not is_constant(specular):
        glossy = Texture(texels=srgb8(specular), is_srgb=True, source=source)
    room = 1 - linear_map(glossy)
    if is_constant(diffuse) and (diffuse <= room.min(axis=(0, 1)) + EXCESS).all():
        return Texture(texels=diffuse, source=source), glossy
    if is_constant(room) and is_constant(diffuse):
        return Texture(texels=np.minimum(diffuse, room), source=source), glossy
    limited = np.minimum(diffuse, room)
    codes = srgb8(limited)
    over = linear_from_srgb8()[codes] > room  # by rounding
    return Texture(texels=codes - over.astype(np.uint8), is_srgb=True, source=source), glossy
