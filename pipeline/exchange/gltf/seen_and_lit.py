"""Cameras and lights of a glTF scene.

Its lights are points without an area; ours are surfaces. A point becomes a small octahedron of as
many candela, counted in the units of our radiance.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.dressed import PLAIN, DressedTriangles
from pipeline.exchange.usd.foreign_cameras import rigid_pose
from pipeline.foreign.gltf.nodes import PlacedNode
from storage.records.environment import Environment
from storage.records.material import EMISSION, ROUGHNESS, default_rows
from storage.records.texture import MapSource

_SIZE = 0.01
"""Radius of a light as a share of the diagonal of the scene."""


def camera_of(
    tree: dict[str, Any], placed: PlacedNode, lost: list[str]
) -> tuple[NDArray[np.float64], float] | None:
    """Return pose [4, 4] and full angle in degrees of a camera; None where it has neither."""
    camera, pose = tree["cameras"][placed.node["camera"]], rigid_pose(placed.to_world)
    lens = camera.get("perspective", {})
    angle = math.degrees(float(lens.get("yfov", 0)))
    if camera.get("type") != "perspective" or pose is None or not 0 < angle < 180:
        lost.append("a camera without perspective")
        return None
    if not math.isclose(float(lens.get("aspectRatio", 1)), 1, rel_tol=1e-3):
        lost.append("pictures are square here: the vertical angle of a camera was taken")
    return pose, angle


def light_triangles(
    light: dict[str, Any], placed: PlacedNode, reach: float, lost: list[str]
) -> DressedTriangles | None:
    """Return what stands for a punctual light; None where nothing can.

    Args:
        light: its JSON.
        placed: its node.
        reach: diagonal of the scene in metres.
        lost: receives what cannot be carried over.
    """
    kind = light.get("type")
    if kind not in ("point", "spot"):
        lost.append(f"lights of type {kind!r:.20}")
        return None
    lost.append("lights without an area: small octahedra with their candela, in units of radiance")
    if kind == "spot":
        lost.append("cones of spot lights: they shine all around")
    radius = max(_SIZE * reach, 1e-4)
    positions = (placed.to_world[:3, 3] + radius * _octahedron()).astype(np.float32)
    cross = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    shown = float(length.sum()) / 8  # half of the cross products are areas, a quarter is seen
    colour = np.array(light.get("color", (1, 1, 1)), np.float64)
    rows = default_rows(len(positions))
    rows[:, ROUGHNESS] = 1
    rows[:, EMISSION] = np.clip(colour * float(light.get("intensity", 1)) / shown, 0, 1e9)
    if not rows[:, EMISSION].any() or not np.isfinite(rows).all():
        lost.append("lights that shine no light")
        return None
    return DressedTriangles(
        positions=positions,
        normals=np.repeat((cross / length)[:, None], 3, axis=1).astype(np.float32),
        rows=rows,
        uv=np.zeros((len(positions), 3, 2), np.float32),
        worn=np.zeros(len(positions), np.int64),
        wardrobe=(PLAIN,),
    )


def even_sky() -> Environment:
    """Return a sky of radiance 1, which cameras do not see."""
    return Environment(
        radiance_rgb=np.ones((1, 2, 3), np.float32), source=MapSource(name="even light")
    )


def _octahedron() -> NDArray[np.float64]:
    """Return the triangles [8, 3, 3] of an octahedron of radius 1, counter-clockwise."""
    axes = np.eye(3)
    found = []
    for x, y, z in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T:
        corners = axes * np.array([x, y, z])
        found.append(corners if x * y * z > 0 else corners[::-1])
    return np.stack(found)
