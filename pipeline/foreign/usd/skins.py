"""Meshes posed by skeletons and blend shapes, as UsdSkel computes them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError

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

    def pose(self, prim: Any, stated: Any, time: Any) -> NDArray[np.float64]:
        """Return the posed points [P, 3] of a mesh in its own space.

        Args:
            prim: the mesh.
            stated: unposed points as a USD array.
            time: time of the pose.

        Raises:
            UnposedMesh: joints, weights and points contradict each other.
        """
        from pxr import UsdGeom, Vt

        points = Vt.Vec3fArray(stated)
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


class BoundSkins:
    """All skins of a stage, by the path of their mesh."""

    def __init__(self, time: Any) -> None:
        from pxr import UsdSkel

        self._time = time
        self._cache = UsdSkel.Cache()
        self._bound: dict[Any, BoundSkin] = {}
        self._roots: set[Any] = set()

    def add_root(self, prim: Any, predicate: Any) -> None:
        """Add the skins that a SkelRoot binds below it."""
        from pxr import UsdSkel

        if prim.GetPath() in self._roots:
            return
        self._roots.add(prim.GetPath())
        root = UsdSkel.Root(prim)
        self._cache.Populate(root, predicate)
        for bound in self._cache.ComputeSkelBindings(root, predicate):
            skeleton = self._cache.GetSkelQuery(bound.GetSkeleton())
            for target in bound.GetSkinningTargets():
                if not (target.HasJointInfluences() or target.HasBlendShapes()):
                    continue
                path = target.GetPrim().GetPath()
                bones = bound.GetSkeleton().GetPrim()
                self._bound[path] = BoundSkin(bones=bones, skeleton=skeleton, binding=target)

    def find(self, prim: Any) -> BoundSkin | None:
        """Return the skin of a prim, or None.

        Raises:
            UnposedMesh: bones are bound to it in a way that UsdSkel does not support.
        """
        skin = self._bound.get(prim.GetPath())
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
    from pxr import UsdSkel

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
