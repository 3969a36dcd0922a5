"""Visible meshes, lights and cameras of a stage with their world transforms, instances included.

UsdGeom defines visibility: inherited visibility and purposes, and prototypes of a PointInstancer
wherever they are defined, also below an `over` or a class. UsdSkel poses meshes by their skeletons
and blend shapes.
"""

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdSkel, Vt

from pipeline.foreign.numbers import FINITE, read_number
from storage.errors import TrilightError
from storage.settings.ranges import Within

_JOINTS = "primvars:skel:jointIndices"
_ANIMATION = "skel:animationSource"


class UnposedMesh(TrilightError):
    """A mesh with bones that UsdSkel does not pose as its file seems to intend."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundSkin:
    """A skeleton bound to a mesh."""

    bones: Any  # prim of the skeleton; posed points are in its space
    skeleton: Any  # UsdSkel.SkeletonQuery
    binding: Any  # UsdSkel.SkinningQuery

    def pose(self, placed: "PlacedPrim") -> NDArray[np.float64]:
        """Return the posed points [P, 3] of a mesh in its own space.

        Raises:
            UnposedMesh: joints, weights and points contradict each other.
        """
        prim = placed.prim
        time = placed.time
        points = Vt.Vec3fArray(placed.value("points"))
        if self.binding.HasBlendShapes():
            _blend_shapes(self.skeleton, self.binding, prim, points, time)
        if not self.binding.HasJointInfluences():
            return np.array(points, np.float64)
        is_bound = self.skeleton and self.skeleton.HasBindPose()
        moves = self.skeleton.ComputeSkinningTransforms(time) if is_bound else None
        if not moves or not self.binding.ComputeSkinnedPoints(moves, points, time):
            raise UnposedMesh(f"{prim.GetPath()}: bones pose it, and UsdSkel cannot compute how.")
        places = UsdGeom.XformCache(time)
        bones = places.GetLocalToWorldTransform(self.bones)
        move = np.array(bones * places.GetLocalToWorldTransform(prim).GetInverse())
        return np.einsum("pi,ij->pj", np.array(points, np.float64), move[:3, :3]) + move[3, :3]


def bind_skins(prim: Any, predicate: Any, cache: Any) -> dict[Any, BoundSkin]:
    """Return the skins that a SkelRoot binds below it, by the paths of their meshes."""
    root = UsdSkel.Root(prim)
    cache.Populate(root, predicate)
    return {
        target.GetPrim().GetPath(): BoundSkin(
            bones=bound.GetSkeleton().GetPrim(),
            skeleton=cache.GetSkelQuery(bound.GetSkeleton()),
            binding=target,
        )
        for bound in cache.ComputeSkelBindings(root, predicate)
        for target in bound.GetSkinningTargets()
        if target.HasJointInfluences() or target.HasBlendShapes()
    }


def find_skin(skins: Mapping[Any, BoundSkin], prim: Any) -> BoundSkin | None:
    """Return the skin of a prim by its path, or None.

    Raises:
        UnposedMesh: bones are bound to it in a way that UsdSkel does not support.
    """
    skin = skins.get(prim.GetPath())
    stated = prim.GetRelationship(_ANIMATION)
    is_posed = skin is not None and skin.binding.HasJointInfluences()
    if not is_posed and prim.GetAttribute(_JOINTS).HasValue():
        raise UnposedMesh(
            f"{prim.GetPath()}: it has bones, and no skeleton and weights pose it. "
            "Apply the skin before exporting."
        )
    names = {path.name for path in stated.GetForwardedTargets()} if skin and stated else set()
    used = skin.skeleton.GetAnimQuery() if skin and skin.skeleton else None
    if names - {used.GetPrim().GetName() if used else ""}:
        raise UnposedMesh(
            f"{prim.GetPath()}: its animation is bound to the mesh; UsdSkel poses by that of "
            "the skeleton alone. Bind it there, or apply the skin before exporting."
        )
    return skin


def _blend_shapes(skeleton: Any, binding: Any, prim: Any, points: Any, time: Any) -> None:
    """Deform points in place by the blend shapes of an animation, if there is one."""
    animation = skeleton.GetAnimQuery() if skeleton else None
    weights = animation.ComputeBlendShapeWeights(time) if animation else None
    if not weights:
        return
    mapper = binding.GetBlendShapeMapper()
    shape_weights = mapper.Remap(weights) if mapper else weights
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
    shapes.ComputeDeformedPoints(
        *shapes.ComputeSubShapeWeights(shape_weights),
        shapes.ComputeBlendShapePointIndices(),
        shapes.ComputeSubShapePointOffsets(),
        points,
    )


MAX_PLACED = 100_000
"""Maximum number of visited prims; every instance counts."""
MAX_NESTED = 150
"""Maximum nesting of prims, through prototypes too."""

DOMES = ("DomeLight", "DomeLight_1")
SOLIDS = ("Cube", "Sphere", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane",
          "TetMesh")  # fmt: skip
"""Types of prims whose polygons are generated (pipeline.foreign.usd.polygons)."""
LAMPS = ("RectLight", "DiskLight", "SphereLight", "CylinderLight")
SCENE_KINDS = ("Mesh", *SOLIDS, "Camera", *LAMPS, *DOMES)
"""Types of prims that scenes are read from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedPrim:
    """A prim with its world transform."""

    prim: Any  # the Usd.Prim; several instances may share one
    to_world: NDArray[np.float64]  # [4, 4] for column vectors, to meters with +Z up
    time: Any  # the Usd.TimeCode of its values
    meters_per_unit: float = 1.0  # length of a unit of the stage
    skin: BoundSkin | None = None  # the skin that poses a mesh
    lost: list[str] = field(default_factory=list)  # receives notes on contents that are not read

    def value(self, name: str) -> Any:
        """Return the value of an attribute of the prim; None without one."""
        return self.prim.GetAttribute(name).Get(self.time)

    def number(self, name: str, within: Within = FINITE) -> float:
        """Return the value of an attribute that is a number; raises Malformed for another one."""
        return read_number(self.value(name), f"{self.prim.GetPath()}.{name}", within)

    def note(self, text: str) -> None:
        """Note something of the prim that is not read."""
        self.lost.append(f"{self.prim.GetPath()}: {text}")


