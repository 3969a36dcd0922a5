"""Every mesh, light and camera of a composed stage with its place in our world, instances too."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError

MAX_PLACED = 100_000
"""Maximum number of visited prims; every instance counts."""
MAX_NESTED = 150
"""Maximum nesting of prims, through prototypes too."""

SCENE_KINDS = ("Mesh", "Camera", "RectLight", "DiskLight", "SphereLight", "DomeLight")
"""Kinds of prims that a scene is made of."""
_SILENT = ("Xform", "Scope", "Material", "Shader", "NodeGraph", "GeomSubset", "SkelRoot", "")


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A prim in its place."""

    prim: Any  # the USD prim; several places may share one
    to_world: NDArray[np.float64]  # [4, 4], for column vectors, into metres with +Z up


def placed_prims(
    stage: Any, time: Any, lost: list[str], kinds: Collection[str] = SCENE_KINDS
) -> list[Placed]:
    """Return the prims of some kinds that are seen of a stage at a time, in its own order.

    Invisible prims, guides and proxies are left out; kinds of prims that cannot be read are noted.

    Raises:
        TrilightError: more than MAX_PLACED prims with all instances, prims or prototypes that are
            nested more than MAX_NESTED deep, or a place that is not finite.
    """
    found: list[Placed] = []
    unread: Counter[str] = Counter()
    visits = 0
    for prim, to_world in _visited(stage.GetPseudoRoot(), _base(stage), time):
        visits += 1
        if visits > MAX_PLACED:
            raise TrilightError(f"more than {MAX_PLACED} prims with all instances.")
        kind = str(prim.GetTypeName())
        if kind in kinds:
            if not np.isfinite(to_world).all():
                raise TrilightError(f"{prim.GetPath()}: its place is not finite.")
            found.append(Placed(prim=prim, to_world=to_world))
        elif kind not in _SILENT and kind != "PointInstancer":
            unread[kind] += 1
    lost += [f"{count} x {kind}: such prims are not read" for kind, count in sorted(unread.items())]
    return found


def _base(stage: Any) -> NDArray[np.float64]:
    """Return the matrix from a stage's units and axis to metres with +Z up."""
    from pxr import UsdGeom

    metres = UsdGeom.GetStageMetersPerUnit(stage)
    base = np.diag([metres, metres, metres, 1.0])
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        base[:3, :3] = metres * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    return base


def _visited(
    root: Any, base: NDArray[np.float64], time: Any
) -> Iterator[tuple[Any, NDArray[np.float64]]]:
    """Yield what is seen below a prim with its place, in the order of the tree."""
    from pxr import UsdGeom

    levels = [_children(root, base)]
    while levels:
        found = next(levels[-1], None)
        if found is None:
            levels.pop()
            continue
        prim, above = found
        if len(levels) > MAX_NESTED:
            raise TrilightError(
                f"{prim.GetPath()}: nested more than {MAX_NESTED} deep, prototypes counted."
            )
        seen = UsdGeom.Imageable(prim)
        if seen and seen.GetVisibilityAttr().Get(time) == UsdGeom.Tokens.invisible:
            continue
        if seen and seen.GetPurposeAttr().Get(time) in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            continue
        to_world = _moved(prim, above, time)
        yield prim, to_world
        below = _instances if prim.IsA(UsdGeom.PointInstancer) else _children
        levels.append(below(prim, to_world, time))


def _children(
    prim: Any, to_world: NDArray[np.float64], time: Any = None
) -> Iterator[tuple[Any, NDArray[np.float64]]]:
    from pxr import Usd

    return ((child, to_world) for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies()))


def _moved(prim: Any, above: NDArray[np.float64], time: Any) -> NDArray[np.float64]:
    from pxr import UsdGeom

    move = UsdGeom.Xformable(prim)
    if not move:
        return above
    local = np.array(move.GetLocalTransformation(time)).T
    start = _base(prim.GetStage()) if move.GetResetXformStack() else above
    return np.einsum("ij,jk->ik", start, local)


def _instances(
    prim: Any, to_world: NDArray[np.float64], time: Any
) -> Iterator[tuple[Any, NDArray[np.float64]]]:
    from pxr import UsdGeom

    instancer = UsdGeom.PointInstancer(prim)
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    which = instancer.GetProtoIndicesAttr().Get(time) or []
    if len(which) > MAX_PLACED:  # before their places are computed
        raise TrilightError(
            f"{prim.GetPath()}: {len(which)} instances; expected at most {MAX_PLACED}."
        )
    moves = instancer.ComputeInstanceTransformsAtTime(
        time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
    )
    shown = instancer.ComputeMaskAtTime(time) or [True] * len(which)
    for index, move, visible in zip(which, moves, shown, strict=False):
        if not visible or not 0 <= index < len(targets):
            continue
        prototype = prim.GetStage().GetPrimAtPath(targets[index])
        if prototype:
            place = np.einsum("ij,jk->ik", to_world, np.array(move).T)
            yield prototype, place
