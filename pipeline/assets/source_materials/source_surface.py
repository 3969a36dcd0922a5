"""The cleaned source with its materials, and the point of it that each point of a level shows.

Each clean face is matched to a face of the file. Rays along the level's normal, both ways, take the
nearer surface that faces the same way, so that a thin shell does not show its far side. Where they
hit none within reach, the closest point counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import cell_keys, normalize, start_at_lowest
from pipeline.assets.quality.measure import Surface
from pipeline.foreign.material import Slot, SourceMaterial, TexturedMesh, source_columns
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.raycast import MISS, Triangles
from storage.records.lookup import LEAST_Z, u_directions, unit_or_zero

_BEHIND = 1e-4
"""Distance in the unit box by which rays start behind a point: float32 would miss a surface at it.
"""


class FacePoints(NamedTuple):
    """Points on a surface: their faces [N], and their barycentric coordinates there [N, 3]."""

    faces: NDArray[np.int64]
    weights: NDArray[np.float64]


def barycentric(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return barycentric coordinates [N, 3] of points [N, 3], clipped to triangles [N, 3, 3]."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    across = points - corners[:, 0]
    a, b, c = ((x * y).sum(axis=1) for x, y in ((first, first), (first, second), (second, second)))
    d = (across * first).sum(axis=1)
    e = (across * second).sum(axis=1)
    span = np.maximum(a * c - b * b, 1e-300)
    u = (c * d - b * e) / span
    v = (a * e - b * d) / span
    weights = np.clip(np.stack([1 - u - v, u, v], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


_LEAST_FOUND = 0.999
"""Fraction of the cleaned faces that must match one of the file: all but those that rounding split.
"""

_LEAST_LENGTH = 0.1
"""Least length of a normal of a picture: a shorter one has no direction, and counts as flat."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceSurface:
    """The clean, outward oriented mesh of a source, with its materials."""

    surface: Surface
    """Clean mesh in the unit box, with its search tree."""
    parts: TexturedMesh
    """Faces of the file, with texture coordinates and materials."""
    source_face: NDArray[np.int64]
    """[F] face of the file for each clean face."""
    source_corner: NDArray[np.int64]
    """[F, 3] corner of that face for each corner."""

    @property
    def mesh(self) -> TriangleMesh:
        """Return the clean mesh in the unit box."""
        return self.surface.mesh

    @cached_property
    def _triangles(self) -> Triangles:
        return Triangles(self.mesh.corners.astype(np.float32), np.arange(len(self.mesh.faces)))

    def find(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], reach: float
    ) -> tuple[FacePoints, NDArray[np.bool_]]:
        """Return the source points that points [N, 3] with unit normals [N, 3] show.

        The second result is True [N] where no surface nearby faced the same way.

        Args:
            points: points of a level, on or near the source.
            normals: the level's normals there.
            reach: largest distance to a surface, in the unit box.
        """
        squared, faces, nearest = self.surface.find_nearest(points)
        locations = FacePoints(faces, barycentric(self.mesh.corners[faces], nearest))
        facing = (self.surface.normals[faces] * normals).sum(axis=1) > 0
        is_missed = ~(facing & (np.sqrt(squared) <= reach))
        best = np.full(len(points), np.inf)
        for sign in (1.0, -1.0):
            origins = (points - _BEHIND * sign * normals).astype(np.float32)
            hits = self._triangles.intersect(origins, (sign * normals).astype(np.float32))
            face = np.maximum(hits.triangle, 0)
            distance = np.abs(hits.distance_m.astype(np.float64) - _BEHIND)
            facing = (self.surface.normals[face] * normals).sum(axis=1) > 0
            taken = (hits.triangle != MISS) & facing & (distance <= reach) & (distance < best)
            u, v = hits.uv.astype(np.float64)[:, taken]
            best[taken] = distance[taken]
            locations.faces[taken] = face[taken]
            locations.weights[taken] = np.stack([1 - u - v, u, v], axis=1)
            is_missed[taken] = False
        return locations, is_missed

    def columns(self, at: FacePoints, cell: float) -> NDArray[np.float64]:
        """Return diffuse rgb, specular rgb and roughness [N, 7] at points of clean faces.

        `cell` is the width in the unit box over which pictures are averaged.
        """
        result = np.zeros((len(at.faces), 7))
        for material, chosen, points in self._by_material(at):
            result[chosen] = self._material_columns(material, points, cell)
        return result

    def emission(self, at: FacePoints, cell: float) -> NDArray[np.float64]:
        """Return the radiance [N, 3] at points of clean faces; arguments as in `columns`."""
        result = np.zeros((len(at.faces), 3))
        for material, chosen, points in self._by_material(at):
            if material.emits:
                result[chosen] = material.emission_rgb
            if material.emits and material.emission is not None:
                result[chosen] *= self._sample_picture(material.emission, points, cell)[:, :3]
        return result

    @property
    def has_normal_maps(self) -> bool:
        """True where any material has a normal map."""
        return any(material.normal is not None for material in self.parts.materials)

    def normals(
        self,
        at: FacePoints,
        cell: float,
        frame: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return the normals [N, 3] of the maps at points on faces, in the frames of a level.

        They are relative to the shading normal of the source, so that they hold whatever shading
        normals a level gets.

        Args:
            at: points of clean faces.
            cell: width in the unit box over which pictures are averaged.
            frame: unit normal and x axis of the level at each point, [N, 3] each.
        """
        result = np.tile([0.0, 0.0, 1.0], (len(at.faces), 1))
        for material, chosen, points in self._by_material(at):
            if material.normal is None:
                continue
            texels = self._sample_picture(material.normal, points, cell)[:, :3]
            stated = texels * np.array(material.normal_scale) + np.array(material.normal_bias)
            stated[np.square(stated).sum(axis=1) < _LEAST_LENGTH**2] = 0, 0, 1
            stated[:, 2] = np.maximum(stated[:, 2], LEAST_Z)
            x, y, z = unit_or_zero(stated).T
            tangent, bitangent, normal = self._frames(material.normal, points)
            outward = _unit_normals(self.mesh.positions[self.mesh.faces[at.faces[chosen]]])
            # A face that was turned over shows the other side of the same bumps.
            side = np.where((outward * normal).sum(axis=1) < 0, -1.0, 1.0)
            slope = side[:, None] * (x[:, None] * tangent + y[:, None] * bitangent)
            level_normal, level_x = (each[chosen] for each in frame)
            slope = _rotate(slope, outward, level_normal)
            level_y = np.cross(level_normal, level_x)
            across = [(slope * axis).sum(axis=1) for axis in (level_x, level_y)]
            result[chosen] = unit_or_zero(np.stack([*across, z], axis=1))
        return result

    def _frames(
        self, slot: Slot, points: FacePoints
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return unit tangent, bitangent and normal [N, 3] at points of the file.

        Tangents are those that the file states, or else those of its texture coordinates. Without
        either they are 0, and leave the normal as it is.
        """
        corners = self.parts.mesh.positions[self.parts.mesh.faces[points.faces]]
        normal = _unit_normals(corners)
        uv = self.parts.uv[points.faces, slot.uv_set] @ slot.uv_matrix.T + slot.uv_offset
        steps = uv[:, 1:] - uv[:, :1]
        area = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
        tangent = u_directions(corners, uv)
        hand = np.sign(area)
        if self.parts.tangent is not None:
            stated = np.einsum("nc,ncd->nd", points.weights, self.parts.tangent[points.faces])
            flat = stated[:, :3] - (stated[:, :3] * normal).sum(axis=1, keepdims=True) * normal
            flat = unit_or_zero(flat)
            is_stated = np.square(flat).sum(axis=1) > 0
            tangent = np.where(is_stated[:, None], flat, tangent)
            hand = np.where(is_stated, np.sign(stated[:, 3]), hand)
        return tangent, hand[:, None] * np.cross(normal, tangent), normal

    def _by_material(
        self, at: FacePoints
    ) -> Iterator[tuple[SourceMaterial, NDArray[np.int64], FacePoints]]:
        """Yield each material, the rows of its points, and their faces and weights in the file."""
        source_face = self.source_face[at.faces]
        source_weights = np.zeros_like(at.weights)  # weights of the corners in the file's order
        np.put_along_axis(source_weights, self.source_corner[at.faces], at.weights, axis=1)
        material = self.parts.material[source_face]
        for row in np.unique(material):
            chosen = np.flatnonzero(material == row)
            points = FacePoints(source_face[chosen], source_weights[chosen])
            yield self.parts.materials[row], chosen, points

    def _material_columns(
        self, material: SourceMaterial, points: FacePoints, cell: float
    ) -> NDArray[np.float64]:
        known: dict[tuple[object, ...], NDArray[np.float32]] = {}

        def sample(slot: Slot) -> NDArray[np.float32]:
            place = slot.uv_matrix.tobytes(), slot.uv_offset.tobytes()
            key = id(slot.picture), slot.uv_set, place
            if key not in known:  # one picture often holds several numbers
                known[key] = self._sample_picture(slot, points, cell)
            return known[key]

        seen = {name: sample(slot) for name, slot in material.column_slots.items()}
        if self.parts.color is not None:
            tint = np.einsum("nc,ncd->nd", points.weights, self.parts.color[points.faces])
            base = seen.get("base", np.ones((len(points.faces), 4), np.float32))
            tinted = np.concatenate([base[:, :3] * tint, base[:, 3:]], axis=1)
            seen["base"] = tinted.astype(np.float32)
        return source_columns(material, seen, len(points.faces))

    def _sample_picture(self, slot: Slot, points: FacePoints, cell: float) -> NDArray[np.float32]:
        """Return values [N, 4] of a picture, halved until its texels are as wide as a cell."""
        corners = self.parts.uv[points.faces, slot.uv_set] @ slot.uv_matrix.T + slot.uv_offset
        uv = np.einsum("nc,ncd->nd", points.weights, corners)
        height, width = slot.picture.values.shape[:2]
        steps = corners[:, 1:] - corners[:, :1]
        on_picture = 0.5 * np.abs(steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0])
        areas = np.maximum(self._areas[points.faces], 1e-30)
        texels = on_picture * width * height * cell**2 / areas
        halvings = np.floor(0.5 * np.log2(np.maximum(texels, 1.0))).astype(np.int64)
        return slot.picture.sample(uv, np.minimum(halvings, slot.picture.max_halvings))

    @cached_property
    def _areas(self) -> NDArray[np.float64]:
        """Area [R] of each face of the file, in the unit box."""
        return normalize(self.parts.mesh).areas


