"""Records of a scene file: objects with mesh paths and materials, and cameras.

Values are as the file states them; `pipeline.exchange.from_description` interprets them. Types,
ranges and defaults are those of the file, which `pipeline.exchange.renderformer_json` reads.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from storage.settings.ranges import Within

Vector = tuple[float, float, float]

_Length = Annotated[float, Within(-1e6, 1e6)]
Lengths = tuple[_Length, _Length, _Length]
"""Coordinates or factors; beyond 1e6 float32 positions are off by centimeters."""
_Angle = Annotated[float, Within(-1e6, 1e6, unit="degrees")]
Angles = tuple[_Angle, _Angle, _Angle]
Fraction = Annotated[float, Within(0, 1)]
Albedo = tuple[Fraction, Fraction, Fraction]
_Radiance = Annotated[float, Within(0, 1e9)]
Radiance = tuple[_Radiance, _Radiance, _Radiance]

ColorGroups = Literal["per-triangle", "per-shading-group"]


@dataclass(frozen=True, kw_only=True)
class DescribedTransform:
    """Transform of a mesh into world space."""

    translation: Lengths  # world units, the last step
    rotation_deg: Angles  # angles about the world's X, then Y, then Z
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
    fov_deg: Annotated[float, Within(0.001, 179, unit="degrees")]
    """Full field of view, horizontal and vertical."""


@dataclass(frozen=True, kw_only=True)
class SceneDescription:
    """One scene file."""

    file: str  # name of the file, for messages and provenance
    scene_name: str  # what its author calls it
    objects: tuple[DescribedObject, ...]  # in the order of the file
    cameras: tuple[DescribedCamera, ...]  # in the order of the file
    unknown_fields: tuple[str, ...]
    """Dotted names of unknown fields, which were left out."""
