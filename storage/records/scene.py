"""`Scene`: all that a picture requires, and nothing that a modelling program could add.

A scene is a handful of plain arrays. Every stage after composition reads this record and no
other; `check` states its laws, and names the first place where one is broken.

A scene that has no textures has no texture coordinates and no `material_textures` either: the three
come together. A texture stands in the place of one of the columns TEXTURED; what the material row
itself says there counts for nothing, and is by convention the texture's mean, for readers that know
no textures. Or it is a normal map, which stands in the place of no column.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from storage.records.lookup import texture_values
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    SPECULAR,
    column_places,
    laid_out,
    material_width,
)
from storage.records.scene_laws import broken_law, require_array, require_law, require_rotations
from storage.records.texture import CONSTANT, MAX_MAPS_BYTES, TEXTURED, Environment, Texture
from storage.settings.fields import describe_fields
from storage.settings.ranges import FLOAT32_MAX, Within

ObjectKind = Literal["object", "shell", "emitter"]
OBJECT_KINDS: tuple[ObjectKind, ...] = ("object", "shell", "emitter")

ALBEDO_SUM_TOLERANCE = 1e-5
"""Two float32 albedos that are meant to add up to 1 may exceed it by their rounding."""

UNIT_NORMAL_TOLERANCE = 1e-4
"""A float32 unit vector is exact to 1e-7; 1e-4 admits normals that passed through half floats."""

FINITE = Within(-FLOAT32_MAX, FLOAT32_MAX)
"""Any float32 but NaN and infinity."""

MAX_POSITION_M = 10_000.0
"""Farthest coordinate of a vertex, so that a city fits. Float32 knows such points to 0.5 mm; path
tracers bring large scenes to about a metre first."""

POSITION = Within(-MAX_POSITION_M, MAX_POSITION_M, unit="m")
"""Range of a vertex coordinate."""

MAX_TEXTURES = 4096
"""Most textures of a scene."""

MAX_UV = 1024.0
"""Farthest texture coordinate. Float32 knows such ones to 6e-5, which is one texel of the largest
texture."""

COMPONENT = Within(-1 - UNIT_NORMAL_TOLERANCE, 1 + UNIT_NORMAL_TOLERANCE)
"""Range of a component of a unit vector."""


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """Identity and rights of an object that `object_index` points to; no geometry."""

    name: str
    """Unique within the scene, for people and for exported files."""
    kind: ObjectKind
    """`object` for an asset, `shell` for a floor or wall, `emitter` for a light."""
    uid: str = ""
    """The asset's uid, also of its parts that emit; empty for shells and lamps."""
    licence: str = "CC0-1.0"
    """SPDX identifier, or `LicenseRef-...`; shells and lamps are ours, hence CC0."""
    attribution: str = ""
    """Author to credit, as the source states it."""
    source_url: str = ""

    @property
    def is_lamp(self) -> bool:
        """True: an emitter of the layout, not a component of an object that emits."""
        return self.kind == "emitter" and not self.uid


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A triangle scene with palette materials, emitters and cameras, in world space."""

    vertex_positions: Annotated[NDArray[np.float32], POSITION]
    """[V, 3] world units, metres."""
    vertex_normals: Annotated[NDArray[np.float32], COMPONENT]
    """[V, 3] unit shading normals; a flat face has three vertices of its own."""
    faces: Annotated[NDArray[np.uint32], Within(0, 2**32 - 1)]
    """[T, 3] rows of `vertex_positions`, counter-clockwise seen from outside."""
    material_index: Annotated[NDArray[np.uint16], Within(0, 2**16 - 1)]
    """Row of `materials` of each triangle [T]."""
    materials: NDArray[np.float32]
    """[M, 10 or more] the declared columns: diffuse rgb, specular rgb, roughness, emission rgb, and
    those that were added (storage.records.material)."""
    object_index: Annotated[NDArray[np.uint16], Within(0, 2**16 - 1)]
    """Row of `objects` of each triangle [T]."""
    c2w: Annotated[NDArray[np.float32], FINITE]
    """[C, 4, 4] camera to world."""
    fov_deg: Annotated[
        NDArray[np.float32], Within(0, 180, low_open=True, high_open=True, unit="degrees")
    ]
    """[C] full field of view in degrees."""
    objects: tuple[SceneObject, ...]
    """Names, kinds and rights; shell parts and emitters are objects too."""
    provenance: Mapping[str, Any]
    """template, scene index, attempt, seed, settings digest: JSON values only."""
    uv: Annotated[NDArray[np.float32], Within(-MAX_UV, MAX_UV)] | None = None
    """[3T, 2] texture coordinates of each corner of each triangle; None where nothing is textured.
    """
    textures: tuple[Texture, ...] = ()
    """Textures of the materials; each is used, and each content is there once."""
    material_textures: Annotated[NDArray[np.int32], Within(CONSTANT, MAX_TEXTURES - 1)] | None = (
        None
    )
    """[M, 3] rows of `textures` that stand for diffuse, specular and roughness of each material, or
    -1 where its own column does; None where nothing is textured."""
    normal_textures: Annotated[NDArray[np.int32], Within(CONSTANT, MAX_TEXTURES - 1)] | None = None
    """[M] rows of `textures` that are the normal map of each material (storage.records.lookup),
    or -1 for none; None where no material has one."""
    environment: Environment | None = None
    """Light from far away; None where there is none."""

    @property
    def num_triangles(self) -> int:
        return len(self.faces)

    @property
    def num_views(self) -> int:
        return len(self.c2w)

    @property
    def triangle_emits(self) -> NDArray[np.bool_]:
        """[T] whether the triangle emits light; its albedos say what it reflects."""
        material_emits: NDArray[np.bool_] = np.any(self.materials[:, EMISSION] > 0, axis=1)
        return material_emits[self.material_index]

    @property
    def licences(self) -> tuple[str, ...]:
        """Licence of every object, texture and environment map, in this order."""
        sky = () if self.environment is None else (self.environment.source.licence,)
        textures = (texture.source.licence for texture in self.textures)
        return (*(entry.licence for entry in self.objects), *textures, *sky)

    def with_cameras(self, c2w: NDArray[np.float32], fov_deg: NDArray[np.float32]) -> "Scene":
        """Return the same scene seen by other cameras ([C, 4, 4] and [C])."""
        return dataclasses.replace(self, c2w=c2w, fov_deg=fov_deg)

    def with_provenance(self, provenance: Mapping[str, Any]) -> "Scene":
        """Return the same scene with another record of its origin."""
        return dataclasses.replace(self, provenance=provenance)

    def check(self) -> None:
        """Raise TrilightError at the first broken law.

        The message names the field, the value found, the range expected and the first offending
        index. Not checked here, because it needs ray casting: whether cameras lie outside the
        meshes and whether light reaches what they see (pipeline.scenes does that).
        """
        _check_arrays(self)
        _check_maps(self)
        _check_geometry(self)
        _check_materials(self)
        _check_objects(self)
        _check_cameras(self)


ARRAY_FIELDS: Mapping[str, tuple[type, tuple[int | None, ...]]] = {
    "vertex_positions": (np.float32, (None, 3)),
    "vertex_normals": (np.float32, (None, 3)),
    "faces": (np.uint32, (None, 3)),
    "material_index": (np.uint16, (None,)),
    "materials": (np.float32, (None, None)),
    "object_index": (np.uint16, (None,)),
    "c2w": (np.float32, (None, 4, 4)),
    "fov_deg": (np.float32, (None,)),
}
"""dtype and shape of every array field; None is any length, or as many as columns are declared."""

MAP_ARRAYS: Mapping[str, tuple[type, tuple[int | None, ...]]] = {
    "uv": (np.float32, (None, 2)),
    "material_textures": (np.int32, (None, len(TEXTURED))),
    "normal_textures": (np.int32, (None,)),
}
"""dtype and shape of the array fields that only textured scenes have."""

_EQUALLY_LONG = (
    ("vertex_normals", "vertex_positions"),
    ("fov_deg", "c2w"),
    ("material_index", "faces"),
    ("object_index", "faces"),
)


_ROWS_OF = (
    ("faces", "vertex_positions"),
    ("material_index", "materials"),
    ("object_index", "objects"),
)


def _check_arrays(scene: Scene) -> None:
    for name, (dtype, shape) in ARRAY_FIELDS.items():
        array = getattr(scene, name)
        require_array(array, name, dtype, shape)
        if np.issubdtype(dtype, np.floating):
            require_law(np.isfinite(array), name, array, "finite values")
    _check_columns(scene)
    for field in describe_fields(Scene):
        values = getattr(scene, field.name)
        if field.within is None or values is None:
            continue
        require_law(field.within.holds(values), field.name, values, str(field.within))
    for name, other in _EQUALLY_LONG:
        got = len(getattr(scene, name))
        expected = len(getattr(scene, other))
        if got != expected:
            broken_law(f"{name} has {got} rows", f"{expected}, as {other} has")
    for name, rows in _ROWS_OF:
        array = getattr(scene, name)
        count = len(getattr(scene, rows))
        require_law(array < count, name, array, f"rows below {count}")


def _check_columns(scene: Scene) -> None:
    """Check the width of a material row, and the ranges of its columns."""
    got = scene.materials.shape
    expected = material_width()
    if got[1] != expected:
        broken_law(
            f"materials has shape {got}",
            f"(None, {expected}), since its columns are {', '.join(column_places())}",
        )
    for column, part in laid_out():
        holds = np.ones(got, np.bool_)
        holds[:, part] = column.within.holds(scene.materials[:, part])
        require_law(holds, "materials", scene.materials, f"{column.name} {column.within}")


def _check_geometry(scene: Scene) -> None:
    if scene.num_triangles == 0:
        broken_law("faces is empty", "at least one triangle")
    length = np.linalg.norm(scene.vertex_normals, axis=1)
    require_law(abs(length - 1) <= UNIT_NORMAL_TOLERANCE, "vertex_normals", length, "unit length")


def _check_materials(scene: Scene) -> None:
    total = scene.materials[:, DIFFUSE] + scene.materials[:, SPECULAR]
    bound = 1 + ALBEDO_SUM_TOLERANCE
    require_law(total <= bound, "materials", total, "diffuse + specular at most 1")
    sky = scene.environment
    if not scene.triangle_emits.any() and not (sky is not None and sky.radiance_rgb.any()):
        broken_law("materials holds no emission that a triangle uses", "at least one emitter")


def _check_objects(scene: Scene) -> None:
    for name, count in Counter(entry.name for entry in scene.objects).items():
        if count > 1:
            broken_law(f"objects holds the name {name!r} twice", "unique names")
    is_emitter = np.array([entry.kind == "emitter" for entry in scene.objects])
    agrees = is_emitter[scene.object_index] == scene.triangle_emits
    require_law(
        agrees, "objects", scene.object_index, "kind emitter exactly where a triangle emits"
    )


def _check_cameras(scene: Scene) -> None:
    if scene.num_views == 0:
        broken_law("c2w is empty", "at least one camera")
    require_rotations(scene.c2w[:, :3, :3], "c2w", scene.c2w)
    bottom = (scene.c2w[:, 3] == np.array([0, 0, 0, 1])).all(axis=1)
    require_law(bottom, "c2w", scene.c2w, "a last row of 0 0 0 1")


_BLOCK = 256  # rows of a texture that are compared at a time


def _check_maps(scene: Scene) -> None:
    """Raise TrilightError at the first broken law of textures and environment."""
    held = [texture.texels.nbytes for texture in scene.textures]
    if scene.environment is not None:
        held.append(scene.environment.radiance_rgb.nbytes)
    if sum(held) > MAX_MAPS_BYTES:
        broken_law(f"textures and environment take {sum(held)} bytes", f"at most {MAX_MAPS_BYTES}")
    if scene.environment is not None:
        scene.environment.check()
    together = (scene.uv is not None, scene.material_textures is not None, bool(scene.textures))
    if any(together) and not all(together):
        missing = ("uv", "material_textures", "textures")[together.index(False)]
        broken_law(f"{missing} is missing", "uv, material_textures and textures, or none of them")
    if scene.normal_textures is not None and not scene.textures:
        broken_law("normal_textures is there without textures", "both, or no normal_textures")
    if scene.textures:
        for name, (dtype, (_, *widths)) in MAP_ARRAYS.items():
            length = 3 * scene.num_triangles if name == "uv" else len(scene.materials)
            if (array := getattr(scene, name)) is not None:
                require_array(array, name, dtype, (length, *widths))
        _check_textures(scene)
        _check_albedo_sums(scene)


def _check_textures(scene: Scene) -> None:
    count = len(scene.textures)
    seen = set[str]()
    for row, texture in enumerate(scene.textures):
        texture.check(f"textures[{row}]")
        if texture.sha256 in seen:
            broken_law(f"textures[{row}] has the content of another", "each content once")
        seen.add(texture.sha256)
    index = scene.material_textures
    assert index is not None
    normals = np.zeros(0, np.int32) if scene.normal_textures is None else scene.normal_textures
    for name, rows in (("material_textures", index), ("normal_textures", normals)):
        lawful = (rows >= CONSTANT) & (rows < count)
        require_law(lawful, name, rows, f"rows below {count}, or {CONSTANT} for none")
    unused = np.setdiff1d(np.arange(count), np.append(index, normals))
    if len(unused):
        broken_law(f"textures[{unused[0]}] is used by no material", "textures that are used")
    widths = {column.name: column.width for column, _ in laid_out()}
    for place, name in enumerate(TEXTURED):
        for row in np.unique(index[:, place][index[:, place] != CONSTANT]):
            if (got := scene.textures[row].channels) != widths[name]:
                broken_law(f"textures[{row}] has {got} channels", f"{widths[name]}, as {name} has")
    for row in np.unique(normals[normals != CONSTANT]):
        texture = scene.textures[row]
        if texture.channels != 3 or texture.is_srgb:
            got = f"{texture.channels} channels{', sRGB-encoded' if texture.is_srgb else ''}"
            broken_law(f"textures[{row}] has {got}", "3 linear channels, as a normal map has")


def _check_albedo_sums(scene: Scene) -> None:
    """Raise TrilightError where textured albedos add up to more than 1 at any place."""
    assert scene.material_textures is not None
    index = scene.material_textures[:, :2]
    bound = 1 + ALBEDO_SUM_TOLERANCE
    for row in np.flatnonzero((index != CONSTANT).any(axis=1)):
        diffuse, specular = (
            scene.textures[texture]
            if texture != CONSTANT
            else Texture(texels=scene.materials[row : row + 1, None, part])
            for part, texture in zip((DIFFUSE, SPECULAR), index[row], strict=True)
        )
        albedo_sum = diffuse.greatest + specular.greatest  # whatever meets what
        if CONSTANT not in index[row] and not (albedo_sum <= bound).all():
            albedo_sum = _greatest_sum(diffuse, specular)
        name = f"materials[{row}] with its textures: diffuse + specular"
        require_law(albedo_sum <= bound, name, albedo_sum, "at most 1 at every texture coordinate")


def _greatest_sum(one: Texture, other: Texture) -> NDArray[np.float64]:
    """Return the greatest sum [3] of two textures over all texture coordinates.

    Between the centres of texels of either one, the sum is bilinear, and has its extremes at the
    corners of such a cell: where a centre's u of one or the other meets a centre's v.
    """
    u, v = (
        np.union1d(*((np.arange(side) + 0.5) / side for side in sides))
        for sides in (
            (one.texels.shape[1], other.texels.shape[1]),
            (one.texels.shape[0], other.texels.shape[0]),
        )
    )
    greatest = np.zeros(3)
    for first in range(0, len(v), _BLOCK):
        uv = np.stack(np.meshgrid(u, v[first : first + _BLOCK]), axis=-1)
        total = texture_values(one, uv) + texture_values(other, uv)
        greatest = np.maximum(greatest, total.max(axis=(0, 1)))
    return greatest
