"""Builds a `Scene` from the placed prims of a USD stage."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.textured_triangles import (
    SceneParts,
    TexturedTriangles,
    build_lamp,
    rigid_pose,
)
from pipeline.exchange.usd.foreign_lights import (
    compute_radiance,
    light_triangles,
    read_foreign_dome,
)
from pipeline.exchange.usd.foreign_materials import StageSurfaces
from pipeline.exchange.usd.prim_names import FOV_DEG, INDEX, OBJECT_TEXTS, parse_camera_row
from pipeline.foreign.numbers import read_number
from pipeline.foreign.usd.object_source import UsdStage
from pipeline.foreign.usd.placed import DOMES, PlacedPrim, placed_prims
from pipeline.foreign.usd.solids import SOLIDS
from pipeline.foreign.usd.stage import OpenedStage
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import EMISSION
from storage.records.scene import Scene, SceneObject

_MOST_NOTED = 2
"""Maximum number of notes in the message on a stage without light."""


def build_stage_scene(
    stage: Any,
    time: Any,
    opened: OpenedStage,
    licence: str,
    written: Mapping[str, NDArray[np.float32]],
) -> Scene:
    """Read meshes, materials, lights and cameras of a Usd.Stage at a time, as a scene.

    `opened.lost` receives notes on losses. `written` has material rows as Trilight wrote them, by
    the paths of their prims, where known.

    Raises:
        TrilightError: a count exceeds its maximum, arrays contradict each other, or the stage lacks
            triangles or light.
    """
    placed = sorted(placed_prims(stage, time, opened.lost), key=_read_row)
    meshes = tuple(each for each in placed if each.prim.GetTypeName() in ("Mesh", *SOLIDS))
    usd_stage = UsdStage(opened=opened, composed=stage, meshes=meshes, time=time)
    surfaces = StageSurfaces(usd_stage, licence, written)
    numbers = iter(range(len(meshes)))
    parts = SceneParts(opened.path.name)
    cameras = []
    for each in placed:
        kind = each.prim.GetTypeName()
        if kind in ("Mesh", *SOLIDS):
            mesh = _convert_mesh(each, next(numbers), surfaces, time, opened.lost)
            if mesh is not None:
                parts.add(_entry(each.prim, licence), mesh)
        elif kind == "Camera":
            cameras.append(_read_camera(each, time, opened.lost))
        elif kind not in DOMES and (lamp := light_triangles(each, time, opened.lost)) is not None:
            radiance = compute_radiance(each, lamp, time, opened.lost)
            parts.add(_entry(each.prim, licence), build_lamp(lamp, radiance), is_lamp=True)
    sky = _read_environment(placed, time, opened, licence)
    is_lit = sky is not None and sky.radiance_rgb.any()
    if not is_lit and not parts.has_emitters:
        raise TrilightError(
            f"no light that can be carried over ({_name_lights(opened.notes)}); expected an "
            "emissive material, or a rectangle, disk, sphere, cylinder, mesh or dome light."
        )
    code = time.GetValue() if time.IsNumeric() and not time.IsEarliestTime() else None
    provenance = {"template": "usd", "file": opened.path.name, "time_code": code}
    usable = [camera for camera in cameras if camera is not None]
    return parts.build(usable, sky, provenance, opened.lost)


def _name_lights(notes: Sequence[str]) -> str:
    """Return the first notes on lights, and the number of others."""
    unread = [note for note in notes if "light" in note.replace("Trilight", "").lower()]
    more = len(unread) - _MOST_NOTED
    named = [f"{note:.100}" for note in unread[:_MOST_NOTED]]
    return "; ".join(named + [f"{more} more of lights"] * (more > 0)) or "none is seen"


def _read_row(each: PlacedPrim) -> float:
    """Return the row that Trilight wrote on an object or camera; infinity for other prims."""
    prim = each.prim
    row = prim.GetAttribute(INDEX).Get()
    if prim.HasAttribute(FOV_DEG):
        row = parse_camera_row(prim.GetName())
    return row if isinstance(row, int) else math.inf


def _read_environment(
    placed: Sequence[PlacedPrim], time: Any, opened: OpenedStage, licence: str
) -> Environment | None:
    """Return the environment of the first readable dome; note the others."""
    domes = [each for each in placed if each.prim.GetTypeName() in DOMES]
    sky = None
    for each in domes:
        if sky is not None:
            opened.lost.append(f"{each.prim.GetPath()}: a second dome; a scene has one environment")
            continue
        sky = read_foreign_dome(each.prim, each.to_world, time, opened, licence)
    return sky


def _convert_mesh(
    placed: PlacedPrim, number: int, surfaces: StageSurfaces, time: Any, lost: list[str]
) -> TexturedTriangles | None:
    triangles = surfaces.convert(placed, number)
    if triangles is None:
        return None
    prim = placed.prim
    rows = triangles.rows
    if prim.HasAPI("MeshLightAPI"):
        light = compute_radiance(placed, triangles.positions, time, lost)
        mode = prim.GetAttribute("light:materialSyncMode").Get(time)
        glows = rows[:, EMISSION].any()
        tints = mode == "materialGlowTintsLight" and glows
        rows[:, EMISSION] = rows[:, EMISSION] * light if tints else light
        if mode == "materialGlowTintsLight" and not glows:
            lost.append(
                f"{prim.GetPath()}: its material emits nothing; the radiance of the light is used"
            )
    return triangles


def _entry(prim: Any, licence: str) -> SceneObject:
    """Return the object entry of a prim: values that Trilight wrote on it, or its name."""
    texts = {field: prim.GetAttribute(name).Get() for field, name in OBJECT_TEXTS.items()}
    known = {field: text for field, text in texts.items() if isinstance(text, str)}
    return SceneObject(
        name=known.get("name") or prim.GetName(),
        kind="shell" if known.get("kind") == "shell" else "object",
        uid=known.get("uid", ""),
        licence=known.get("licence") or licence,
        attribution=known.get("attribution", ""),
        source_url=known.get("source_url", ""),
    )


_SAME_LENS = 1e-5
"""Relative tolerance for a lens that Trilight wrote."""


def _read_camera(
    placed: PlacedPrim, time: Any, lost: list[str]
) -> tuple[NDArray[np.float64], float] | None:
    """Return pose [4, 4] and full angle in degrees of a camera; None for an unusable one."""
    from pxr import UsdGeom

    camera = UsdGeom.Camera(placed.prim)
    where = placed.prim.GetPath()
    lens = (
        camera.GetFocalLengthAttr(),
        camera.GetHorizontalApertureAttr(),
        camera.GetVerticalApertureAttr(),
    )
    focal, wide, high = (read_number(each.Get(time), str(each.GetPath())) for each in lens)
    pose = rigid_pose(placed.to_world)
    if camera.GetProjectionAttr().Get(time) != "perspective" or pose is None or not focal > 0:
        lost.append(f"{where}: no perspective camera with a focal length")
        return None
    angle = math.degrees(2 * math.atan(wide / (2 * focal)))
    held = placed.prim.GetAttribute(FOV_DEG).Get(time)
    is_held = isinstance(held, float) and math.isclose(held, angle, rel_tol=_SAME_LENS)
    if not is_held and not math.isclose(wide, high, rel_tol=1e-4):
        lost.append(f"{where}: pictures are square; its horizontal angle was used")
    if any(a.Get(time) for a in (camera.GetHorizontalApertureOffsetAttr(),
                                 camera.GetVerticalApertureOffsetAttr())):  # fmt: skip
        lost.append(f"{where}: its shift has no place here")
    if camera.GetFStopAttr().Get(time):
        lost.append(f"{where}: depth of field has no place here")
    angle = held if is_held else angle
    return (pose, angle) if 0 < angle < 180 else None
