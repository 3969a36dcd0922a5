"""`MeshShape`: an object's mesh for scene_templates.placement, with FCL's collision tests.

FCL (Pan, Chitta, Manocha 2012) tests triangle against triangle in float64 over bounding volume
trees; distant objects are separated by their bounding spheres alone. A mesh inside another one does
not touch it, so a mesh also meets every mesh whose box contains its own. This rejects a ball in a
bowl.
"""

from typing import Any, Literal

import fcl
import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.posing import normalize_to_unit_sphere
from scene_templates.layout import Pose
from scene_templates.rotations import rotate_points
from storage.errors import Rejected
from storage.records.asset import Level


class MeshShape:
    """One level of an asset in the unit sphere; see scene_templates.placement.Shape."""

    def __init__(self, uid: str, level: Level, centring: Literal["vertex_mean", "box"]) -> None:
        """Scale a level of the object `uid` to the unit sphere.

        Raises:
            Rejected: "no_faces" if it is a single point or not finite.
        """
        self.points = normalize_to_unit_sphere(level.positions, centring)
        if not np.isfinite(self.points).all():
            raise Rejected("no_faces", f"{uid}: the level has no extent, or is not finite")
        self.faces = level.faces
        self._tree: tuple[float, Any] | None = None

    def overlaps(self, pose: Pose, other: "MeshShape", its_pose: Pose) -> bool:
        """Return True if two posed meshes share a point, or one's box contains the other's."""
        offset = pose.centre - its_pose.centre
        if np.sum(np.square(offset)) > (pose.radius + its_pose.radius) ** 2:
            return False
        low, high = self._box(pose)
        its_low, its_high = other._box(its_pose)
        if (low > its_high).any() or (its_low > high).any():
            return False
        inside = (low >= its_low).all() and (high <= its_high).all()
        outside = (low <= its_low).all() and (high >= its_high).all()
        return bool(inside or outside) or self._touches(pose, other, its_pose)

    def _touches(self, pose: Pose, other: "MeshShape", its_pose: Pose) -> bool:
        result = fcl.CollisionResult()
        fcl.collide(self._body(pose), other._body(its_pose), fcl.CollisionRequest(), result)
        return bool(result.is_collision)

    def _body(self, pose: Pose) -> Any:
        """Return FCL's object; its tree is cached, since poses change more often than sizes."""
        if self._tree is None or self._tree[0] != pose.radius:
            tree = fcl.BVHModel()
            tree.beginModel(len(self.points), len(self.faces))
            tree.addSubModel(pose.radius * self.points, self.faces.astype(np.int32))
            tree.endModel()
            self._tree = (pose.radius, tree)
        return fcl.CollisionObject(self._tree[1], fcl.Transform(pose.rotation, pose.centre))

    def _box(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = pose.radius * rotate_points(self.points, pose.rotation) + pose.centre
        return points.min(axis=0), points.max(axis=0)
