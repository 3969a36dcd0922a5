"""The cleaned source with a colour at every place: its faces find themselves in the file again."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import cell_keys, normalise
from pipeline.foreign.material import Seen, Slot, SourceMaterial, columns
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.parts import TexturedParts
from storage.errors import Rejected

_LEAST_FOUND = 0.999
"""Share of the cleaned faces that the file must have: all but those that rounding moved apart."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceSurface:
    """The clean, outward oriented mesh of a source, and what it is made of."""

    mesh: TriangleMesh
    """In the unit box."""
    parts: TexturedParts
    """The file's faces."""
    origin: NDArray[np.int64]
    """[F] which of those each face is."""
    turn: NDArray[np.int64]
    """[F, 3] which corner of that face each corner is."""

    def columns(
        self, faces: NDArray[np.int64], weights: NDArray[np.float64], cell: float
    ) -> NDArray[np.float64]:
        """Return diffuse rgb, specular rgb and roughness [N, 7] at places on faces.

        Args:
            faces: [N]
            weights: [N, 3] barycentric coordinates there.
            cell: width in the unit box over which pictures are averaged.
        """
        origin = self.origin[faces]
        own = np.zeros((len(faces), 3))  # the weights of the file's own corners
        np.put_along_axis(own, self.turn[faces], weights, axis=1)
        found = np.zeros((len(faces), 7))
        of_place = self.parts.material[origin]
        for row in np.unique(of_place):
            chosen = np.flatnonzero(of_place == row)
            found[chosen] = self._of_material(
                self.parts.materials[row], origin[chosen], own[chosen], cell
            )
        return found

    @property
    def emits(self) -> bool:
        """Whether any of its materials says so."""
        return any(material.emits for material in self.parts.materials)

    def emission(
        self, faces: NDArray[np.int64], weights: NDArray[np.float64], cell: float
    ) -> NDArray[np.float64]:
        """Return the radiance [N, 3] at places on faces; arguments as those of `columns`."""
        origin = self.origin[faces]
        own = np.zeros((len(faces), 3))
        np.put_along_axis(own, self.turn[faces], weights, axis=1)
        found = np.zeros((len(faces), 3))
        for row, material in enumerate(self.parts.materials):
            chosen = np.flatnonzero(self.parts.material[origin] == row)
            if not material.emits or not len(chosen):
                continue
            found[chosen] = material.emission_rgb
            if material.emission is not None:
                found[chosen] *= self._shown(material.emission, origin[chosen], own[chosen], cell)[
                    :, :3
                ]
        return found

    def _of_material(
        self,
        material: SourceMaterial,
        origin: NDArray[np.int64],
        own: NDArray[np.float64],
        cell: float,
    ) -> NDArray[np.float64]:
        known: dict[tuple[object, ...], NDArray[np.float32]] = {}

        def shown(slot: Slot | None) -> NDArray[np.float32] | None:
            if slot is None:
                return None
            place = (id(slot.picture), slot.uv_set, slot.turn.tobytes(), slot.shift.tobytes())
            if place not in known:  # one picture often holds several numbers
                known[place] = self._shown(slot, origin, own, cell)
            return known[place]

        base = shown(material.base)
        if self.parts.colour is not None:
            tint = np.einsum("nc,ncd->nd", own, self.parts.colour[origin])
            base = np.ones((len(origin), 4), np.float32) if base is None else base
            base = np.concatenate([base[:, :3] * tint, base[:, 3:]], axis=1).astype(np.float32)
        seen = Seen(
            base=base,
            metallic=shown(material.metallic_map),
            roughness=shown(material.roughness_map),
            specular_colour=shown(material.specular_colour),
            specular_strength=shown(material.specular_strength_map),
            glossiness=shown(material.glossiness),
        )
        return columns(material, seen, len(origin))

    def _shown(
        self, slot: Slot, origin: NDArray[np.int64], own: NDArray[np.float64], cell: float
    ) -> NDArray[np.float32]:
        corners = self.parts.uv[origin, slot.uv_set] @ slot.turn.T + slot.shift
        uv = np.einsum("nc,ncd->nd", own, corners)
        return slot.picture.at(uv, _halvings(slot, corners, self._areas[origin], cell))

    @cached_property
    def _areas(self) -> NDArray[np.float64]:
        """[R] area of each face of the file in the unit box."""
        vectors = normalise(self.parts.mesh).double_area_vectors
        areas: NDArray[np.float64] = 0.5 * np.linalg.norm(vectors, axis=1)
        return areas


