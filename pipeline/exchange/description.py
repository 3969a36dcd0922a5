"""What a scene file describes: objects by the paths of their meshes, materials, and cameras.

Values are as the file states them; `pipeline.exchange.from_description` says what they mean.
"""

from dataclasses import dataclass
from typing import Literal

Vector = tuple[float, float, float]

ColorGroups = Literal["per-triangle", "per-shading-group"]


@dataclass(frozen=True, kw_only=True)
class DescribedTransform:
    """How a mesh comes to its place."""

    translation: Vector  # world units, the last step
    rotation_deg: Vector  # angles about the world's X, then Y, then Z
    scale: Vector  # factors along the world's axes, after the rotation; a negative one mirrors
    normalize: bool
    """Whether the mesh is first brought into a sphere of diameter 1 around the origin."""


@dataclass(frozen=True, kw_only=True)
class DescribedMaterial:
    """How an object reflects or emits; colours are linear."""

    diffuse: Vector  # diffuse albedo, unless the object has random colours
    specular: Vector  # specular albedo
    roughness: float  # in [0, 1]; the GGX width is its square
    emissive: Vector
    """Radiance of every triangle, to both sides; the object is an emitter where one is above 0."""
    smooth_shading: bool
    """Whether normals are interpolated across edges of up to 30 degrees; flat otherwise."""
    random_diffuse_max: float  # bound of the random colours
    random_diffuse_type: ColorGroups  # what shares one random colour
    rand_tri_diffuse_seed: int | None
    """Seed of random colours that replace `diffuse`; None for none."""

    @property
    def emits(self) -> bool:
        """Whether the object is an emitter."""
        return max(self.emissive) > 0


@dataclass(frozen=True, kw_only=True)
class DescribedObject:
    """One entry of `objects`."""

    name: str  # its key
    mesh_path: str  # relative to the scene file
    transform: DescribedTransform  # how its mesh comes to its place
    material: DescribedMaterial  # what it is made of
    remesh: bool  # whether the mesh is replaced by one of even triangles
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