def placed_prims(
    stage: Any, time: Any, lost: list[str], kinds: Collection[str] = SCENE_KINDS
) -> list[PlacedPrim]:
    """Return the visible prims of some kinds of a stage at a time, in the order of the stage.

    Invisible prims, guides and proxies are left out; notes name unread schemas.

    Raises:
        TrilightError: more than MAX_PLACED prims with all instances, prims or prototypes that are
            nested more than MAX_NESTED deep, a transform that is not finite, or UnposedMesh.
    """
    placed: list[PlacedPrim] = []
    unread = Counter[str]()
    known: dict[Any, list[str]] = {}
    skins: dict[Any, BoundSkin] = {}
    skeletons = UsdSkel.Cache()
    above_zero = Within(0, FINITE.high, low_open=True)
    meters_per_unit = read_number(UsdGeom.GetStageMetersPerUnit(stage), "metersPerUnit", above_zero)
    base = _stage_to_world(stage, meters_per_unit)
    root = _Visit(
        prim=stage.GetPseudoRoot(),
        to_world=base,
        time=time,
        meters_per_unit=meters_per_unit,
        lost=lost,
        origin=base,
        predicate=Usd.TraverseInstanceProxies(),
    )
    for number, visit in enumerate(_visit_below(_visit_children(root))):
        if number >= MAX_PLACED:
            raise TrilightError(f"more than {MAX_PLACED} prims with all instances.")
        prim = visit.prim
        kind = str(prim.GetTypeName())
        path = prim.GetPath()
        if path not in known:  # instances of one prototype have one path
            known[path] = list(list_unread(prim, time, kinds))
            if kind == "SkelRoot":
                skins |= bind_skins(prim, visit.predicate, skeletons)
        unread.update(known[path])
        if kind in kinds:
            if not np.isfinite(visit.to_world).all():
                raise TrilightError(f"{path}: its place is not finite.")
            placed.append(dataclasses.replace(visit, skin=find_skin(skins, prim)))
    lost += [f"{count} x {kind}: not read" for kind, count in sorted(unread.items())]
    return placed


