"""All triangles as one table that kernels gather from: geometry, shading normals, material.

A row is 29 floats padded to 32, so that a lane loads it as aligned groups of four (5 % faster than
component by component). Nothing about a scene is a literal in the kernel: one kernel serves all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_floats, own_integers
from pipeline.renders.ggx import KernelLobes
from storage.optics import MIN_ALPHA, ROUGHNESS_STEPS, bsdf_lobes, mean_albedo, scattered_again
from storage.records.lookup import LEAST_TANGENT_SQ, LEAST_Z, u_directions
from storage.records.scene import Scene
from storage.records.texture import TEXTURED, Texture

_GROUPS = 8
"""Groups of four floats per row."""

_TINY = 1e-20


@dataclass(kw_only=True, eq=False)
class Hit:
    """What rays meet, lane by lane; a variable of loops, in which Dr.Jit sets its fields."""

    distance: Any
    """Length of the ray, Float."""
    triangle: Any
    """Triangle number, UInt32; surfaces first, then emitters."""
    barycentric: Any
    """Weights of the 2nd and 3rd corner, Point2f."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoint:
    """Hit point of each ray, lane by lane."""

    position: Any
    """Position of the hit, Point3f in meters."""
    geometric_normal: Any
    """Unit normal by the winding of the triangle, Vector3f."""


class SurfaceTable:
    """The triangles `order` of a scene, in that order.

    Where a scene has textures, the material is found at each place instead. Scenes without them
    have another kernel.
    """

    def __init__(self, scene: Scene, order: NDArray[np.intp]) -> None:
        corners = scene.vertex_positions[scene.faces[order]]
        normals = scene.vertex_normals[scene.faces[order]]
        lobes = bsdf_lobes(scene.materials[scene.material_index[order]])
        # The first corner and both edges from it, each with a component of the first normal.
        edges = np.concatenate([corners[:, :1], corners[:, 1:] - corners[:, :1]], axis=1)
        rows = [
            np.concatenate([edges, normals[:, 0, :, None]], axis=2).reshape(-1, 12),
            normals[:, 1:].reshape(-1, 6),
            lobes.diffuse,
            lobes.specular,
            lobes.alpha,
            lobes.weight,
            scattered_again(lobes.specular, lobes.alpha, "correlated"),
            np.zeros((len(order), 3)),
        ]
        self._rows = own_floats(np.column_stack(rows))
        self._textures = KernelTextures(scene, order) if scene.textures else None

    def point(self, hit: Hit, active: Any) -> SurfacePoint:
        """Return the point of a hit."""
        first, edge1, edge2 = (self._group(hit.triangle, group, active) for group in range(3))
        edge1 = mi.Vector3f(edge1.xyz)
        edge2 = mi.Vector3f(edge2.xyz)
        position = mi.Point3f(first.xyz) + edge1 * hit.barycentric.x + edge2 * hit.barycentric.y
        return SurfacePoint(
            position=mi.Point3f(position), geometric_normal=dr.normalize(dr.cross(edge1, edge2))
        )

    def shading(self, hit: Hit, active: Any) -> tuple[Any, KernelLobes]:
        """Return the interpolated unit normal (Vector3f, not yet turned) and the material."""
        barycentric = hit.barycentric
        groups = [self._group(hit.triangle, row, active) for row in range(_GROUPS)]
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
        normal = normal * dr.rsqrt(length_sq)
        if self._textures is not None:
            lobes = self._textures.lobes(hit, lobes, active)
        return normal, lobes

    def mapped_normal(self, normal: Any, hit: Hit, active: Any) -> Any:
        """Return the normal (Vector3f) of `shading` by its map; None where the scene has no map."""
        return self._textures and self._textures.mapped_normal(normal, hit, active)

    def _group(self, triangle: Any, group: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, triangle * _GROUPS + group, active)


_COLOUR = 4
"""Floats of a color texel, padded so that a lane loads it as an aligned group."""

_NUMBER = 1
"""Floats of a texel of numbers."""

_BLOCK = 1 << 16
"""Texels that are decoded at a time."""


