"""What a template proposes: a shell, spheres for objects to fill, emitters, and surfaces.

A layout knows no object meshes. It gives each object a sphere; `pipeline.scenes` puts a mesh in.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Surface:
    """How a shell part or an object reflects, in linear colour."""

    diffuse_scale: float
    """Largest diffuse albedo that a channel may have; plus `specular` at most 1."""
    diffuse_rgb: tuple[float, float, float]
    """Diffuse albedo where the surface has one colour."""
    specular: float
    """Specular albedo, the same in every channel."""
    roughness: float
    """In [0, 1]; the GGX width is its square."""
    smooth: bool
    """Normals interpolated across edges below the smoothing angle; otherwise flat."""
    coloured: bool
    """Many colours, each channel uniform in [0, diffuse_scale], instead of `diffuse_rgb`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShellPart:
    """A floor or wall: a flat patch of 128 triangles that faces the room."""

    name: str
    """floor, wall0, wall1 or wall2."""
    positions: NDArray[np.float64]
    """[81, 3] world units."""
    faces: NDArray[np.uint32]
    """[128, 3], counter-clockwise seen from the room."""
    surface: Surface
    """Its material."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPlacement:
    """Room for one object: a sphere that its mesh is scaled into."""

    centre: NDArray[np.float64]
    """[3] world units."""
    radius: float
    """World units."""
    rotation: NDArray[np.float64]
    """[3, 3], applied to the mesh about the centre."""
    rests: bool
    """The mesh is to be lowered along the floor's normal until it touches; the sphere already
    does, and nothing else is in the way."""
    surface: Surface
    """Its material."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Emitter:
    """One triangle that emits the same radiance from both sides."""

    triangle: NDArray[np.float64]
    """[3, 3] corners in world units."""
    radiance: float
    """The same in every channel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Floor:
    """The plane that objects rest on."""

    point: NDArray[np.float64]
    """[3] a point of it."""
    normal: NDArray[np.float64]
    """[3] unit, upwards."""

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distance of `points` [..., 3] above the plane."""
        return np.einsum("...i,i->...", points - self.point, self.normal)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """A scene without its meshes and cameras."""

    shell: tuple[ShellPart, ...]
    """The floor first."""
    floor: Floor
    """Where objects rest."""
    objects: tuple[ObjectPlacement, ...]
    """Bounding spheres; no two overlap, resting ones leave the way down free."""
    emitters: tuple[Emitter, ...]
    """Outside the room."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPose:
    """One proposed camera."""

    c2w: NDArray[np.float64]
    """[4, 4] camera to world (storage.conventions)."""
    fov_deg: float
    """Full field of view."""
