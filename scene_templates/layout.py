"""Results of a template: a shell, placed objects, emitters and surfaces.

A layout holds no object meshes: an object has a pose, and `pipeline.scenes` puts its mesh there.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

RGB = tuple[float, float, float]
"""Linear, Rec.709 primaries."""


@dataclass(frozen=True, kw_only=True)
class SurfaceLook:
    """Reflectance of a shell part or an object, in linear color."""

    diffuse_scale: float
    """Largest diffuse albedo that a channel may have; plus `specular_rgb` at most 1."""
    diffuse_rgb: RGB
    """Diffuse albedo where the surface has one color."""
    specular_rgb: RGB
    """Linear specular albedo, each channel in [0, 1]."""
    roughness: float
    """Perceptual roughness in [0, 1]; the GGX width is its square."""
    smooth: bool
    """Normals interpolated across edges below the smoothing angle; otherwise flat."""
    colours: Literal["one", "groups", "triangles"]
    """`one`: `diffuse_rgb`. Otherwise a color for each shading group or for each triangle, each
    channel uniform in [0, diffuse_scale]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShellPart:
    """A floor or wall: a flat patch of 128 triangles."""

    name: str
    """floor, wall0, wall1 or wall2."""
    positions: NDArray[np.float64]
    """Grid vertices [81, 3] in world units."""
    faces: NDArray[np.uint32]
    """[128, 3], counter-clockwise seen from the room (but see SeparateSides.wall2_faces_out)."""
    surface: SurfaceLook


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Place of an object: a sphere that its mesh is scaled into, and its rotation."""

    centre: NDArray[np.float64]
    """Center of the bounding sphere [3], world units."""
    radius: float
    """Radius of the bounding sphere, world units."""
    rotation: NDArray[np.float64]
    """[3, 3], applied to the mesh about the centre."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPlacement:
    """An object without its mesh."""

    pose: Pose
    surface: SurfaceLook


@dataclass(frozen=True, kw_only=True, eq=False)
class Emitter:
    """One triangle that emits the same radiance from both sides."""

    triangle: NDArray[np.float64]
    """[3, 3] corners in world units."""
    radiance_rgb: RGB
    """Emitted radiance, linear Rec.709."""
    reflectance: float
    """Diffuse albedo, the same in every channel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """A scene without its meshes and cameras."""

    shell: tuple[ShellPart, ...]
    """Floor and walls; the floor comes first."""
    objects: tuple[ObjectPlacement, ...]
    """Placements in the order of the shapes."""
    emitters: tuple[Emitter, ...]
    """Outside the room, but for those that the settings put inside objects."""
