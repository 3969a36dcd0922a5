"""Records of a scene file (objects with mesh paths and materials, cameras), and their `Scene`.

Values are as the file states them. Types, ranges and defaults are those of the file, which
`pipeline.exchange.renderformer_json` reads.

The transform of a mesh follows the order of the published converter: with `normalize`, the mesh is
brought into a sphere of diameter 1 (the mean of the file's vertices becomes the origin, the
farthest vertex lies at 0.5); then it is rotated about the world's X, Y and Z, scaled along the
world's axes, and translated. Vertices are not joined first, so that smooth shading stops where the
mesh file splits its vertices. Template files, whose scales and translations would have to be
halved, are not supported.

Each triangle of an emitter becomes an emitter. It reflects by the albedos that the file states,
since the published renderer's emitters have a white surface. Materials whose albedos add up to more
than 1 are scaled or refused (`limit_albedos`); the provenance names the scaled ones by object.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.textured_triangles import MAX_ROWS, require_at_most
from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.shading_normals import ShadedMesh, flat_shaded, has_area, smooth_shaded
from scene_templates.rotations import rotate_points, rotation_xyz
from storage.conventions import look_at_c2w
from storage.errors import TrilightError, prefix_errors
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR, default_rows
from storage.records.scene import ALBEDO_SUM_TOLERANCE, ObjectKind, Scene, SceneObject
from storage.settings.ranges import Within
from storage.typed_json import Spelled

Vector = tuple[float, float, float]

Lengths = Annotated[Vector, Within(-1e6, 1e6)]
"""Coordinates or factors; beyond 1e6 float32 positions are off by centimeters."""
Angles = Annotated[Vector, Within(-1e6, 1e6, unit="degrees")]
Fraction = Annotated[float, Within(0, 1)]
Albedo = Annotated[Vector, Within(0, 1)]
Radiance = Annotated[Vector, Within(0, 1e9)]

_PRINTABLE = r"(?:[^\p{C}\p{Z}]| )"
PrintableText = Annotated[
    str, Spelled(_PRINTABLE + "{0,200}", "printable text of up to 200 letters")
]

ColorGroups = Literal["per-triangle", "per-shading-group"]


@dataclass(frozen=True, kw_only=True)
class DescribedTransform:
    """Transform of a mesh into world space."""

    translation: Lengths  # world units, the last step
    rotation: Angles  # angles about the world's X, then Y, then Z
    scale: Lengths  # factors along the world's axes, after the rotation; a negative one mirrors
    normalize: bool = True
    """True brings the mesh into a sphere of diameter 1 around the origin first."""


@dataclass(frozen=True, kw_only=True)
class DescribedMaterial:
    """Reflectance and emission of an object; colors are linear."""

    diffuse: Albedo  # diffuse albedo, unless the object has random colors
    specular: Albedo  # specular albedo
    roughness: Fraction  # the GGX width is its square
    emissive: Radiance
    """Radiance of every triangle, to both sides; the object is an emitter where one is above 0."""
    smooth_shading: bool
    """True interpolates normals across edges of up to 30 degrees; False shades flat."""
    random_diffuse_max: Fraction = 1.0  # upper bound of the random colors
    random_diffuse_type: ColorGroups = "per-shading-group"  # triangles that share a random color
    rand_tri_diffuse_seed: Annotated[int, Within(0, 2**32 - 1)] | None = None
    """Seed of random colors that replace `diffuse`; None keeps `diffuse`."""


@dataclass(frozen=True, kw_only=True)
class DescribedObject:
    """One entry of `objects`."""

    name: Annotated[str, Spelled(_PRINTABLE + "{1,200}", "a printable name of 1 to 200 letters")]
    """Name of the object, which is the key of its entry."""
    mesh_path: PrintableText  # relative to the scene file
    transform: DescribedTransform  # from mesh to world space
    material: DescribedMaterial  # reflectance and emission
    remesh: bool = False  # True replaces the mesh by one of even triangles
    remesh_target_face_num: Annotated[int, Within(4, 1_000_000, unit="triangles")] = 2048
    """Maximum number of triangles of the remeshed mesh."""

    @property
    def remesh_faces(self) -> int | None:
        """Maximum number of triangles after remeshing; None where the mesh stays as it is."""
        return self.remesh_target_face_num if self.remesh else None


@dataclass(frozen=True, kw_only=True)
class DescribedCamera:
    """One entry of `cameras`."""

    position: Lengths  # world units
    look_at: Lengths  # the point in the middle of the picture
    up: Lengths  # roughly upwards in the picture; neither unit nor orthogonal
    fov: Annotated[float, Within(0.001, 179, unit="degrees")]
    """Full field of view, horizontal and vertical."""


@dataclass(frozen=True, kw_only=True)
class CameraFile:
    """A file with a list of cameras, which may be a scene file."""

    cameras: tuple[DescribedCamera, ...]  # in the order of the file
    file: str = ""  # its name, for messages and provenance
    unknown_fields: tuple[str, ...] = ()
    """Dotted names of unknown fields, which were left out."""


@dataclass(frozen=True, kw_only=True)
class SceneDescription(CameraFile):
    """One scene file."""

    scene_name: PrintableText  # what its author calls it
    version: Literal["1.0"]
    objects: Mapping[str, DescribedObject]  # by name, in the order of the file


Cameras = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Poses [C, 4, 4] and angles [C] in degrees."""