def _stage_to_world(stage: Any, meters_per_unit: float) -> NDArray[np.float64]:
    """Return the matrix [4, 4] from a stage's units and up axis to meters with +Z up."""
    base = np.diag([meters_per_unit, meters_per_unit, meters_per_unit, 1.0])
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        base[:3, :3] = meters_per_unit * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    return base


@dataclass(frozen=True, kw_only=True, eq=False)
class _Visit(PlacedPrim):
    """A prim with what it inherits; `to_world` is its parent's until its own one is applied."""

    origin: NDArray[np.float64]  # start of `!resetXformStack!`: of the stage, or of an instance
    purpose: str = "default"
    is_render_shown: bool = True  # VisibilityAPI's answer for the purpose `render`
    predicate: Any = None  # selects the children to visit


def _visit_below(visits: Iterator[_Visit], depth: int = 1) -> Iterator[_Visit]:
    """Yield the visible ones of prims and of all below them, placed, in the order of the tree."""
    for above in visits:
        prim = above.prim
        if depth > MAX_NESTED:
            raise TrilightError(
                f"{prim.GetPath()}: nested more than {MAX_NESTED} deep, prototypes counted."
            )
        imageable = UsdGeom.Imageable(prim)
        if imageable and imageable.GetVisibilityAttr().Get(above.time) == UsdGeom.Tokens.invisible:
            continue
        visit = _apply_own(above, imageable)
        is_shown = visit.purpose == "default" or (
            visit.purpose == "render" and visit.is_render_shown
        )
        if is_shown:  # else a child may still have a purpose of its own
            yield visit
        is_instancer = prim.IsA(UsdGeom.PointInstancer)
        if is_shown or not is_instancer:
            below = _visit_instances(visit) if is_instancer else _visit_children(visit)
            yield from _visit_below(below, depth + 1)


def _visit_children(above: _Visit) -> Iterator[_Visit]:
    children = above.prim.GetFilteredChildren(above.predicate)
    return (dataclasses.replace(above, prim=child) for child in children)


def _apply_own(above: _Visit, imageable: Any) -> _Visit:
    """Return a visit with the prim's own transform and purpose, if any; its children inherit it."""
    if not imageable:
        return above
    purpose = imageable.GetPurposeAttr()
    is_shown = above.is_render_shown
    if above.prim.HasAPI(UsdGeom.VisibilityAPI):
        stated = UsdGeom.VisibilityAPI(above.prim).GetRenderVisibilityAttr().Get(above.time)
        is_shown = is_shown if stated in (None, "inherited") else stated == "visible"
    to_world = above.to_world
    if move := UsdGeom.Xformable(above.prim):
        local = np.array(move.GetLocalTransformation(above.time)).T
        start = above.origin if move.GetResetXformStack() else to_world
        to_world = np.einsum("ij,jk->ik", start, local)
    return dataclasses.replace(
        above,
        to_world=to_world,
        purpose=str(purpose.Get()) if purpose.HasAuthoredValue() else above.purpose,
        is_render_shown=is_shown,
    )