def _unit_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normals [N, 3] of triangles [N, 3, 3]; 0 of those without an area."""
    return unit_or_zero(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _rotate(
    vectors: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return vectors [N, 3] across `start`, by the smallest rotation from it to `end`."""
    ahead = (vectors * end).sum(axis=1, keepdims=True)
    halves = np.maximum(1 + (start * end).sum(axis=1, keepdims=True), 1e-6)
    return vectors - ahead / halves * (start + end)


def match_source_surface(surface: Surface, parts: TexturedMesh) -> SourceSurface:
    """Match the faces of a clean, oriented mesh to those of its file.

    Raises:
        Rejected: materials_unreadable where many faces do not match, no_texture_coordinates or
            texture_coordinates_not_finite where a textured face has none.
    """
    mesh = surface.mesh
    raw = normalize(parts.mesh)
    known = cell_keys(mesh.positions)
    order = np.argsort(known)
    keys = cell_keys(raw.positions)
    position = np.minimum(np.searchsorted(known[order], keys), len(known) - 1)
    vertex = np.where(known[order][position] == keys, order[position], -1)
    corners = vertex[raw.faces]
    source_face = np.full(len(mesh.faces), -1)
    for candidate in (corners, corners[:, [0, 2, 1]]):  # matches of the same orientation come first
        matched = _first_matches(mesh.faces, candidate)
        source_face = np.where(source_face < 0, matched, source_face)
    missing = source_face < 0
    if missing.mean() > 1 - _LEAST_FOUND:
        raise Rejected(
            "materials_unreadable",
            f"{missing.mean():.1%} of the faces are not found again beside their materials",
        )
    centres = mesh.corners.mean(axis=1)
    known = np.flatnonzero(~missing)
    for row in np.flatnonzero(missing):  # rounding split it: the match of the nearest face
        squared = np.square(centres[known] - centres[row]).sum(axis=1)
        source_face[row] = source_face[known[squared.argmin()]]
    source_corner = (corners[source_face][:, None, :] == mesh.faces[:, :, None]).argmax(axis=2)
    source_corner[missing] = np.arange(3)
    _require_coordinates(parts, source_face)
    return SourceSurface(
        surface=surface, parts=parts, source_face=source_face, source_corner=source_corner
    )