AlbedoOverOne = Literal["scale", "refuse"]
"""Treatment of materials whose diffuse and specular albedos add up to more than 1."""

SHELL_FOLDER = "templates/backgrounds/"
"""Folder of floors and walls in the published scene files."""

SMOOTH_ANGLE_DEG = 30.0
"""Smoothing angle of the published converter, and where a surface states no normals."""

MAX_TRIANGLES = 1_000_000
MAX_EMITTERS = 4096
"""Maximum numbers of triangles and emitting triangles in a scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedMesh:
    """The mesh of an object, from its file or remeshed."""

    uid: str  # path of the file below the folder of the scenes, with slashes
    licence: str  # SPDX identifier, or `LicenseRef-...`
    positions: NDArray[np.float64]  # [V, 3] in the units of the file
    faces: NDArray[np.int64]  # [F, 3]
    centre: NDArray[np.float64]  # [3] mean of the vertices in the file
    reach: float  # distance of the farthest vertex from `centre`
    unread: tuple[str, ...] = ()  # parts of the file that were ignored
    sha256: str = ""  # digest of the file, in hex


def centre_and_reach(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the mean of points [N, 3], and how far the farthest is from it; 0 of a single point.

    It is also 0 where squares of all distances are below the least number.
    """
    centre = points.mean(axis=0)
    if not np.ptp(points, axis=0).any():  # a mean is rounded
        return centre, 0.0
    return centre, float(np.sqrt(np.sum(np.square(points - centre), axis=1).max()))


def scene_from_description(
    description: SceneDescription,
    meshes: Sequence[LoadedMesh],
    *,
    num_views: int,
    provenance: Mapping[str, Any],
    albedo_over_one: AlbedoOverOne = "scale",
) -> Scene:
    """Build the scene that a file describes, with its first `num_views` cameras.

    Objects are in the order of the file, an emitting object as one object per triangle; `meshes`
    has one per object. The provenance gets `albedo_scale` where materials were scaled.

    Raises:
        TrilightError: an object or camera, which is named, is unusable; or a count is too large.
    """
    pieces: list[ScenePiece] = []
    scales: dict[str, float] = {}
    for described, mesh in zip(description.objects.values(), meshes, strict=True):
        with prefix_errors(f"{description.file}: objects.{described.name}"):
            object_pieces, scale = _pieces(described, mesh, albedo_over_one)
        pieces += object_pieces
        if scale < 1:
            scales[described.name] = round(scale, 6)
    c2w, fov_deg = build_cameras(description.cameras[:num_views], description.file)
    with prefix_errors(description.file):
        emitters = sum(piece.entry.kind == "emitter" for piece in pieces)
        require_at_most(
            {
                "triangles": (sum(len(piece.mesh.faces) for piece in pieces), MAX_TRIANGLES),
                "emitting triangles": (emitters, MAX_EMITTERS),
                "materials": (sum(len(piece.materials) for piece in pieces), MAX_ROWS),
            }
        )
        scene = Scene(
            **concatenate_pieces(pieces),
            c2w=c2w,
            fov_deg=fov_deg,
            objects=tuple(piece.entry for piece in pieces),
            provenance={**provenance, "albedo_scale": scales} if scales else provenance,
        )
        scene.check()
    return scene


def scaled_albedo_notes(scene: Scene) -> tuple[str, ...]:
    """Return a sentence for each object that became darker than its file states."""
    return tuple(
        f"objects.{name}: diffuse + specular is {1 / scale:.4f}, which is more than 1; both were "
        f"multiplied by {scale:.4f}"
        for name, scale in scene.provenance.get("albedo_scale", {}).items()
    )


