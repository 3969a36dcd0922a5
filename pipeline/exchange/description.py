"""Records of a scene file: objects with mesh paths and materials, and cameras.

Values are as the file states them; `pipeline.exchange.from_description` interprets them.
"""

from dataclasses import dataclass
from typing import Literal

Vector = tuple[float, float, float]

ColorGroups = Literal["per-triangle", "per-shading-group"]


@dataclass(frozen=True, kw_only=True)
class DescribedTransform:
    """Transform of a mesh into world space."""

    translation: Vector  # world units, the last step
    rotation_deg: Vector  # angles about the world's X, then Y, then Z
    scale: Vector  # factors along the world's axes, after the rotation; a negative one mirrors
    normalize: bool
    """True brings the mesh into a sphere of diameter 1 around the origin first."""


@dataclass(frozen=True, kw_only=True)
class DescribedMaterial:
    """Reflectance and emission of an object; colors are linear."""

    diffuse: Vector  # diffuse albedo, unless the object has random colors
    specular: Vector  # specular albedo
    roughness: float  # in [0, 1]; the GGX width is its square
    emissive: Vector
    """Radiance of every triangle, to both sides; the object is an emitter where one is above 0."""
    smooth_shading: bool
    """True interpolates normals across edges of up to 30 degrees; False shades flat."""
    random_diffuse_max: float  # upper bound of the random colors
    random_diffuse_type: ColorGroups  # triangles that share one random color
    rand_tri_diffuse_seed: int | None
    """Seed of random colors that replace `diffuse`; None keeps `diffuse`."""

    @property
    def emits(self) -> bool:
        """True where the object is an emitter."""
        return max(self.emissive) > 0


@dataclass(frozen=True, kw_only=True)
class DescribedObject:
    """One entry of `objects`."""

    name: str  # key of the entry
    mesh_path: str  # relative to the scene file
    transform: DescribedTransform  # from mesh to world space
    material: DescribedMaterial  # reflectance and emission
    remesh: bool  # True replaces the mesh by one of even triangles
    remesh_target_face_num: int  # maximum number of triangles of the remeshed mesh

    @property
    def remesh_faces(self) -> int | None:
        """Maximum number of triangles after remeshing; None where the mesh stays as it is."""
        return self.remesh_target_face_num if self.remesh else None


@dataclass(frozen=True, kw_only=True)
class DescribedCamera:
    """One entry of `cameras`."""

    position: Vector  # world units
    look_at: Vector  # the point in the middle of the picture
    up: Vector  # roughly upwards in the picture; neither unit nor orthogonal
    fov_deg: float  # full field of view, horizontal and vertical


@dataclass(frozen=True, kw_only=True)
class SceneDescription:
    """One scene file."""

    file: str  # name of the file, for messages and provenance
    scene_name: str  # what its author calls it
    objects: tuple[DescribedObject, ...]  # in the order of the file
    cameras: tuple[DescribedCamera, ...]  # in the order of the file
    unknown_fields: tuple[str, ...]
    """Dotted names of unknown fields, which were left out."""
