"""Builds a `Scene` from the placed prims of a USD stage.

Its materials are read as for objects (pipeline.foreign.usd.materials). A material that Trilight
wrote keeps its exact values where nothing was changed. Coats, transparency and bumps are lost, with
notes.

Domes become environments, other lights emissive triangles. Radiance is intensity x 2^exposure x
color, divided by the area where the light is normalized. The area is in the units of the stage, as
UsdLux defines it, even where these are not meters. Polygons approximate round lights and have
exactly their area. Triangles emit to both sides; rectangles and disks of USD emit to one, so a note
is added.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdGeom, UsdLux

from pipeline.exchange.from_description import SMOOTH_ANGLE_DEG
from pipeline.exchange.part_materials import Part, PartConverter, drop_empty, unit_normals
from pipeline.exchange.textured_triangles import (
    SceneParts,
    TexturedTriangles,
    build_lamp,
    join_triangles,
    octahedron,
    rigid_pose,
    sum_area,
)
from pipeline.exchange.usd import layout
from pipeline.exchange.usd.held_materials import HeldMaterial, keep_exact, read_columns
from pipeline.foreign.numbers import read_numbers
from pipeline.foreign.picture import (
    MAX_BYTES,
    MAX_PIXELS,
    FilePictures,
    Picture,
    decode_image,
    read_linear_picture,
)
from pipeline.foreign.usd.materials import MeshMaterials
from pipeline.foreign.usd.object_source import read_stage_materials
from pipeline.foreign.usd.placed import DOMES, SOLIDS, PlacedPrim, placed_prims
from pipeline.foreign.usd.polygons import CutMesh, as_array, cut_mesh
from pipeline.foreign.usd.shaders import StatedMaterial, read_material
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import asset_bytes, convert_to_rec709, resolve_file
from pipeline.objects.licences import USER_PROVIDED
from pipeline.scenes.shading_normals import smooth_shaded
from storage.errors import Rejected, TrilightError
from storage.records.material import EMISSION, column_places
from storage.records.scene import Scene, SceneObject
from storage.records.texture import Environment, MapSource, Texture
from storage.settings.ranges import Within

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


def _stated_normals(placed: PlacedPrim) -> tuple[NDArray[np.float64], str] | None:
    mesh = UsdGeom.Mesh(placed.prim)
    if not mesh:
        return None
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        values = primvar.ComputeFlattened(placed.time)
        interpolation = str(primvar.GetInterpolation())
    else:
        values = mesh.GetNormalsAttr().Get(placed.time)
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
        opened: OpenedStage,
        written: Mapping[str, Mapping[str, NDArray[np.float32]]],
    ) -> None:
        """Read all materials of a Usd.Stage; `opened.lost` receives notes on losses.

        `written` has columns as Trilight wrote them, by the paths of materials, if known.

        Raises:
            Rejected: a picture is outside of the folder, or too large.
        """
        self._lost = opened.lost
        self._opened = opened
        self._written = written
        self._converter = PartConverter(self._lost)
        self._placed = sorted(placed_prims(stage, opened.time, self._lost), key=_read_row)
        meshes = [each for each in self._placed if each.prim.GetTypeName() in _MESHES]
        # of each material: name of its prim, added columns, and exact columns if Trilight wrote it
        self._extras: list[tuple[str, dict[str, Any], dict[str, Texture] | None]] = []
        self._looks = MeshMaterials(
            read_stage_materials(meshes, _MAX_PICTURE_BYTES, self._read),
            FilePictures(MAX_PIXELS, lost=self._lost),
            emission=True,
        )
        self._extras.append(("", {}, None))

    def scene(self) -> Scene:
        """Build the scene.

        Raises:
            TrilightError: a count exceeds its maximum, arrays contradict each other, or the stage
                lacks triangles or light.
        """
        time = self._opened.time
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
                lamp = _light_triangles(each)
                if lamp is not None:
                    radiance = _compute_radiance(each, lamp)
                    parts.add(self._entry(each.prim), build_lamp(lamp, radiance), is_lamp=True)
            elif sky is not None:
                each.note("a second dome; a scene has one environment")
            else:
                sky = _read_dome(each, self._opened)
        is_lit = sky is not None and sky.radiance_rgb.any()
        if not is_lit and not parts.has_emitters:
            raise TrilightError(
                f"no light that can be carried over ({_name_lights(self._opened.notes)}); expected "
                "an emissive material, or a rectangle, disk, sphere, cylinder, mesh or dome light."
            )
        code = time.GetValue() if time.IsNumeric() and not time.IsEarliestTime() else None
        provenance = {"template": "usd", "file": self._opened.path.name, "time_code": code}
        return parts.build(cameras, sky, provenance, self._lost)

    def _entry(self, prim: Any) -> SceneObject:
        """Return the object entry of a prim: values that Trilight wrote on it, or its name."""
        fields = layout.OBJECT_TEXTS.items()
        texts = {field: prim.GetAttribute(name).Get() for field, name in fields}
        known = {field: text for field, text in texts.items() if text and isinstance(text, str)}
        known["kind"] = "shell" if known.get("kind") == "shell" else "object"
        return SceneObject(**{"name": prim.GetName(), "licence": USER_PROVIDED, **known})

    def _read_camera(self, placed: PlacedPrim) -> tuple[NDArray[np.float64], float] | None:
        """Return pose [4, 4] and full angle in degrees of a camera; None for an unusable one."""
        names = ("focalLength", "horizontalAperture", "verticalAperture")
        focal, wide, high = map(placed.number, names)
        pose = rigid_pose(placed.to_world)
        if placed.value("projection") != "perspective" or pose is None or not focal > 0:
            placed.note("no perspective camera with a focal length")
            return None
        angle = math.degrees(2 * math.atan(wide / (2 * focal)))
        held = placed.value(layout.FOV_DEG)
        is_held = isinstance(held, float) and math.isclose(held, angle, rel_tol=layout.SAME_VALUE)
        if not is_held and not math.isclose(wide, high, rel_tol=1e-4):
            placed.note("pictures are square; its horizontal angle was used")
        if any(placed.value(f"{axis}ApertureOffset") for axis in ("horizontal", "vertical")):
            placed.note("its shift has no place here")
        if placed.value("fStop"):
            placed.note("depth of field has no place here")
        angle = held if is_held else angle
        return (pose, angle) if 0 < angle < 180 else None

    def _normals(
        self, cut: CutMesh, positions: NDArray[np.float32], flat: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return normals [T, 3, 3] at the corners [T, 3, 3] of triangles with normals [T, 3]."""
        placed = cut.placed
        stated = None if placed.skin is not None else _stated_normals(placed)
        if stated is None:
            if not (cut.is_smooth or placed.skin is not None):
                return unit_normals(None, flat)
            if placed.skin is not None:
                placed.note("posed by bones; its normals are those of its faces")
            elif cut.prim.GetTypeName() == "Mesh":
                placed.note("subdivision; its cage was read, with smooth normals")
            return _smooth(positions, cut)
        normals = cut.per_corner(*stated)
        if normals is None:
            placed.note("the number of normals does not match")
            return unit_normals(None, flat)
        normal_matrix = np.linalg.inv(placed.to_world[:3, :3]).T
        return unit_normals(np.einsum("ij,tcj->tci", normal_matrix, normals), flat)

    def _convert(self, placed: PlacedPrim, number: int) -> TexturedTriangles | None:
        """Return the triangles of a mesh that have an area, by its index within the stage.

        None, with a note, without any.

        Raises:
            TrilightError: the arrays of the mesh contradict each other, or are not finite.
        """
        cut = cut_mesh(placed)
        positions, flat, has_area = drop_empty(cut.world_points[cut.indices[cut.corners]])
        if not has_area.all():
            placed.note(f"{int((~has_area).sum())} triangles without an area")
        if not len(positions):
            placed.note("no triangle with an area")
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
        light = _compute_radiance(placed, triangles.positions)
        mode = placed.value("light:materialSyncMode")
        glows = rows[:, EMISSION].any()
        tints = mode == "materialGlowTintsLight" and glows
        rows[:, EMISSION] = rows[:, EMISSION] * light if tints else light
        if mode == "materialGlowTintsLight" and not glows:
            placed.note("its material emits nothing; the radiance of the light is used")

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
            uv = cut.read_coordinates(primvar)
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
        columns = read_columns(material.GetPrim(), self._opened)
        held = None
        if columns.keys() >= layout.MATERIAL_ATTRIBUTES.keys():
            held = HeldMaterial(material, columns, self._written, self._opened)
        known = () if held is None else ("specular",)  # Blender writes its specular level there
        stated = read_material(material, self._opened, known)
        exact = None
        if held is not None:
            self._lost.append(_HELD)
            stated, exact = held.restore(stated)
        if stated is None:
            self._lost.append(
                f"{material.GetPath()}: no supported shader; its display color is used"
            )
            return None
        added = {name: columns[name] for name in columns.keys() - layout.MATERIAL_ATTRIBUTES.keys()}
        self._extras.append((stated.name, added, exact))
        return stated


