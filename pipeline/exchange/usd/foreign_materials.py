"""The materials of a USD stage on its meshes, as for objects (pipeline.foreign.usd.materials).

A material that Trilight wrote keeps its exact values where nothing was changed. Coats, transparency
and bumps are lost, with notes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.part_materials import Part, PartConverter, drop_empty, unit_normals
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import TexturedTriangles, join_triangles
from pipeline.exchange.usd.held_materials import HeldMaterial, keep_exact, read_columns
from pipeline.exchange.usd.prim_names import MATERIAL_ATTRIBUTES
from pipeline.foreign.usd.materials import MeshMaterials
from pipeline.foreign.usd.object_source import UsdStage, read_stage_materials
from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.polygons import CutMesh, as_array, cut_mesh
from pipeline.foreign.usd.shaders import StatedMaterial, read_material
from pipeline.scenes.shading_normals import smooth_shaded
from storage.records.material import laid_out
from storage.records.texture import MapSource, Texture

SMOOTH_ANGLE_DEG = 30.0
"""Maximum angle of a smooth edge where a subdivision surface states no normals."""


def _normals(
    cut: CutMesh,
    time: Any,
    positions: NDArray[np.float32],
    flat: NDArray[np.float64],
    lost: list[str],
) -> NDArray[np.float32]:
    placed = cut.placed
    where = cut.prim.GetPath()
    stated = None if placed.skin is not None else _stated_normals(cut.prim, time)
    if stated is None:
        if not (cut.is_smooth or placed.skin is not None):
            return unit_normals(None, flat)
        if placed.skin is not None:
            lost.append(f"{where}: posed by bones; its normals are those of its faces")
        elif cut.prim.GetTypeName() == "Mesh":
            lost.append(f"{where}: subdivision; its cage was read, with smooth normals")
        return _smooth(positions, cut)
    normals = cut.per_corner(*stated)
    if normals is None:
        lost.append(f"{where}: the number of normals does not match")
        return unit_normals(None, flat)
    normal_matrix = np.linalg.inv(placed.to_world[:3, :3]).T
    return unit_normals(np.einsum("ij,tcj->tci", normal_matrix, normals), flat)


def _smooth(positions: NDArray[np.float32], cut: CutMesh) -> NDArray[np.float32]:
    points = cut.indices[cut.corners]
    _, first, inverse = np.unique(points, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.uint32)
    shaded = smooth_shaded(positions.reshape(-1, 3)[first], faces, SMOOTH_ANGLE_DEG)
    return shaded.normals[shaded.faces]


def _stated_normals(prim: Any, time: Any) -> tuple[NDArray[np.float64], str] | None:
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    if not mesh:
        return None
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        values = primvar.ComputeFlattened(time)
        interpolation = str(primvar.GetInterpolation())
    else:
        values = mesh.GetNormalsAttr().Get(time)
        interpolation = str(mesh.GetNormalsInterpolation())
    if values is None or len(values) == 0:
        return None
    return as_array(values, np.float64, (-1, 3)), interpolation


_HELD = (
    "materials of Trilight are exact where nothing was changed; positions and normals are as this "
    "file has them, and the provenance is a new one"
)
_MAX_PICTURE_BYTES = 4 << 30
"""Maximum bytes of all pictures of a stage together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Extras:
    """What a material has beyond the inputs of its shader."""

    name: str
    """Name of its prim, which its textures get."""
    added: Mapping[str, NDArray[np.float32]]
    """Values of columns beyond the published ones."""
    exact: Mapping[str, Texture] | None
    """Exact values of unchanged columns; None for a material of another program."""