def _first_matches(faces: NDArray[np.int64], candidates: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first candidate equal to each face up to rotation of its corners, or -1."""
    rows = np.concatenate([start_at_lowest(candidates), start_at_lowest(faces)])
    _, number = np.unique(rows, axis=0, return_inverse=True)
    first = np.full(int(number.max()) + 1, len(candidates))
    np.minimum.at(first, number.ravel()[: len(candidates)], np.arange(len(candidates)))
    first_match = first[number.ravel()[len(candidates) :]]
    return np.where(first_match < len(candidates), first_match, -1)


def _require_coordinates(parts: TexturedMesh, source_face: NDArray[np.int64]) -> None:
    used = np.unique(source_face)
    for row in np.unique(parts.material[used]):
        mine = used[parts.material[used] == row]
        for slot in parts.materials[row].slots:
            uv = parts.uv[mine, slot.uv_set]
            if np.isnan(uv).all(axis=(1, 2)).any():
                raise Rejected(
                    "no_texture_coordinates",
                    f"{int(np.isnan(uv).all(axis=(1, 2)).sum())} textured faces have none",
                )
            if not (np.abs(uv) < 1e6).all():
                raise Rejected(
                    "texture_coordinates_not_finite",
                    "a textured face has a coordinate that is not finite, or beyond a million",
                )