_DISK_CORNERS = 24

_NEUTRAL: Mapping[str, Any] = {
    "inputs:diffuse": 1.0,
    "inputs:specular": 1.0,
    "inputs:shaping:cone:angle": 90.0,
    "inputs:shaping:focus": 0.0,
    "inputs:shadow:enable": True,
    "inputs:shadow:color": (0.0, 0.0, 0.0),
    "inputs:shadow:distance": -1.0,
    "inputs:shadow:falloff": -1.0,
}
"""Unsupported inputs, each with the value at which it has no effect."""

_OLD_NAMES = ("intensity", "exposure", "color", "normalize", "radius", "width", "height")
"""Names of inputs in stages of old programs."""

_EXPOSURES = Within(-1000, 1000, unit="stops")


def _light_triangles(placed: PlacedPrim) -> NDArray[np.float32] | None:
    """Return the world-space triangles [T, 3, 3] of a light; None where it has no area."""
    kind = str(placed.prim.GetTypeName())
    shape, sizes = _SHAPES[kind]
    scale = [placed.number(f"inputs:{name}") for name in sizes]
    world = np.einsum("ij,tcj->tci", placed.to_world[:3, :3], shape() * np.array([*scale, 1.0][:3]))
    world = world + placed.to_world[:3, 3]
    area = sum_area(world)
    if not area > 0 or not np.isfinite(area):
        placed.note("a light without an area")
        return None
    if kind in ("RectLight", "DiskLight"):
        placed.note("emits to one side in USD, and to both sides in a scene")
    return world.astype(np.float32)