class KernelTextures:
    """Textures of triangles, by the lookup of storage.records.lookup in single precision.

    All texels of a scene lie in one array of linear values, colors before numbers: a kernel serves
    any number of textures of any size. Texture coordinates are interpolated between the corners of
    a triangle, and bilinearly looked up there; both repeat.

    A color takes 16 bytes in a kernel and a number 4: 6 to 12 MB for the usual scene, and 2.9 GB
    for the largest one that storage admits (MAX_MAPS_BYTES of 8-bit colors), twice while it is
    loaded. In 8 bits, decoded in the kernel, they would take a quarter; a pass took 5 to 8 % longer
    (study S28). Not a dataclass: Dr.Jit would take its arrays for loop variables.
    """

    def __init__(self, scene: Scene, order: NDArray[np.intp]) -> None:
        """Take the textures of the triangles `order` of a scene that has some, in that order."""
        assert scene.uv is not None and scene.material_textures is not None
        corners = scene.uv.reshape(-1, 3, 2)[order].astype(np.float64)
        # Whole turns change no lookup; without them float32 keeps its digits for the rest.
        corners -= np.floor(corners.min(axis=1, keepdims=True))
        self._corners = own_floats(np.pad(corners.reshape(-1, 6), ((0, 0), (0, 2))))
        self._material = own_integers(scene.material_index[order])
        # By row of a texture: first texel, width, height and 1. The last row is that of CONSTANT.
        lookups = np.zeros((len(scene.textures) + 1, 4), np.uint32)
        self._colours = _load_texels(scene.textures, 3, _COLOUR, lookups)
        self._numbers = _load_texels(scene.textures, 1, _NUMBER, lookups)
        self._rows = own_integers(lookups[scene.material_textures])
        roughness = np.linspace(0, 1, ROUGHNESS_STEPS)
        self._mean_albedo = own_floats(mean_albedo(np.square(roughness), "correlated"))
        self._u_directions: Any = None
        if scene.normal_textures is None:
            return
        self._maps = own_integers(lookups[scene.normal_textures])
        positions = scene.vertex_positions[scene.faces[order]]
        self._u_directions = own_floats(np.pad(u_directions(positions, corners), ((0, 0), (0, 1))))

    def mapped_normal(self, normal: Any, hit: Hit, active: Any) -> Any:
        """Return the unit normal (Vector3f) of storage.records.lookup; None without any map.

        Args:
            normal: Vector3f, unit, unmapped.
            hit: place on the surface.
            active: Bool.
        """
        if self._u_directions is None:
            return None
        u, v, material = self._place(hit, active)
        texture = dr.gather(mi.Vector4u, self._maps, material, active)
        row: Any = dr.gather(mi.Vector4f, self._u_directions, hit.triangle, active)
        along = mi.Vector3f(row.xyz)
        tangent = along - normal * dr.dot(along, normal)
        length_sq = dr.squared_norm(tangent)
        is_mapped = active & (texture.w > 0) & (length_sq > LEAST_TANGENT_SQ)
        tangent *= dr.rsqrt(dr.maximum(length_sq, LEAST_TANGENT_SQ))
        texel = 2 * self._bilinear(mi.Color3f, texture, u, v, is_mapped) - 1
        bitangent = dr.cross(normal, tangent)
        z = dr.maximum(texel.z, LEAST_Z)
        mapped = dr.normalize(tangent * texel.x + bitangent * texel.y + normal * z)
        return dr.select(is_mapped, mapped, normal)

    def _place(self, hit: Hit, active: Any) -> tuple[Any, Any, Any]:
        """Return u and v in [0, 1] (Float), and the material (UInt32), of a place."""
        triangle = hit.triangle
        barycentric = hit.barycentric
        near = dr.gather(mi.Vector4f, self._corners, triangle * 2, active)
        far = dr.gather(mi.Vector4f, self._corners, triangle * 2 + 1, active)
        weight = 1 - barycentric.x - barycentric.y
        u = weight * near.x + barycentric.x * near.z + barycentric.y * far.x
        v = weight * near.y + barycentric.x * near.w + barycentric.y * far.y
        material = dr.gather(mi.UInt32, self._material, triangle, active)
        return u - dr.floor(u), v - dr.floor(v), material

    def lobes(self, hit: Hit, constant: KernelLobes, active: Any) -> KernelLobes:
        """Return the material of a place.

        The shares of the lobes and their multiple scattering follow the values of the textures.

        Args:
            hit: place on the surface.
            constant: what the material is where no texture stands for it.
            active: Bool.
        """
        u, v, material = self._place(hit, active)
        columns = constant.diffuse, constant.specular, dr.sqrt(constant.alpha)
        kinds = (mi.Color3f, mi.Color3f, mi.Float)
        values = []
        for place, (kind, column) in enumerate(zip(kinds, columns, strict=True)):
            row = material * len(TEXTURED) + place
            texture = dr.gather(mi.Vector4u, self._rows, row, active)
            textured = active & (texture.w > 0)
            value = self._bilinear(kind, texture, u, v, textured)
            values.append(dr.select(textured, value, column))
        diffuse, specular, roughness = values
        alpha = dr.maximum(dr.square(roughness), MIN_ALPHA)
        most = dr.max(diffuse)
        mirrored = dr.max(specular)
        reflects = most + mirrored > 0
        return KernelLobes(
            diffuse=diffuse,
            specular=specular,
            alpha=alpha,
            weight=dr.select(reflects, mirrored / (most + mirrored), 0),
            multiscatter=self._scattered_again(specular, alpha, active),
        )

    def _scattered_again(self, specular: Any, alpha: Any, active: Any) -> Any:
        """Return Fms (Color3f) of storage.optics."""
        place = dr.sqrt(alpha) * (ROUGHNESS_STEPS - 1)
        row = dr.minimum(mi.UInt32(place), ROUGHNESS_STEPS - 2)
        low = dr.gather(mi.Float, self._mean_albedo, row, active)
        high = dr.gather(mi.Float, self._mean_albedo, row + 1, active)
        mean = dr.lerp(low, high, place - mi.Float(row))
        return specular * mean / (1 - specular * (1 - mean))

    def _bilinear(self, kind: Any, texture: Any, u: Any, v: Any, active: Any) -> Any:
        """Return the value at u and v in [0, 1] of a texture (Vector4u: first, width, height)."""
        near, far, along = neighbours(u, texture.y)
        low, high, across = neighbours(v, texture.z)

        def row(line: Any) -> Any:
            first = texture.x + line * texture.y
            return dr.lerp(
                self._texel(kind, first + near, active),
                self._texel(kind, first + far, active),
                along,
            )

        return dr.lerp(row(low), row(high), across)

    def _texel(self, kind: Any, index: Any, active: Any) -> Any:
        if kind is mi.Float:
            return dr.gather(mi.Float, self._numbers, index, active)
        texel: Any = dr.gather(mi.Vector4f, self._colours, index, active)
        return mi.Color3f(texel.xyz)


