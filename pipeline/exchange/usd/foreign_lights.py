"""Lights of USD as emissive triangles: rectangles, disks, spheres, and meshes that are lights.

Radiance is intensity x 2^exposure x colour, divided by the area in world units where the light is
normalised. Polygons stand for round lights and have exactly their area. Ours emit to both sides;
rectangles and disks of USD do so to one, which is said.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.usd.placed import Placed

_DISK_CORNERS = 24


def light_triangles(placed: Placed, time: Any, lost: list[str]) -> NDArray[np.float32] | None:
    """Return the triangles [T, 3, 3] of a light in our world; None where it has no area."""
    from pxr import UsdLux

    prim = placed.prim
    kind = str(prim.GetTypeName())
    if kind == "RectLight":
        light = UsdLux.RectLight(prim)
        size = np.array([light.GetWidthAttr().Get(time), light.GetHeightAttr().Get(time), 1.0])
        local = _square() * size
    elif kind == "DiskLight":
        local = _disk() * float(UsdLux.DiskLight(prim).GetRadiusAttr().Get(time))
    else:
        local = _sphere() * float(UsdLux.SphereLight(prim).GetRadiusAttr().Get(time))
    world = np.einsum("ij,tcj->tci", placed.to_world[:3, :3], local) + placed.to_world[:3, 3]
    area = _area(world)
    if not area > 0 or not np.isfinite(area):
        lost.append(f"{prim.GetPath()}: a light without an area")
        return None
    if kind != "SphereLight":
        lost.append(f"{prim.GetPath()}: emits to one side there, and to both sides here")
    _note_losses(prim, time, lost)
    return world.astype(np.float32)


def radiance(prim: Any, triangles: NDArray[np.float32], time: Any) -> NDArray[np.float32]:
    """Return the radiance [3] that the light API of a prim states.

    Args:
        prim: a light, or a mesh that is one.
        triangles: [T, 3, 3] in world units, for the area.
        time: of the values.
    """
    from pxr import UsdLux

    light = UsdLux.LightAPI(prim)
    strength = light.GetIntensityAttr().Get(time) * 2.0 ** light.GetExposureAttr().Get(time)
    colour = np.array(light.GetColorAttr().Get(time), np.float64)
    kelvin = light.GetColorTemperatureAttr()
    # Blender switches it on for every light and states none; the default of USD would tint by 4 %
    if light.GetEnableColorTemperatureAttr().Get(time) and kelvin.HasAuthoredValue():
        colour = colour * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin.Get(time)))
    if light.GetNormalizeAttr().Get(time):
        strength = strength / max(_area(triangles.astype(np.float64)), 1e-30)
    found = np.maximum(strength * colour, 0)
    return np.where(np.isfinite(found), found, 0).astype(np.float32)


def _note_losses(prim: Any, time: Any, lost: list[str]) -> None:
    for name, neutral in (("inputs:shaping:cone:angle", 90.0), ("inputs:shaping:focus", 0.0)):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue() and attribute.Get(time) != neutral:
            lost.append(f"{prim.GetPath()}.{name}: the light shines in every direction here")
    for name in ("inputs:texture:file", "inputs:shaping:ies:file"):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.Get(time) and attribute.Get(time).path:
            lost.append(f"{prim.GetPath()}.{name}: has no place here")


def _area(triangles: NDArray[np.float64]) -> float:
    edges = np.diff(triangles, axis=1)
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def _square() -> NDArray[np.float64]:
    """Return a square of side 1 in XY that faces -Z, as its light does."""
    a, b, c, d = np.array([[-0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0]])
    return np.array([[a, b, c], [a, c, d]])


def _disk() -> NDArray[np.float64]:
    """Return a polygon of the area of the unit disk, facing -Z."""
    turn = -2 * math.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    return fan * math.sqrt(math.pi / _area(fan))


def _sphere() -> NDArray[np.float64]:
    """Return 128 triangles of the area of the unit sphere, facing out."""
    octahedron = np.array(
        [[[x, 0, 0], [0, y, 0], [0, 0, z]] for x in (1, -1) for y in (1, -1) for z in (1, -1)],
        float,
    )
    turned = np.prod(octahedron.sum(axis=1), axis=1) < 0
    octahedron[turned] = octahedron[turned][:, ::-1]
    faces = octahedron
    for _ in range(2):
        middle = (faces + np.roll(faces, -1, axis=1)) / 2
        middle /= np.linalg.norm(middle, axis=2, keepdims=True)
        corner = [np.stack([faces[:, i], middle[:, i], middle[:, i - 1]], axis=1) for i in range(3)]
        faces = np.concatenate([*corner, middle])
    return faces * math.sqrt(4 * math.pi / _area(faces))