def _compute_radiance(placed: PlacedPrim, triangles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the radiance [3] that the light API of a prim states.

    The prim is a light, or a mesh with the light API; its triangles [T, 3, 3] in meters have the
    area.
    """
    emitted = _read_light_color(placed)
    if placed.value("inputs:normalize"):
        area = sum_area(triangles) / placed.meters_per_unit**2
        emitted = emitted / max(area, 1e-30)
    if (emitted < 0).any():
        placed.note("negative radiance; the light emits nothing")
    emitted = np.maximum(emitted, 0)
    return np.where(np.isfinite(emitted), emitted, 0).astype(np.float32)


def _read_light_color(placed: PlacedPrim) -> NDArray[np.float64]:
    """Return intensity x 2^exposure x color [3] of a light, tinted by its temperature."""
    light = UsdLux.LightAPI(placed.prim)
    strength = placed.number("inputs:intensity")
    strength *= 2.0 ** placed.number("inputs:exposure", _EXPOSURES)
    stated = light.GetColorAttr()
    rgb = read_numbers(stated.Get(placed.time), 3, str(stated.GetPath()))
    color = convert_to_rec709(stated, np.array(rgb))
    # Blender enables temperature on every light but sets none; the USD default would tint by 4 %
    is_stated = light.GetColorTemperatureAttr().HasAuthoredValue()
    if placed.value("inputs:enableColorTemperature") and is_stated:
        kelvin = placed.number("inputs:colorTemperature")
        color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    _note_losses(placed)
    return np.asarray(strength * color)


def _note_losses(placed: PlacedPrim) -> None:
    prim = placed.prim
    lost = placed.lost
    where = prim.GetPath()
    files = {"inputs:texture:file", "inputs:shaping:ies:file"}
    if "Dome" in str(prim.GetTypeName()):
        files.remove(layout.MAP_PATH)
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        value = attribute.Get(placed.time)
        is_lost = value is not None and value != _NEUTRAL.get(name, value)
        if is_lost or (name in files and value and value.path):
            lost.append(f"{where}.{name}: has no place here")
        if name in _OLD_NAMES:
            lost.append(f"{where}.{name}: USD has read inputs:{name} alone since 21.02")
        if attribute.HasAuthoredConnections():
            lost.append(f"{where}.{name}: a network that is not read")
    for relation in prim.GetRelationships():
        is_link = relation.GetName().startswith(("light:filters", "portals", "collection:"))
        if is_link and relation.HasAuthoredTargets():
            lost.append(f"{where}.{relation.GetName()}: has no place here")


def _square() -> NDArray[np.float64]:
    """Return a square of side 1 in XY that faces -Z, the direction of RectLight."""
    a, b, c, d = np.array([[-0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0]])
    return np.array([[a, b, c], [a, c, d]])


def _disk() -> NDArray[np.float64]:
    """Return a polygon with the area of the unit disk, facing -Z."""
    angle = -2 * math.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    return fan * math.sqrt(math.pi / sum_area(fan))


def _build_tube() -> NDArray[np.float64]:
    """Return a tube of length 1 along X, with the area of a cylinder of radius 1 without caps."""
    angle = 2 * math.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    low = np.stack([np.full_like(angle, -0.5), np.cos(angle), np.sin(angle)], axis=1)
    low[:, 1:] *= math.pi / _DISK_CORNERS / math.sin(math.pi / _DISK_CORNERS)
    along = np.array([1.0, 0.0, 0.0])
    high = low + along
    ahead = np.roll(low, -1, axis=0)
    sides = [(low, ahead, high), (high, ahead, ahead + along)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _sphere() -> NDArray[np.float64]:
    """Return 128 triangles with the total area of the unit sphere, facing out."""
    faces = octahedron()
    for _ in range(2):
        middle = (faces + np.roll(faces, -1, axis=1)) / 2
        middle /= np.linalg.norm(middle, axis=2, keepdims=True)
        corner = [np.stack([faces[:, i], middle[:, i], middle[:, i - 1]], axis=1) for i in range(3)]
        faces = np.concatenate([*corner, middle])
    return faces * math.sqrt(4 * math.pi / sum_area(faces))


_SHAPES: Mapping[str, tuple[Callable[[], NDArray[np.float64]], Sequence[str]]] = {
    "RectLight": (_square, ("width", "height")),
    "DiskLight": (_disk, ("radius", "radius")),
    "SphereLight": (_sphere, ("radius", "radius", "radius")),
    "CylinderLight": (_build_tube, ("length", "radius", "radius")),
}
"""Shape of each light, and its sizes along the axes of the light."""


def _read_dome(placed: PlacedPrim, opened: OpenedStage) -> Environment | None:
    """Read the environment of any DomeLight; return None, with a note, where it is unusable.

    Raises:
        Rejected: the map has more pixels than MAX_PIXELS.
        TrilightError: its file is outside the folder or on the network.
    """
    try:
        tinted = _read_map(placed, opened) * _read_light_color(placed)
        first_basis, _, last_basis = np.linalg.svd(
            placed.to_world[:3, :3] @ _pole_rotation(placed.prim)
        )
        rotation = first_basis @ last_basis
        if np.linalg.det(rotation) < 0:
            raise Rejected("mirrored", "a mirrored dome")
        sky = Environment(
            radiance_rgb=tinted.astype(np.float32),
            rotation=(rotation @ layout.TO_OUR_AXES.T).astype(np.float32),
            is_seen=bool(placed.value(layout.VISIBLE_TO_CAMERA)),
            source=MapSource(name=placed.prim.GetName(), licence=USER_PROVIDED),
        )
        try:
            sky.check()
        except TrilightError as error:
            raise Rejected("law_broken", str(error)) from error
    except Rejected as error:
        if error.reason in ("too_many_pixels", "texture_too_large"):
            raise
        placed.note(f"{error.message}; its light was left out")
        return None
    return _take_held(sky, placed)


def _take_held(sky: Environment, placed: PlacedPrim) -> Environment:
    """Return an environment with the values that Trilight wrote on the prim of the scene."""
    stage = placed.prim.GetStage()
    holder = next((prim for prim in stage.Traverse() if prim.HasAttribute(layout.SKY_SOURCE)), None)
    if holder is None:
        return sky

    def read_value(name: str) -> Any:
        return holder.GetAttribute(name).Get(placed.time)

    held = layout.parse_map_text(read_value(layout.SKY_SOURCE))
    if held is None or held[0] != sky.sha256:
        return sky
    sky = dataclasses.replace(sky, source=held[1])
    if not placed.prim.HasAttribute(layout.VISIBLE_TO_CAMERA):
        sky = dataclasses.replace(sky, is_seen=bool(read_value(layout.SKY_VISIBLE)))
    rows = list(map(read_value, layout.SKY_ROWS))
    if None in rows or not np.allclose(rows, sky.rotation, atol=layout.SAME_VALUE):
        return sky
    return dataclasses.replace(sky, rotation=np.array(rows, np.float32))


def _pole_rotation(prim: Any) -> NDArray[np.float64]:
    """Return the rotation of a dome from its pole +Y to the axis that a DomeLight_1 states."""
    stated = prim.GetAttribute("poleAxis")
    axis = stated.Get() if stated else UsdGeom.Tokens.y
    if axis == "scene":
        axis = UsdGeom.GetStageUpAxis(prim.GetStage())
    is_turned = axis == UsdGeom.Tokens.z
    return np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if is_turned else np.eye(3)


def _read_map(placed: PlacedPrim, opened: OpenedStage) -> NDArray[np.float64]:
    """Return the map [H, 2 H, 3] of a dome; uniform radiance 1 where it names no file.

    Raises:
        Rejected: the map is missing, no picture that is read, or of another projection.
    """
    named, resolved = resolve_file(placed.prim.GetAttribute(layout.MAP_PATH), opened)
    if not named:
        return np.ones((1, 2, 3))
    projection = placed.value("inputs:texture:format")
    if projection not in (None, "automatic", "latlong"):
        raise Rejected("projection", f"a picture of format {projection}; expected latlong")
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        raise Rejected("missing_file", f"map {named!r:.100} is missing")
    try:
        picture = read_linear_picture(data, MAX_PIXELS)
        if picture is None:
            pixels = decode_image(data, named, MAX_PIXELS, opened.lost, of_scene=True)[::-1]
        else:
            pixels = picture.values
            opened.lost += [f"{named!r:.100}: {sentence}" for sentence in picture.unread]
    except Rejected as error:
        text = error.message.removeprefix(f"{named!r:.80}: ")
        raise Rejected(error.reason, f"map {named!r:.100} is not read: {text}") from error
    linear = Picture(values=pixels, is_srgb=pixels.dtype == np.uint8).linear(pixels)
    rgb = linear[..., :3] if linear.shape[2] >= 3 else np.repeat(linear[..., :1], 3, axis=2)
    return rgb.astype(np.float64)
