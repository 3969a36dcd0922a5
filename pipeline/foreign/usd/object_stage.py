"""`open_stage`: the visible meshes of a USD object, opened within bounds, or its refusal by name.

USD itself resolves the names of other files, so it receives a path; every file that it may open is
checked first (pipeline.foreign.usd.stage). Contents that would give a plausible but wrong mesh are
refused: a missing reference, surfaces other than polygons, bones without a pose.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.usd.placed import PlacedPrim, placed_prims
from pipeline.foreign.usd.skins import UnposedMesh
from pipeline.foreign.usd.solids import SOLIDS
from pipeline.foreign.usd.stage import OpenedStage, OutsideFile, read_quietly
from storage.errors import Rejected, TrilightError

Read = TypeVar("Read")


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdStage:
    """A composed stage with its visible meshes."""

    opened: OpenedStage
    """Opened layers of the stage, with notes on unread contents."""
    composed: Any
    """The Usd.Stage, kept because its prims expire with it."""
    meshes: tuple[PlacedPrim, ...]
    """Visible meshes with transforms to meters, +Z up."""
    time: Any
    """The Usd.TimeCode at which values are read: the first of an animated stage."""


def open_stage(path: Path, limits: ReadLimits) -> UsdStage:
    """Return the stage of a file.

    Raises:
        Rejected: external_uri, load_error, missing_file, too_many_instances,
            unsupported_primitive, skinned_mesh.
    """
    return read_or_reject(path, lambda: _read_stage(path, limits))


def read_or_reject(path: Path, read: Callable[[], Read]) -> Read:
    """Return the result of `read` for a USD file; its errors become reasons of Rejected.

    Raises:
        Rejected: external_uri, skinned_mesh, load_error, or as `read`.
    """
    try:
        return read_quietly(path, read)
    except TrilightError as error:
        reasons = {OutsideFile: "external_uri", UnposedMesh: "skinned_mesh"}
        raise Rejected(reasons.get(type(error), "load_error"), f"{error!s:.300}") from error


def _read_stage(path: Path, limits: ReadLimits) -> UsdStage:
    from pxr import Usd

    opened = OpenedStage(path, max_file_bytes=limits.max_bytes)
    stage = opened.compose()
    time = Usd.TimeCode.EarliestTime()
    if opened.unresolved:
        raise Rejected("missing_file", f"{opened.unresolved[0]}; an object needs all of its parts")
    placed = placed_prims(stage, time, opened.lost, ("Mesh", *SOLIDS, "NurbsPatch"))
    if len(placed) > limits.max_instances:
        raise Rejected("too_many_instances", f"{len(placed)} meshes; <= {limits.max_instances}")
    for each in placed:
        kind = each.prim.GetTypeName()
        where = str(each.prim.GetPath())
        if kind == "NurbsPatch":
            raise Rejected("unsupported_primitive", f"{where!r:.100} is a {kind}; make it a mesh")
        scheme = each.prim.GetAttribute("subdivisionScheme")
        if scheme and scheme.Get() != "none":
            opened.lost.append(f"{where}: subdivision; its cage was read")
    return UsdStage(opened=opened, composed=stage, meshes=tuple(placed), time=time)
