"""Normal maps: the definition by which kernels are tested.

A map says where the shading normal of a material points, in the frame of the unmapped one: x along
the direction in which u grows on the triangle, at right angles to that normal, z along the normal,
and y = z cross x. A texel holds (x + 1) / 2, (y + 1) / 2 and (z + 1) / 2. That is the frame of
Mitsuba's BSDF `normalmap`, and on charts that are not mirrored that of glTF and of Blender.
"""

import numpy as np
from numpy.typing import NDArray

FLAT = (0.5, 0.5, 1.0)
"""Texel that leaves the normal as it is."""

LEAST_Z = 0.01
"""Least z of a normal before it has unit length: a surface shows no side that it does not have."""

LEAST_TANGENT_SQ = 1e-6
"""Least square of the length of a u direction at right angles to the normal: else no frame."""

_LEAST_AREA = 1e-12
"""Least area of a triangle on the texture, over the squares of its edges there."""


def u_directions(corners: NDArray[np.floating], uv: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit directions [T, 3] in which u grows on triangles; 0 where they have none.

    Args:
        corners: [T, 3, 3] positions.
        uv: [T, 3, 2] texture coordinates of the corners.
    """
    edges = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    steps = (uv[:, 1:].astype(np.float64) - uv[:, :1]).astype(np.float64)
    du, dv = np.moveaxis(steps, -1, 0)
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    along = (dv[:, 1:] * edges[:, 0] - dv[:, :1] * edges[:, 1]) * np.sign(area)[:, None]
    is_chart = np.abs(area) > _LEAST_AREA * np.square(steps).sum(axis=(1, 2))
    return unit_or_zero(np.where(is_chart[:, None], along, 0))


def mapped_normals(
    normals: NDArray[np.floating], u_direction: NDArray[np.floating], texels: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return shading normals [..., 3] by their map; unmapped where a frame has no u direction.

    Args:
        normals: [..., 3] unit, unmapped.
        u_direction: [..., 3] as of `u_directions`.
        texels: [..., 3] linear values of the map.
    """
    along = (u_direction * normals).sum(axis=-1, keepdims=True)
    tangent = u_direction - along * normals
    length_sq = np.square(tangent).sum(axis=-1, keepdims=True)
    is_frame = length_sq > LEAST_TANGENT_SQ
    tangent = tangent / np.sqrt(np.where(is_frame, length_sq, 1))
    x, y, z = np.split(2 * np.asarray(texels, np.float64) - 1, 3, axis=-1)
    bitangent = np.cross(normals, tangent)
    mapped = x * tangent + y * bitangent + np.maximum(z, LEAST_Z) * normals
    with np.errstate(invalid="ignore"):
        mapped = mapped / np.sqrt(np.square(mapped).sum(axis=-1, keepdims=True))
    return np.where(is_frame, mapped, normals)


def unit_or_zero(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors [..., 3] at unit length; those without length, or not finite, are 0."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scaled = vectors / np.abs(vectors).max(axis=-1, keepdims=True, initial=0)
        units = scaled / np.sqrt(np.square(scaled).sum(axis=-1, keepdims=True))
    return np.where(np.isfinite(units), units, 0)
