"""Builds a `Scene` from the placed prims of a USD stage.

Its materials are read as for objects (pipeline.foreign.usd.materials). A material that Trilight
wrote keeps its exact values where nothing was changed. Coats, transparency and bumps are lost, with
notes.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdGeom

from pipeline.exchange.from_description import SMOOTH_ANGLE_DEG
from pipeline.exchange.part_materials import Part, PartConverter, drop_empty, unit_normals
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import (
    SceneParts,
    TexturedTriangles,
    build_lamp,
    join_triangles,
    rigid_pose,
)
from pipeline.exchange.usd import layout
from pipeline.exchange.usd.foreign_lights import (
    compute_radiance,
    light_triangles,
    read_foreign_dome,
)
from pipeline.exchange.usd.held_materials import HeldMaterial, keep_exact, read_columns
from pipeline.foreign.numbers import read_number
from pipeline.foreign.usd.materials import MeshMaterials
from pipeline.foreign.usd.object_source import read_stage_materials
from pipeline.foreign.usd.placed import DOMES, SOLIDS, PlacedPrim, placed_prims
from pipeline.foreign.usd.polygons import CutMesh, as_array, cut_mesh
from pipeline.foreign.usd.shaders import StatedMaterial, read_material
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.objects.licences import USER_PROVIDED
from pipeline.scenes.shading_normals import smooth_shaded
from storage.errors import TrilightError
from storage.records.material import EMISSION, column_places
from storage.records.scene import Scene, SceneObject
from storage.records.texture import Environment, MapSource, Texture

_MESHES = ("Mesh", *SOLIDS)

_MOST_NOTED = 2
"""Maximum number of notes in the message on a stage without light."""


def _name_lights(notes: Sequence[str]) -> str:
    """Return the first notes on lights, and the number of others."""
    unread = [note for note in notes if "light" in note.replace("Trilight", "").lower()]
    more = len(unread) - _MOST_NOTED
    named = [f"{note:.100}" for note in unread[:_MOST_NOTED]]
    return "; ".join(named + [f"{more} more of lights"] * (more > 0)) or "none is seen"


def _read_row(each: PlacedPrim) -> float:
    """Return the row that Trilight wrote on an object or camera; infinity for other prims."""
    prim = each.prim
    row = prim.GetAttribute(layout.INDEX).Get()
    if prim.HasAttribute(layout.FOV_DEG):
        row = layout.parse_camera_row(prim.GetName())
    return row if isinstance(row, int) else math.inf


def _smooth(positions: NDArray[np.float32], cut: CutMesh) -> NDArray[np.float32]:
    points = cut.indices[cut.corners]
    _, first, inverse = np.unique(points, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.uint32)
    shaded = smooth_shaded(positions.reshape(-1, 3)[first], faces, SMOOTH_ANGLE_DEG)
    return shaded.normals[shaded.faces]


def _stated_normals(prim: Any, time: Any) -> tuple[NDArray[np.float64], str] | None:
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


class StageReader:
    """Reads the meshes, materials, lights and cameras of a stage at a time."""

    def __init__(
        self,
        stage: Any,
        time: Any,
        opened: OpenedStage,
        written: Mapping[str, Mapping[str, NDArray[np.float32]]],
    ) -> None:
        """Read all materials of a Usd.Stage; `opened.lost` receives notes on losses.

        `written` has columns as Trilight wrote them, by the paths of materials, if known.

        Raises:
            Rejected: a picture is outside of the folder, or too large.
            TrilightError: a picture has too many pixels.
        """
        self._time = time
        self._lost = opened.lost
        self._opened = opened
        self._written = written
        self._converter = PartConverter(self._lost)
        self._placed = sorted(placed_prims(stage, time, self._lost), key=_read_row)
        meshes = [each for each in self._placed if each.prim.GetTypeName() in _MESHES]
        # of each material: name of its prim, added columns, and exact columns if Trilight wrote it
        self._extras: list[tuple[str, dict[str, Any], dict[str, Texture] | None]] = []
        self._looks = MeshMaterials(
            read_stage_materials(meshes, time, _MAX_PICTURE_BYTES, self._read),
            lambda data, name: decode_values(data, name, self._lost),
            time,
            emission=True,
            notes=self._lost,
        )
        self._extras.append(("", {}, None))

    def scene(self) -> Scene:
        """Build the scene.

        Raises:
            TrilightError: a count exceeds its maximum, arrays contradict each other, or the stage
                lacks triangles or light.
        """
        time = self._time
        numbers = itertools.count()
        parts = SceneParts(self._opened.path.name)
        cameras = []
        sky: Environment | None = None
        for each in self._placed:
            kind = each.prim.GetTypeName()
            if kind in _MESHES:
                mesh = self._convert(each, next(numbers))
                if mesh is not None:
                    parts.add(self._entry(each.prim), mesh)
            elif kind == "Camera":
                cameras.append(self._read_camera(each))
            elif kind not in DOMES:
                lamp = light_triangles(each, time, self._lost)
                if lamp is not None:
                    radiance = compute_radiance(each, lamp, time, self._lost)
                    parts.add(self._entry(each.prim), build_lamp(lamp, radiance), is_lamp=True)
            elif sky is not None:
                self._note(each.prim, "a second dome; a scene has one environment")
            else:
                sky = read_foreign_dome(each.prim, each.to_world, time, self._opened)
        is_lit = sky is not None and sky.radiance_rgb.any()
        if not is_lit and not parts.has_emitters:
            raise TrilightError(
                f"no light that can be carried over ({_name_lights(self._opened.notes)}); expected "
                "an emissive material, or a rectangle, disk, sphere, cylinder, mesh or dome light."
            )
        code = time.GetValue() if time.IsNumeric() and not time.IsEarliestTime() else None
        provenance = {"template": "usd", "file": self._opened.path.name, "time_code": code}
        return parts.build(cameras, sky, provenance, self._lost)

    def _note(self, prim: Any, text: str) -> None:
        self._lost.append(f"{prim.GetPath()}: {text}")

    def _entry(self, prim: Any) -> SceneObject:
        """Return the object entry of a prim: values that Trilight wrote on it, or its name."""
        fields = layout.OBJECT_TEXTS.items()
        texts = {field: prim.GetAttribute(name).Get() for field, name in fields}
        known = {field: text for field, text in texts.items() if text and isinstance(text, str)}
        known["kind"] = "shell" if known.get("kind") == "shell" else "object"
        return SceneObject(**{"name": prim.GetName(), "licence": USER_PROVIDED, **known})

    def _read_camera(self, placed: PlacedPrim) -> tuple[NDArray[np.float64], float] | None:
        """Return pose [4, 4] and full angle in degrees of a camera; None for an unusable one."""
        time = self._time
        camera = UsdGeom.Camera(placed.prim)
        names = ("focalLength", "horizontalAperture", "verticalAperture")
        lens = map(placed.prim.GetAttribute, names)
        focal, wide, high = (read_number(each.Get(time), str(each.GetPath())) for each in lens)
        pose = rigid_pose(placed.to_world)
        if camera.GetProjectionAttr().Get(time) != "perspective" or pose is None or not focal > 0:
            self._note(placed.prim, "no perspective camera with a focal length")
            return None
        angle = math.degrees(2 * math.atan(wide / (2 * focal)))
        held = placed.prim.GetAttribute(layout.FOV_DEG).Get(time)
        is_held = isinstance(held, float) and math.isclose(held, angle, rel_tol=layout.SAME_VALUE)
        if not is_held and not math.isclose(wide, high, rel_tol=1e-4):
            self._note(placed.prim, "pictures are square; its horizontal angle was used")
        if any(a.Get(time) for a in (camera.GetHorizontalApertureOffsetAttr(),
                                     camera.GetVerticalApertureOffsetAttr())):  # fmt: skip
            self._note(placed.prim, "its shift has no place here")
        if camera.GetFStopAttr().Get(time):
            self._note(placed.prim, "depth of field has no place here")
        angle = held if is_held else angle
        return (pose, angle) if 0 < angle < 180 else None

    def _normals(
        self, cut: CutMesh, positions: NDArray[np.float32], flat: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return normals [T, 3, 3] at the corners [T, 3, 3] of triangles with normals [T, 3]."""
        placed = cut.placed
        stated = None if placed.skin is not None else _stated_normals(cut.prim, self._time)
        if stated is None:
            if not (cut.is_smooth or placed.skin is not None):
                return unit_normals(None, flat)
            if placed.skin is not None:
                self._note(cut.prim, "posed by bones; its normals are those of its faces")
            elif cut.prim.GetTypeName() == "Mesh":
                self._note(cut.prim, "subdivision; its cage was read, with smooth normals")
            return _smooth(positions, cut)
        normals = cut.per_corner(*stated)
        if normals is None:
            self._note(cut.prim, "the number of normals does not match")
            return unit_normals(None, flat)
        normal_matrix = np.linalg.inv(placed.to_world[:3, :3]).T
        return unit_normals(np.einsum("ij,tcj->tci", normal_matrix, normals), flat)

    def _convert(self, placed: PlacedPrim, number: int) -> TexturedTriangles | None:
        """Return the triangles of a mesh that have an area, by its index within the stage.

        None, with a note, without any.

        Raises:
            TrilightError: the arrays of the mesh contradict each other, or are not finite.
        """
        cut = cut_mesh(placed, self._time)
        positions, flat, has_area = drop_empty(cut.world_points[cut.indices[cut.corners]])
        if not has_area.all():
            self._note(cut.prim, f"{int((~has_area).sum())} triangles without an area")
        if not len(positions):
            self._note(cut.prim, "no triangle with an area")
            return None
        cut = cut.select(has_area)
        normals = self._normals(cut, positions, flat)
        rows, tints = self._looks.assign(number, cut)
        masks = {int(row): rows == row for row in np.unique(rows)}
        triangles = join_triangles(
            [
                self._convert_row(row, cut, mask, positions[mask], normals[mask], tints[mask])
                for row, mask in masks.items()
            ],
            list(map(np.flatnonzero, masks.values())),
        )
        if cut.prim.HasAPI("MeshLightAPI"):
            self._add_light(placed, triangles)
        return triangles

    def _add_light(self, placed: PlacedPrim, triangles: TexturedTriangles) -> None:
        """Multiply the emission of a mesh with that of its light, or replace it."""
        rows = triangles.rows
        light = compute_radiance(placed, triangles.positions, self._time, self._lost)
        mode = placed.prim.GetAttribute("light:materialSyncMode").Get(self._time)
        glows = rows[:, EMISSION].any()
        tints = mode == "materialGlowTintsLight" and glows
        rows[:, EMISSION] = rows[:, EMISSION] * light if tints else light
        if mode == "materialGlowTintsLight" and not glows:
            text = "its material emits nothing; the radiance of the light is used"
            self._note(placed.prim, text)

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
            if not np.isfinite(uv).all():
                self._lost.append(f"{where}: no coordinates {primvar!r:.60}")
                return None
            return uv[mask]

        name, added, exact = self._extras[self._looks.origins[row]]
        part = Part(
            where=f"{where}: ",
            material=self._looks.materials[row],
            positions=positions,
            normals=normals,
            coordinates=coordinates,
            colors=None if (tints == 1).all() else tints,
        )
        source = MapSource(name=name, licence=USER_PROVIDED)
        triangles = self._converter.convert(part, source)
        places = column_places()
        for column, value in added.items():
            triangles.rows[:, places[column]] = value
        return triangles if exact is None else keep_exact(triangles, exact, where, self._lost)

    def _read(self, material: Any) -> StatedMaterial | None:
        """Return the inputs of a material; None, with a note, where none are understood."""
        columns = read_columns(material.GetPrim(), self._time, self._lost)
        held = None
        if columns.keys() >= layout.MATERIAL_ATTRIBUTES.keys():
            held = HeldMaterial(material, columns, self._written, self._time, self._opened)
        known = () if held is None else ("specular",)  # Blender writes its specular level there
        stated = read_material(material, self._time, self._opened, known)
        exact = None
        if held is not None:
            self._lost.append(_HELD)
            stated, exact = held.restore(stated)
        if stated is None:
            self._note(material, "no supported shader; its display color is used")
            return None
        added = {name: columns[name] for name in columns.keys() - layout.MATERIAL_ATTRIBUTES.keys()}
        self._extras.append((stated.name, added, exact))
        return stated
