"""Builds a `Scene` from the placed prims of a USD stage."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.exchange.textured_triangles import (
    NO_TEXTURES,
    TexturedPiece,
    TexturedTriangles,
    build_piece,
    build_textured_scene,
    join_arrays,
    split_by_kind,
)
from pipeline.exchange.usd.dome import read_foreign_dome
from pipeline.exchange.usd.foreign_cameras import fit_camera, read_stage_cameras
from pipeline.exchange.usd.foreign_lights import compute_radiance, light_triangles
from pipeline.exchange.usd.foreign_materials import StageSurfaces
from pipeline.exchange.usd.foreign_meshes import read_mesh
from pipeline.exchange.usd.names import FOV_DEG, INDEX, OBJECT_TEXTS, parse_camera_row
from pipeline.foreign.usd.object_stage import UsdStage
from pipeline.foreign.usd.placed import DOMES, PlacedPrim, placed_prims
from pipeline.foreign.usd.solids import SOLIDS
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.scenes.shading import flat_shaded
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import EMISSION, ROUGHNESS, default_rows
from storage.records.scene import ObjectKind, Scene, SceneObject

MAX_TRIANGLES = 1_000_000
MAX_ROWS = 1 << 16
"""Maximum number of objects, and of materials, in a scene."""


def build_stage_scene(stage: Any, time: Any, opened: OpenedStage, licence: str) -> Scene:
    """Build the scene of a stage at a time; `opened.lost` receives notes on losses.

    Raises:
        TrilightError: a count exceeds its maximum, arrays contradict each other, or the stage lacks
            triangles or light.
    """
    placed = sorted(placed_prims(stage, time, opened.lost), key=_read_row)
    meshes = tuple(each for each in placed if each.prim.GetTypeName() in ("Mesh", *SOLIDS))
    surfaces = StageSurfaces(
        UsdStage(opened=opened, composed=stage, meshes=meshes, time=time), licence
    )
    numbers = iter(range(len(meshes)))
    pieces: list[TexturedPiece] = []
    names: set[str] = set()
    num_triangles = 0
    for each in placed:
        if each.prim.GetTypeName() in ("Camera", *DOMES):
            continue
        if each.prim.GetTypeName() in ("Mesh", *SOLIDS):
            triangles = _convert_mesh(each, next(numbers), surfaces, time, opened.lost)
        else:
            triangles = _convert_light(each, time, opened.lost)
        if triangles is None:
            continue
        new_pieces = [
            build_piece(_entry(each.prim, kind, licence, names), part)
            for kind, part in split_by_kind(triangles)
        ]
        num_triangles += sum(len(one.piece.mesh.faces) for one in new_pieces)
        if num_triangles > MAX_TRIANGLES:
            raise TrilightError(f"more than {MAX_TRIANGLES} triangles.")
        pieces += new_pieces
        if len(pieces) > MAX_ROWS:
            raise TrilightError(f"more than {MAX_ROWS} objects.")
    sky = _read_environment(placed, time, opened, licence)
    is_lit = sky is not None and sky.radiance_rgb.any()
    if not is_lit and not any(one.piece.entry.kind == "emitter" for one in pieces):
        unread = "; ".join(note for note in opened.lost if "light" in note.lower())
        raise TrilightError(
            f"no light that can be carried over ({unread or 'none is seen':.200}); expected an "
            "emissive material, or a rectangle, disk, sphere, cylinder, mesh or dome light."
        )
    materials = sum(len(one.piece.materials) for one in pieces)
    if materials > MAX_ROWS:
        raise TrilightError(f"{materials} materials; expected at most {MAX_ROWS}.")
    return _build_scene(pieces, placed, time, opened, sky)


def _read_row(each: PlacedPrim) -> float:
    """Return the row that Trilight wrote on an object or camera; infinity for other prims."""
    prim = each.prim
    row = prim.GetAttribute(INDEX).Get()
    if prim.HasAttribute(FOV_DEG):
        row = parse_camera_row(prim.GetName())
    return row if isinstance(row, int) else math.inf


def _build_scene(
    pieces: Sequence[TexturedPiece],
    placed: Sequence[PlacedPrim],
    time: Any,
    opened: OpenedStage,
    sky: Environment | None,
) -> Scene:
    arrays = join_arrays(pieces)
    camera_prims = [each for each in placed if each.prim.GetTypeName() == "Camera"]
    c2w, fov_deg = read_stage_cameras(camera_prims, time, opened.lost)
    if not len(c2w):
        opened.lost.append("no camera: one was added that sees everything")
        c2w, fov_deg = fit_camera(arrays["vertex_positions"])
    code = time.GetValue() if time.IsNumeric() and not time.IsEarliestTime() else None
    return build_textured_scene(
        arrays,
        pieces,
        c2w=c2w,
        fov_deg=fov_deg,
        provenance={"template": "usd", "file": opened.path.name, "time_code": code},
        environment=sky,
    )


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


def _convert_light(each: PlacedPrim, time: Any, lost: list[str]) -> TexturedTriangles | None:
    triangles = light_triangles(each, time, lost)
    if triangles is None:
        return None
    count = len(triangles)
    rows = default_rows(count)
    rows[:, ROUGHNESS] = 1
    rows[:, EMISSION] = compute_radiance(each, triangles, time, lost)
    corners = triangles.reshape(-1, 3)
    flat = flat_shaded(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    return TexturedTriangles(
        positions=triangles,
        normals=flat.normals.reshape(-1, 3, 3),
        rows=rows,
        uv=np.zeros((count, 3, 2), np.float32),
        texture_set_index=np.zeros(count, np.int64),
        texture_sets=(NO_TEXTURES,),
    )


def _convert_mesh(
    placed: PlacedPrim, number: int, surfaces: StageSurfaces, time: Any, lost: list[str]
) -> TexturedTriangles | None:
    prim = placed.prim
    soup = read_mesh(placed, time, lost)
    if not len(soup.positions):
        lost.append(f"{prim.GetPath()}: no triangle with an area")
        return None
    triangles = surfaces.convert(number, soup)
    rows = triangles.rows
    if prim.HasAPI("MeshLightAPI"):
        light = compute_radiance(placed, soup.positions, time, lost)
        mode = prim.GetAttribute("light:materialSyncMode").Get(time)
        glows = rows[:, EMISSION].any()
        tints = mode == "materialGlowTintsLight" and glows
        rows[:, EMISSION] = rows[:, EMISSION] * light if tints else light
        if mode == "materialGlowTintsLight" and not glows:
            lost.append(
                f"{prim.GetPath()}: its material emits nothing; the radiance of the light is used"
            )
    return triangles


def _entry(prim: Any, kind: ObjectKind, licence: str, names: set[str]) -> SceneObject:
    """Return the object entry of a prim: values that Trilight wrote on it, or its name."""
    texts = {field: prim.GetAttribute(name).Get() for field, name in OBJECT_TEXTS.items()}
    known = {field: text for field, text in texts.items() if isinstance(text, str)}
    base = known.get("name") or prim.GetName()
    name = base
    count = 1
    while name in names:
        count += 1
        name = f"{base}.{count}"
    names.add(name)
    if kind == "object" and known.get("kind") == "shell":
        kind = "shell"
    return SceneObject(
        name=name,
        kind=kind,
        uid=known.get("uid", ""),
        licence=known.get("licence") or licence,
        attribution=known.get("attribution", ""),
        source_url=known.get("source_url", ""),
    )