class StageSurfaces:
    """Converts the meshes of a stage to triangles with materials and textures."""

    def __init__(
        self, stage: UsdStage, licence: str, written: Mapping[str, NDArray[np.float32]]
    ) -> None:
        """Read all materials; the stage's notes receive their losses.

        Textures get the licence; `written` has material rows as Trilight wrote them, by the paths
        of their prims.

        Raises:
            Rejected: a picture is outside of the folder, or too large.
            TrilightError: a picture has too many pixels.
        """
        self._time = stage.time
        self._lost = stage.opened.lost
        self._opened = stage.opened
        self._licence = licence
        self._written = written
        self._converter = PartConverter(self._lost)
        self._extras: list[_Extras] = []
        self._looks = MeshMaterials(
            read_stage_materials(stage, _MAX_PICTURE_BYTES, self._read),
            lambda data, name: decode_values(data, name, self._lost),
            stage.time,
            emission=True,
            notes=self._lost,
        )
        self._extras.append(_Extras(name="", added={}, exact=None))

    def convert(self, placed: PlacedPrim, number: int) -> TexturedTriangles | None:
        """Return the triangles of a mesh that have an area, by its index within the stage.

        None, with a note, without any.

        Raises:
            TrilightError: the arrays of the mesh contradict each other, or are not finite.
        """
        cut = cut_mesh(placed, self._time)
        positions, flat, has_area = drop_empty(cut.world_points[cut.indices[cut.corners]])
        where = cut.prim.GetPath()
        if not has_area.all():
            self._lost.append(f"{where}: {int((~has_area).sum())} triangles without an area")
        if not len(positions):
            self._lost.append(f"{where}: no triangle with an area")
            return None
        cut = cut.select(has_area)
        normals = _normals(cut, self._time, positions, flat, self._lost)
        rows, tints = self._looks.assign(number, cut)
        masks = {int(row): rows == row for row in np.unique(rows)}
        return join_triangles(
            [
                self._convert_row(row, cut, mask, positions[mask], normals[mask], tints[mask])
                for row, mask in masks.items()
            ],
            list(map(np.flatnonzero, masks.values())),
        )

    def _convert_row(
        self,
        row: int,
        cut: CutMesh,
        mask: NDArray[np.bool_],
        positions: NDArray[np.float32],
        normals: NDArray[np.float32],
        tints: NDArray[np.float64],
    ) -> TexturedTriangles:
        """Return the triangles of a material's row, which a mask [T] of the mesh selects."""
        where = str(cut.prim.GetPath())

        def coordinates(number: int) -> NDArray[np.float64] | None:
            primvar = self._looks.primvars[number]
            uv = cut.read_coordinates(primvar, self._time)
            if uv is None or not np.isfinite(uv).all():
                self._lost.append(f"{where}: no coordinates {primvar!r:.60}")
                return None
            return uv[mask]

        extra = self._extras[self._looks.origins[row]]
        part = Part(
            where=f"{where}: ",
            material=self._looks.materials[row],
            positions=positions,
            normals=normals,
            coordinates=coordinates,
            colors=None if (tints == 1).all() else tints,
        )
        source = MapSource(name=extra.name, licence=self._licence)
        triangles = self._converter.convert(part, source)
        for column, columns in laid_out():
            if column.name in extra.added:
                triangles.rows[:, columns] = extra.added[column.name]
        if extra.exact is None:
            return triangles
        return keep_exact(triangles, extra.exact, where, self._lost)

    def _read(self, material: Any) -> StatedMaterial | None:
        """Return the inputs of a material; None, with a note, where none are understood."""
        columns = read_columns(material.GetPrim(), self._time, self._lost)
        held = None
        if columns.keys() >= MATERIAL_ATTRIBUTES.keys():
            held = HeldMaterial(material, columns, self._written, self._time, self._opened)
        known = () if held is None else ("specular",)  # Blender writes its specular level there
        stated = read_material(material, self._time, self._opened, known)
        exact = None
        if held is not None:
            self._lost.append(_HELD)
            stated, exact = held.restore(stated)
        if stated is None:
            self._lost.append(
                f"{material.GetPath()}: no supported shader; its display color is used"
            )
            return None
        added = {name: columns[name] for name in columns.keys() - MATERIAL_ATTRIBUTES.keys()}
        self._extras.append(_Extras(name=stated.name, added=added, exact=exact))
        return stated