def neighbours(place: Any, count: Any) -> tuple[Any, Any, Any]:
    """Return the texels (UInt32) around a place in [0, 1], and the share (Float) of the second."""
    scaled = place * mi.Float(count) - 0.5
    below = dr.floor(scaled)
    first = dr.select(below < 0, count - 1, mi.UInt32(dr.maximum(below, 0)))
    second = dr.select(first + 1 < count, first + 1, 0)
    return first, second, scaled - below


def _load_texels(
    textures: Sequence[Texture], channels: int, floats: int, lookups: NDArray[np.uint32]
) -> Any:
    """Return the linear values of the texels of textures with so many channels, row by row.

    Args:
        textures: all of a scene.
        channels: 3 for colors, 1 for numbers.
        floats: numbers of each texel, 0 beyond its channels.
        lookups: rows of `textures`, in which the places of these are filled in.
    """
    rows = [row for row, each in enumerate(textures) if each.channels == channels]
    sizes = np.array([textures[row].texels.shape[:2] for row in rows], np.int64).reshape(-1, 2)
    values = np.zeros((max(1, sizes.prod(axis=1).sum()), floats), np.float32)
    first = 0
    for row, (height, width) in zip(rows, sizes, strict=True):
        lookups[row] = first, width, height, 1
        flat = textures[row].texels.reshape(-1, channels)
        for start in range(0, len(flat), _BLOCK):
            linear = textures[row].linear(flat[start : start + _BLOCK])
            begin = first + start
            values[begin : begin + len(linear), :channels] = linear
        first += len(flat)
    return own_floats(values)