def _visit_instances(above: _Visit) -> Iterator[_Visit]:
    prim = above.prim
    time = above.time
    instancer = UsdGeom.PointInstancer(prim)
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    prototype_indices = instancer.GetProtoIndicesAttr().Get(time) or []
    if len(prototype_indices) > MAX_PLACED:  # before their transforms are computed
        raise TrilightError(
            f"{prim.GetPath()}: {len(prototype_indices)} instances; expected at most {MAX_PLACED}."
        )
    moves = instancer.ComputeInstanceTransformsAtTime(
        time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
    )
    if len(moves) != len(prototype_indices):
        raise TrilightError(
            f"{prim.GetPath()}: its positions, orientations or scales are not as many as its "
            f"{len(prototype_indices)} protoIndices."
        )
    above.lost.extend(
        f"{prim.GetPath()}.{primvar.GetName()}: values of single instances are not read"
        for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()
        if primvar.GetInterpolation() != UsdGeom.Tokens.constant
    )
    visibilities = instancer.ComputeMaskAtTime(time) or [True] * len(prototype_indices)
    plain = Usd.PrimIsActive & Usd.PrimIsLoaded & Usd.PrimHasDefiningSpecifier
    for index, move, visible in zip(prototype_indices, moves, visibilities, strict=True):
        named = targets[index] if 0 <= index < len(targets) else None
        prototype = None if named is None else prim.GetStage().GetPrimAtPath(named)
        if not prototype:
            above.note(f"instances of prototype {index}, which is not there")
        elif visible and prototype.IsActive():
            to_world = np.einsum("ij,jk->ik", above.to_world, np.array(move).T)
            known = plain if prototype.IsAbstract() else plain & ~Usd.PrimIsAbstract
            yield dataclasses.replace(
                above,
                prim=prototype,
                to_world=to_world,
                origin=to_world,
                predicate=Usd.TraverseInstanceProxies(known),
            )


_SILENT = (
    "|Xform|Scope|Camera|Material|Shader|NodeGraph|GeomSubset|PointInstancer|SkelRoot|Skeleton|"
    "SkelAnimation|BlendShape|Backdrop|SpatialAudio"
).split("|")
"""Types of prims that are read, or that change no shape, color or light."""

_READ = (
    "MaterialBindingAPI|SkelBindingAPI|ColorSpaceAPI|ColorSpaceDefinitionAPI|VisibilityAPI|"
    "CollectionAPI|ShapingAPI|ShadowAPI|GeomModelAPI|ModelAPI|MotionAPI|LightListAPI|ListAPI|"
    "AssetPreviewsAPI|NodeGraphNodeAPI|SceneGraphPrimAPI|AccessibilityAPI|NodeDefAPI|"
    "MaterialXConfigAPI|CoordSysAPI"
).split("|")
"""API schemas that are read, or that change no shape, color or light; each light notes its own."""

_OF_OTHERS = ("Physics", "Physx", "Semantics", "Render", "Hydra")
"""Prefixes of schemas for physics, semantics and render settings."""


def list_unread(prim: Any, time: Any, kinds: Collection[str]) -> Iterator[str]:
    """Yield names of contents of a prim that are not read, where only types `kinds` are."""
    kind = str(prim.GetTypeName())
    if not (kind in kinds or kind in _SILENT or kind.startswith(_OF_OTHERS)):
        yield kind
    for relation in prim.GetRelationships():
        if relation.GetName().startswith("material:binding"):
            targets = relation.GetForwardedTargets()
            if any(
                path.IsPrimPath() and not prim.GetStage().GetPrimAtPath(path) for path in targets
            ):
                yield "binding of a material that is not there"
    applied = prim.GetMetadata("apiSchemas")
    names = {} if applied is None else dict.fromkeys(map(str, applied.ApplyOperations([])))
    for name in dict.fromkeys(name.partition(":")[0] for name in names):
        is_read = name == "MeshLightAPI" and "RectLight" in kinds and kind == "Mesh"
        is_own = name == "LightAPI" and ("Light" in kind or "MeshLightAPI" in names)
        if not (is_read or is_own or name in _READ or name.startswith(_OF_OTHERS)):
            yield f"API schema {name}"
    mode = prim.GetAttribute("model:drawMode")
    if mode and mode.HasAuthoredValue() and mode.Get(time) not in ("default", "inherited"):
        yield f"model:drawMode {mode.Get()}"
    opacity = prim.GetAttribute("primvars:displayOpacity")
    if opacity and any(value < 1 for value in opacity.Get(time) or ()):
        yield "primvar displayOpacity"
