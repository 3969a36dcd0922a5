"""Converts cameras and lights of a glTF scene.

glTF lights are points without an area, or directions; a `Scene` has surfaces and skies. A point
becomes a small octahedron of equal candela, and a direction a spot in the sky of equal lux, both in
the units of a scene's radiance.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.cameras import rigid_pose
from pipeline.exchange.textured_triangles import TexturedTriangles, build_lamp
from pipeline.exchange.usd.foreign_lights import octahedron, sum_area
from pipeline.foreign.gltf.nodes import PlacedNode
from pipeline.foreign.numbers import read_number, read_numbers
from storage.conventions import latlong_direction, latlong_uv
from storage.records.environment import Environment
from storage.records.texture import MapSource

DIRECTIONAL = "directional"
_SUN_ROWS = 256
"""Number of rows of the sky of directional lights: a sun is 0.7 degrees wide."""

_HALF_TEXEL = np.array([0.25, 0.5]) / _SUN_ROWS

_SIZE = 0.01
"""Radius of a light as a fraction of the diagonal of the scene."""


def read_camera(
    tree: dict[str, Any], placed: PlacedNode, lost: list[str]
) -> tuple[NDArray[np.float64], float] | None:
    """Return pose [4, 4] and full angle in degrees of a camera; None without a perspective."""
    camera = tree["cameras"][placed.node["camera"]]
    pose = rigid_pose(placed.to_world)
    lens = camera.get("perspective", {})
    angle = math.degrees(read_number(lens.get("yfov", 0), "yfov"))
    if camera.get("type") != "perspective" or pose is None or not 0 < angle < 180:
        lost.append("a camera without perspective")
        return None
    if not math.isclose(read_number(lens.get("aspectRatio", 1), "aspectRatio"), 1, rel_tol=1e-3):
        lost.append("pictures are square: the vertical angle of a camera was used")
    return pose, angle


def light_triangles(
    light: dict[str, Any], placed: PlacedNode, reach: float, lost: list[str]
) -> TexturedTriangles | None:
    """Return an octahedron for a punctual light; None for other lights and dark ones.

    Args:
        light: JSON of the light.
        placed: node of the light.
        reach: diagonal of the scene in meters.
        lost: receives a sentence for each loss.
    """
    kind = light.get("type")
    if kind not in ("point", "spot"):
        lost.append(f"lights of type {kind!r:.20}")
        return None
    lost.append("lights without an area: small octahedra with their candela, in units of radiance")
    if kind == "spot":
        lost.append("cones of spot lights: they shine all around")
    if "range" in light:
        lost.append("ranges of lights: they reach everywhere")
    radius = max(_SIZE * reach, 1e-4)
    positions = (placed.to_world[:3, 3] + radius * octahedron()).astype(np.float32)
    visible_area = sum_area(positions) / 4
    radiance = np.clip(_read_light(light) / visible_area, 0, 1e9).astype(np.float32)
    if not radiance.any() or not np.isfinite(positions).all():
        lost.append("lights without emission")
        return None
    return build_lamp(positions, radiance)


def _read_light(light: dict[str, Any]) -> NDArray[np.float64]:
    """Return color x intensity [3] of a light; raises Malformed."""
    color = np.array(read_numbers(light.get("color", (1, 1, 1)), 3, "color of a light"))
    return color * read_number(light.get("intensity", 1), "intensity of a light")


def build_sun_sky(
    suns: Sequence[tuple[dict[str, Any], NDArray[np.float64]]], lost: list[str]
) -> Environment | None:
    """Return a black sky with the directional lights; None where none of them shines.

    Args:
        suns: JSON of each light, and the pose [4, 4] of its node; it shines along -z.
        lost: receives a sentence for each loss.
    """
    radiance = np.zeros((_SUN_ROWS, 2 * _SUN_ROWS, 3), np.float64)
    rotation = np.eye(3)
    for number, (light, to_world) in enumerate(suns):
        towards = to_world[:3, 2]
        if not np.linalg.norm(towards) > 0:
            continue
        if number == 0:  # the first sun is in the middle of a texel at the map's equator
            rotation = _frame(towards) @ _frame(latlong_direction(0.5 + _HALF_TEXEL)).T
        u, v = latlong_uv(towards @ rotation)
        row = min(int((1 - v) * _SUN_ROWS), _SUN_ROWS - 1)
        angle = np.square(np.pi / _SUN_ROWS) * np.sin(np.pi * (row + 0.5) / _SUN_ROWS)
        radiance[row, int(u * 2 * _SUN_ROWS) % (2 * _SUN_ROWS)] += _read_light(light) / angle
    if not np.isfinite(radiance).all() or not (radiance > 0).any():
        lost.extend(["lights without emission"] if suns else [])
        return None
    lost.append("directional lights: suns of 0.7 degrees with their lux, in units of radiance")
    return Environment(
        radiance_rgb=np.clip(radiance, 0, 1e9).astype(np.float32),
        rotation=rotation.astype(np.float32),
        source=MapSource(name="directional lights"),
    )


def _frame(first: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation [3, 3] whose first column is a direction."""
    unit = first / np.linalg.norm(first)
    second = np.cross(unit, np.eye(3)[np.abs(unit).argmin()])
    second /= np.linalg.norm(second)
    return np.stack([unit, second, np.cross(unit, second)], axis=1)


def even_sky() -> Environment:
    """Return a uniform sky of radiance 1, invisible to cameras."""
    return Environment(
        radiance_rgb=np.ones((1, 2, 3), np.float32), source=MapSource(name="even light")
    )