def _pieces(
    described: DescribedObject, mesh: LoadedMesh, over_one: AlbedoOverOne
) -> tuple[list[ScenePiece], float]:
    """Return the pieces of an object, and the least factor of its materials."""
    material = described.material
    transform = described.transform
    points = mesh.positions
    if transform.normalize:
        points = (points - mesh.centre) / (2 * mesh.reach)
    rotated = rotate_points(points, rotation_xyz(transform.rotation))
    world = rotated * np.array(transform.scale) + np.array(transform.translation)
    positions = world.astype(np.float32)
    mirrored = np.prod(transform.scale) < 0
    faces = (mesh.faces[:, ::-1] if mirrored else mesh.faces).astype(np.uint32)
    faces = faces[has_area(positions, faces)]
    if len(faces) == 0:
        raise TrilightError(
            f"no triangle of {mesh.uid} has an area after its transform; expected at least one."
        )
    names = [described.name]
    diffuse = np.array([material.diffuse])
    kind: ObjectKind = "shell" if mesh.uid.startswith(SHELL_FOLDER) else "object"
    if max(material.emissive) > 0:
        require_at_most({"emitting triangles": (len(faces), MAX_EMITTERS)})
        kind = "emitter"
        parts = [flat_shaded(positions, faces[row : row + 1]) for row in range(len(faces))]
        rows = np.zeros(1, np.int64)
        if len(parts) > 1:
            names = [f"{described.name}.{row}" for row in range(len(parts))]
    else:
        parts = [shade(positions, faces, is_smooth=material.smooth_shading)]
        rows = np.zeros(len(parts[0].faces), np.int64)
        if (seed := material.rand_tri_diffuse_seed) is not None:
            # in the published converter a flat mesh shares no vertices: each triangle is a group
            has_groups = material.random_diffuse_type == "per-shading-group"
            is_grouped = material.smooth_shading and has_groups
            rows = parts[0].groups if is_grouped else np.arange(len(parts[0].faces))
            diffuse = random_diffuse(seed, material.random_diffuse_max, int(rows.max()) + 1)
    diffuse, specular, scale = limit_albedos(diffuse, np.array(material.specular), over_one)
    materials = default_rows(len(diffuse))
    materials[:, DIFFUSE] = diffuse
    materials[:, SPECULAR] = specular
    materials[:, ROUGHNESS] = material.roughness
    materials[:, EMISSION] = material.emissive
    uid = mesh.uid if kind == "object" else ""
    pieces = [
        ScenePiece(
            entry=SceneObject(name=name, kind=kind, uid=uid, licence=mesh.licence),
            mesh=part,
            materials=materials,
            material_index=rows,
        )
        for name, part in zip(names, parts, strict=True)
    ]
    return pieces, scale


def shade(
    positions: NDArray[np.float32], faces: NDArray[np.uint32], *, is_smooth: bool
) -> ShadedMesh:
    """Return a mesh with smooth normals across edges of up to SMOOTH_ANGLE_DEG, or flat ones."""
    if is_smooth:
        return smooth_shaded(positions, faces, SMOOTH_ANGLE_DEG)
    return flat_shaded(positions, faces)


def build_cameras(cameras: Sequence[DescribedCamera], file: str) -> Cameras:
    """Return poses [C, 4, 4] and full angles [C] in degrees; raises TrilightError about a file."""
    poses = []
    for row, camera in enumerate(cameras):
        with np.errstate(divide="ignore", invalid="ignore"):
            c2w = look_at_c2w(eye=camera.position, target=camera.look_at, up=camera.up)
        if not np.isfinite(c2w).all():
            raise TrilightError(
                f"{file}: cameras[{row}] looks from {camera.position} at {camera.look_at} with up "
                f"{camera.up}; expected a distance, and an up that is not along the view."
            )
        poses.append(c2w)
    angles = np.array([camera.fov for camera in cameras], np.float32)
    return np.array(poses, np.float32).reshape(-1, 4, 4), angles


def limit_albedos(
    diffuse: NDArray[np.float64], specular: NDArray[np.float64], over_one: AlbedoOverOne
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return albedos [M, 3] that add up to at most 1, and the least factor that this took.

    A surface beyond 1 reflects more light than it receives; published scene files have some (1.1).
    Both albedos of such a material are multiplied by 1 / their largest sum over the channels. One
    factor for all channels keeps both hues, and one for both albedos keeps their ratio; a factor
    for each channel would bleach a red of 1.1 towards white. Where none of the diffuse albedos [M,
    3] with the specular albedo [3] of all is beyond 1, they are unchanged and the factor is 1.0.

    Raises:
        TrilightError: a material is beyond 1, and `over_one` is "refuse".
    """
    both = np.broadcast_to(specular, diffuse.shape)
    sums = (diffuse + both).max(axis=1)
    beyond = sums > 1 + ALBEDO_SUM_TOLERANCE
    if not beyond.any():
        return diffuse, both, 1.0
    if over_one == "refuse":
        raise TrilightError(
            f"diffuse + specular is {sums.max():.4f}; expected at most 1 in every channel: lower "
            "one, or say --albedo-over-one scale."
        )
    factors = np.where(beyond, 1 / np.where(beyond, sums, 1), 1.0)
    return diffuse * factors[:, None], both * factors[:, None], float(factors.min())


def random_diffuse(seed: int, bound: float, count: int) -> NDArray[np.float64]:
    """Return `count` diffuse albedos [count, 3]: integers below ceil(256 bound), over 255.

    The published converter seeds numpy's legacy Mersenne Twister, also by 0, and draws one triple
    per group, in the order in which trimesh splits the shaded mesh. On flat meshes that is the
    order of faces, and colors are exactly the published ones. On smooth meshes trimesh has another
    order, and other groups where an object has large flat regions; our groups are in the order of
    their first faces, so that the same numbers may fall on other groups than published.

    The published tokens hold the numbers as linear albedos, and so does Trilight. Published renders
    passed them through vertex colors that Blender decodes as sRGB, so the same numbers meant darker
    surfaces there, which Trilight does not imitate.
    """
    generator = np.random.RandomState(seed)
    return generator.randint(0, max(1, math.ceil(256 * bound)), (count, 3)) / 255