def _halvings(
    slot: Slot, corners: NDArray[np.float64], areas: NDArray[np.float64], cell: float
) -> NDArray[np.int64]:
    """Return how often [N] a picture is halved so that its texels are no wider than a cell."""
    height, width = slot.picture.values.shape[:2]
    steps = corners[:, 1:] - corners[:, :1]
    on_picture = 0.5 * np.abs(steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0])
    texels = on_picture * width * height * cell**2 / np.maximum(areas, 1e-30)
    halvings = np.floor(0.5 * np.log2(np.maximum(texels, 1.0))).astype(np.int64)
    return np.minimum(halvings, slot.picture.most_halvings)


def source_surface(mesh: TriangleMesh, parts: TexturedParts) -> SourceSurface:
    """Find the faces of a clean mesh among those of its file.

    Args:
        mesh: as cleaning and orientation left it.
        parts: of the same file.

    Raises:
        Rejected: materials_unreadable where many are not found, no_texture_coordinates or
            texture_coordinates_not_finite where a textured face has none.
    """
    raw = normalise(parts.mesh)
    known = cell_keys(mesh.positions)
    order = np.argsort(known)
    keys = cell_keys(raw.positions)
    place = np.minimum(np.searchsorted(known[order], keys), len(known) - 1)
    vertex = np.where(known[order][place] == keys, order[place], -1)
    corners = vertex[raw.faces]
    origin = np.full(len(mesh.faces), -1)
    for candidate in (corners, corners[:, [0, 2, 1]]):  # those that face the same way come first
        found = _matching(mesh.faces, candidate)
        origin = np.where(origin < 0, found, origin)
    missing = origin < 0
    if missing.mean() > 1 - _LEAST_FOUND:
        raise Rejected(
            "materials_unreadable",
            f"{missing.mean():.1%} of the faces are not found again beside their materials",
        )
    origin = np.where(missing, _any_neighbour(mesh, missing, origin), origin)
    turn = (corners[origin][:, None, :] == mesh.faces[:, :, None]).argmax(axis=2)
    turn[missing] = np.arange(3)
    _require_coordinates(parts, origin)
    return SourceSurface(mesh=mesh, parts=parts, origin=origin, turn=turn)


def _matching(wanted: NDArray[np.int64], among: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first row of `among` that is each wanted face but for its first corner, or -1."""
    rows = np.concatenate([_rolled(among), _rolled(wanted)])
    _, number = np.unique(rows, axis=0, return_inverse=True)
    first = np.full(int(number.max()) + 1, len(among))
    np.minimum.at(first, number.ravel()[: len(among)], np.arange(len(among)))
    found = first[number.ravel()[len(among) :]]
    return np.where(found < len(among), found, -1)


def _rolled(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, turn, axis=1)


def _any_neighbour(
    mesh: TriangleMesh, missing: NDArray[np.bool_], origin: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the origin of the face whose centre is nearest, for each missing one."""
    if not missing.any():
        return origin
    centres = mesh.corners.mean(axis=1)
    known = np.flatnonzero(~missing)
    filled = origin.copy()
    for row in np.flatnonzero(missing):
        away = np.square(centres[known] - centres[row]).sum(axis=1)
        filled[row] = origin[known[away.argmin()]]
    return filled


def _require_coordinates(parts: TexturedParts, origin: NDArray[np.int64]) -> None:
    used = np.unique(origin)
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
