"""All triangles as one table that kernels gather from: geometry, shading normals, material.

A row is 29 floats padded to 32, so that a lane loads it as aligned groups of four (5 % faster than
component by component). Nothing about a scene is a literal in the kernel: one kernel serves all.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats
from pipeline.renders.ggx import KernelLobes
from storage.optics.bsdf import bsdf_lobes
from storage.optics.multiscatter import scattered_again
from storage.records.scene import Scene

_GROUPS = 8
"""Groups of four floats per row."""

_TINY = 1e-20


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoint:
    """Hit point of each ray, lane by lane."""

    position: Any
    """Position of the hit, Point3f in meters."""
    geometric_normal: Any
    """Unit normal by the winding of the triangle, Vector3f."""


class SurfaceTable:
    """The triangles `order` of a scene, in that order."""

    def __init__(self, scene: Scene, order: NDArray[np.intp]) -> None:
        corners = scene.vertex_positions[scene.faces[order]]
        normals = scene.vertex_normals[scene.faces[order]]
        lobes = bsdf_lobes(scene.materials[scene.material_index[order]])
        rows = np.concatenate(
            [
                np.concatenate([corners[:, 0], normals[:, 0, 0:1]], axis=1),
                np.concatenate([corners[:, 1] - corners[:, 0], normals[:, 0, 1:2]], axis=1),
                np.concatenate([corners[:, 2] - corners[:, 0], normals[:, 0, 2:3]], axis=1),
                normals[:, 1:].reshape(-1, 6),
                lobes.diffuse,
                lobes.specular,
                lobes.alpha[:, None],
                lobes.weight[:, None],
                scattered_again(lobes.specular, lobes.alpha, "correlated"),
            ],
            axis=1,
        )
        padded = np.zeros((len(rows), 4 * _GROUPS), np.float32)
        padded[:, : rows.shape[1]] = rows
        self._rows = own_floats(padded)

    def point(self, triangle: Any, barycentric: Any, active: Any) -> SurfacePoint:
        """Return the point at barycentric coordinates (weights of the 2nd and 3rd corner)."""
        first = self._group(triangle, 0, active)
        edge1 = self._group(triangle, 1, active)
        edge2 = self._group(triangle, 2, active)
        edge1 = mi.Vector3f(edge1.xyz)
        edge2 = mi.Vector3f(edge2.xyz)
        position = mi.Point3f(first.xyz) + edge1 * barycentric.x + edge2 * barycentric.y
        return SurfacePoint(
            position=mi.Point3f(position), geometric_normal=dr.normalize(dr.cross(edge1, edge2))
        )

    def shading(self, triangle: Any, barycentric: Any, active: Any) -> tuple[Any, KernelLobes]:
        """Return the interpolated unit normal (Vector3f, not yet turned) and the material."""
        groups = [self._group(triangle, row, active) for row in range(_GROUPS)]
        normal0 = mi.Vector3f(groups[0].w, groups[1].w, groups[2].w)
        normal1 = mi.Vector3f(groups[3].x, groups[3].y, groups[3].z)
        normal2 = mi.Vector3f(groups[3].w, groups[4].x, groups[4].y)
        weight0 = 1 - barycentric.x - barycentric.y
        normal = normal0 * weight0 + normal1 * barycentric.x + normal2 * barycentric.y
        lobes = KernelLobes(
            diffuse=mi.Color3f(groups[4].z, groups[4].w, groups[5].x),
            specular=mi.Color3f(groups[5].y, groups[5].z, groups[5].w),
            alpha=groups[6].x,
            weight=groups[6].y,
            multiscatter=mi.Color3f(groups[6].z, groups[6].w, groups[7].x),
        )
        # Opposite normals may cancel: a zero normal reflects nothing, where 0 / 0 would spread.
        length_sq = dr.maximum(dr.squared_norm(normal), _TINY)
        return normal * dr.rsqrt(length_sq), lobes

    def _group(self, triangle: Any, group: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, triangle * _GROUPS + group, active)
