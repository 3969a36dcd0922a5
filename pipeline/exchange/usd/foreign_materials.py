"""The materials of a USD stage on its meshes, as for objects (pipeline.foreign.usd.materials).

A material that Trilight wrote keeps its exact values where nothing was changed. Coats, transparency
and bumps are lost, with notes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.part_materials import PartConverter
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import TexturedTriangles, join_triangles
from pipeline.exchange.usd.foreign_meshes import TriangleSoup
from pipeline.exchange.usd.held_materials import (
    HeldMaterial,
    as_stated,
    find_exact,
    keep_exact,
    name_lost_columns,
    parse_numbers,
    read_held_material,
    restore_stated,
)
from pipeline.exchange.usd.names import added_column
from pipeline.foreign.part import Part
from pipeline.foreign.usd.materials import MeshMaterials
from pipeline.foreign.usd.object_stage import UsdStage
from pipeline.foreign.usd.shaders import StatedMaterial, read_material
from pipeline.foreign.usd.stage_materials import read_stage_materials
from storage.records.material import laid_out
from storage.records.texture import MapSource, Texture

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
    added: Mapping[str, NDArray[np.float64]]
    """Values of columns beyond the published ones."""
    exact: Mapping[str, Texture] | None
    """Exact values of unchanged columns; None for a material of another program."""


class StageSurfaces:
    """Converts the meshes of a stage to triangles with materials and textures."""

    def __init__(self, stage: UsdStage, licence: str) -> None:
        """Read all materials; the stage's notes receive their losses.

        Args:
            stage: the open stage with its meshes.
            licence: licence of textures.

        Raises:
            Rejected: a picture is outside of the folder, or too large.
            TrilightError: a picture has too many pixels.
        """
        self._time = stage.time
        self._lost = stage.opened.lost
        self._opened = stage.opened
        self._licence = licence
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

    def convert(self, number: int, soup: TriangleSoup) -> TexturedTriangles:
        """Return the triangles of a mesh, by its index within the stage."""
        rows, tints = self._looks.assign(number, soup.cut)
        return join_triangles(
            [self._convert_row(int(row), rows == row, soup, tints) for row in np.unique(rows)],
            [np.flatnonzero(rows == row) for row in np.unique(rows)],
        )

    def _convert_row(
        self, row: int, mask: NDArray[np.bool_], soup: TriangleSoup, tints: NDArray[np.float64]
    ) -> TexturedTriangles:
        where = str(soup.cut.prim.GetPath())

        def coordinates(number: int) -> NDArray[np.float64] | None:
            primvar = self._looks.primvars[number]
            uv = soup.cut.read_coordinates(primvar, self._time)
            if uv is None or not np.isfinite(uv).all():
                self._lost.append(f"{where}: no coordinates {primvar!r:.60}")
                return None
            return uv[mask]

        extra = self._extras[self._looks.origins[row]]
        part = Part(
            where=f"{where}: ",
            material=self._looks.materials[row],
            positions=soup.positions[mask],
            normals=soup.normals[mask],
            coordinates=coordinates,
            colors=None if (tints[mask] == 1).all() else tints[mask],
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
        held = read_held_material(material, self._time)
        known = () if held is None else ("specular",)  # Blender writes its specular level there
        stated = read_material(material, self._time, self._opened, known)
        exact = None
        if held is not None:
            self._lost += [_HELD, *name_lost_columns(material)]
            stated, exact = self._read_held(held, stated, material)
        if stated is None:
            self._lost.append(
                f"{material.GetPath()}: no supported shader; its display color is used"
            )
            return None
        added = _read_added_columns(material, self._time, self._lost)
        self._extras.append(_Extras(name=stated.name, added=added, exact=exact))
        return stated

    def _read_held(
        self, held: HeldMaterial, stated: StatedMaterial | None, material: Any
    ) -> tuple[StatedMaterial, dict[str, Texture] | None]:
        """Return the inputs of a material that Trilight wrote, and its exact columns."""
        if stated is None:
            self._lost.append(f"{held.where}: no shader; the values that Trilight wrote are used")
            stated = as_stated(held)
        elif stated.is_specular or not _is_metal(stated):
            stated = restore_stated(held, stated, material, self._time, self._opened)
        else:
            self._lost.append(
                f"{held.where}: became a metal since Trilight wrote it; read as any other material"
            )
            return stated, None
        return stated, find_exact(held, stated, self._lost)


def _is_metal(stated: StatedMaterial) -> bool:
    return "metallic" in stated.textures or bool(stated.constants["metallic"].any())


def _read_added_columns(
    material: Any, time: Any, lost: list[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the columns beyond the published ones from the attributes that Trilight writes."""
    declared = {column.name: column for column, _ in laid_out()}
    values = {}
    for attribute in material.GetPrim().GetAttributes():
        name = added_column(attribute.GetName())
        if name is None:
            continue
        if name not in declared:
            lost.append(f"{attribute.GetPath()}: this material column is not declared here")
            continue
        column = declared[name]
        value = parse_numbers(attribute.Get(time))
        if len(value) == column.width and np.all(column.within.holds(value)):
            values[name] = value
        else:
            lost.append(
                f"{attribute.GetPath()}: expected {column.width} numbers {column.within}; "
                "the default is used"
            )
    return values
