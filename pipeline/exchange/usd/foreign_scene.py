"""Makes a `Scene` of the placed prims of a stage."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.dressed import (
    PLAIN,
    DressedPiece,
    DressedTriangles,
    by_kind,
    dressed,
    joined_arrays,
    scene_with_worn,
)
from pipeline.exchange.usd.dome import foreign_dome
from pipeline.exchange.usd.foreign_cameras import camera_that_sees_all, cameras
from pipeline.exchange.usd.foreign_lights import light_triangles, radiance
from pipeline.exchange.usd.foreign_materials import dressing
from pipeline.exchange.usd.foreign_meshes import TriangleSoup, read_mesh
from pipeline.exchange.usd.names import FOV_DEG, INDEX, OBJECT_TEXTS, parse_camera_row
from pipeline.foreign.usd.placed import DOMES, Placed, placed_prims
from pipeline.foreign.usd.solids import SOLIDS
from pipeline.foreign.usd.stage import OpenedUsd
from pipeline.scenes.shading import flat_shaded
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import EMISSION, ROUGHNESS, default_rows
from storage.records.scene import ObjectKind, Scene, SceneObject

MAX_TRIANGLES = 1_000_000
MAX_ROWS = 1 << 16
"""Maximum number of objects and of materials in a scene."""


def scene_of_stage(stage: Any, time: Any, opened: OpenedUsd, licence: str) -> Scene:
    """Return the scene that a stage shows at a time; what is lost goes to `opened.lost`.

    Raises:
        TrilightError: too much of something, arrays that contradict each other, or no triangle or
            no light at all.
    """
    placed = sorted(placed_prims(stage, time, opened.lost), key=_read_row)
    pieces: list[DressedPiece] = []
    names: set[str] = set()
    triangles = 0
    for each in placed:
        if each.prim.GetTypeName() in ("Camera", *DOMES):
            continue
        found = _pieces(each, time, opened, licence, names)
        triangles += sum(len(one.piece.mesh.faces) for one in found)
        if triangles > MAX_TRIANGLES:
            raise TrilightError(f"more than {MAX_TRIANGLES} triangles.")
        pieces += found
        if len(pieces) > MAX_ROWS:
            raise TrilightError(f"more than {MAX_ROWS} objects.")
    sky = _environment(placed, time, opened, licence)
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
    return _scene(pieces, placed, time, opened, sky)


def _read_row(each: Placed) -> float:
    """Return the row that Trilight once wrote on an object or camera; infinity for any other."""
    prim = each.prim
    row = prim.GetAttribute(INDEX).Get()
    if prim.HasAttribute(FOV_DEG):
        row = parse_camera_row(prim.GetName())
    return row if isinstance(row, int) else math.inf


def _scene(
    pieces: Sequence[DressedPiece],
    placed: Sequence[Placed],
    time: Any,
    opened: OpenedUsd,
    sky: Environment | None,
) -> Scene:
    arrays = joined_arrays(pieces)
    seen = [each for each in placed if each.prim.GetTypeName() == "Camera"]
    c2w, fov_deg = cameras(seen, time, opened.lost)
    if not len(c2w):
        opened.lost.append("no camera: one was added that sees everything")
        c2w, fov_deg = camera_that_sees_all(arrays["vertex_positions"])
    code = time.GetValue() if time.IsNumeric() and not time.IsEarliestTime() else None
    return scene_with_worn(
        arrays,
        pieces,
        c2w=c2w,
        fov_deg=fov_deg,
        provenance={"template": "usd", "file": opened.path.name, "time_code": code},
        environment=sky,
    )


def _environment(
    placed: Sequence[Placed], time: Any, opened: OpenedUsd, licence: str
) -> Environment | None:
    """Return that of the first dome that can be read; others are noted."""
    domes = [each for each in placed if each.prim.GetTypeName() in DOMES]
    sky = None
    for each in domes:
        if sky is not None:
            opened.lost.append(f"{each.prim.GetPath()}: a second dome; one lights a scene here")
            continue
        sky = foreign_dome(each.prim, each.to_world, time, opened, licence)
    return sky


def _pieces(
    each: Placed, time: Any, opened: OpenedUsd, licence: str, names: set[str]
) -> list[DressedPiece]:
    prim = each.prim
    if prim.GetTypeName() not in ("Mesh", *SOLIDS):
        triangles = light_triangles(each, time, opened.lost)
        if triangles is None:
            return []
        light = radiance(each, triangles, time, opened.lost)
        return _split(each, _of_light(triangles, light), licence, names)
    soup = read_mesh(each, time, opened.lost)
    if not len(soup.positions):
        opened.lost.append(f"{prim.GetPath()}: no triangle with an area")
        return []
    return _split(each, _of_mesh(each, soup, time, opened, licence), licence, names)


def _of_light(triangles: NDArray[np.float32], light: NDArray[np.float32]) -> DressedTriangles:
    count = len(triangles)
    rows = default_rows(count)
    rows[:, ROUGHNESS] = 1
    rows[:, EMISSION] = light
    corners = triangles.reshape(-1, 3)
    flat = flat_shaded(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    return DressedTriangles(
        positions=triangles,
        normals=flat.normals.reshape(-1, 3, 3),
        rows=rows,
        uv=np.zeros((count, 3, 2), np.float32),
        worn=np.zeros(count, np.int64),
        wardrobe=(PLAIN,),
    )


def _of_mesh(
    placed: Placed, soup: TriangleSoup, time: Any, opened: OpenedUsd, licence: str
) -> DressedTriangles:
    prim = placed.prim
    found = dressing(soup, time, opened, licence)
    rows = found.rows
    if prim.HasAPI("MeshLightAPI"):
        light = radiance(placed, soup.positions, time, opened.lost)
        mode = prim.GetAttribute("light:materialSyncMode").Get(time)
        glows = rows[:, EMISSION].any()
        tints = mode == "materialGlowTintsLight" and glows
        rows[:, EMISSION] = rows[:, EMISSION] * light if tints else light
        if mode == "materialGlowTintsLight" and not glows:
            opened.lost.append(
                f"{prim.GetPath()}: its material does not glow; the light's own taken"
            )
    return DressedTriangles(
        positions=soup.positions,
        normals=soup.normals,
        rows=rows,
        uv=found.uv,
        worn=found.worn,
        wardrobe=found.wardrobe,
    )


def _split(
    each: Placed, triangles: DressedTriangles, licence: str, names: set[str]
) -> list[DressedPiece]:
    """Return the part of a mesh that reflects, and the part that emits, where there are both."""
    return [
        dressed(_entry(each.prim, kind, licence, names), part) for kind, part in by_kind(triangles)
    ]


def _entry(prim: Any, kind: ObjectKind, licence: str, names: set[str]) -> SceneObject:
    """Return what is known of a prim: what Trilight once wrote on it, or its name."""
    texts = {field: prim.GetAttribute(name).Get() for field, name in OBJECT_TEXTS.items()}
    known = {field: text for field, text in texts.items() if isinstance(text, str)}
    base = known.get("name") or prim.GetName()
    name, count = base, 1
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
