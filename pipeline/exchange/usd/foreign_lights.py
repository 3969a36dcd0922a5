"""Converts USD lights: domes to environments, others to emissive triangles.

Radiance is intensity x 2^exposure x color, divided by the area where the light is normalized. The
area is in the units of the stage, as UsdLux defines it, even where these are not meters. Polygons
approximate round lights and have exactly their area. Triangles emit to both sides; rectangles and
disks of USD emit to one, so a note is added.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdGeom, UsdLux

from pipeline.exchange.pictures import MAX_BYTES, decode_pixels
from pipeline.exchange.textured_triangles import octahedron, sum_area
from pipeline.exchange.usd import layout
from pipeline.foreign.numbers import FINITE, read_number, read_numbers
from pipeline.foreign.picture import Picture
from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import asset_bytes, convert_to_rec709
from pipeline.objects.licences import USER_PROVIDED
from storage.errors import TrilightError
from storage.records.texture import Environment, MapSource
from storage.settings.ranges import Within

_DISK_CORNERS = 24

_NEUTRAL: Mapping[str, Any] = {
    "inputs:diffuse": 1.0,
    "inputs:specular": 1.0,
    "inputs:shaping:cone:angle": 90.0,
    "inputs:shaping:focus": 0.0,
    "inputs:shadow:enable": True,
    "inputs:shadow:color": (0.0, 0.0, 0.0),
    "inputs:shadow:distance": -1.0,
    "inputs:shadow:falloff": -1.0,
}
"""Unsupported inputs, each with the value at which it has no effect."""

_OLD_NAMES = ("intensity", "exposure", "color", "normalize", "radius", "width", "height")
"""Names of inputs in stages of old programs."""

_EXPOSURES = Within(-1000, 1000, unit="stops")


def light_triangles(placed: PlacedPrim, time: Any, lost: list[str]) -> NDArray[np.float32] | None:
    """Return the world-space triangles [T, 3, 3] of a light; None where it has no area."""
    prim = placed.prim
    kind = str(prim.GetTypeName())
    shape, sizes = _SHAPES[kind]
    scale = [_read(prim.GetAttribute(f"inputs:{name}"), time) for name in sizes]
    world = np.einsum("ij,tcj->tci", placed.to_world[:3, :3], shape() * np.array([*scale, 1.0][:3]))
    world = world + placed.to_world[:3, 3]
    area = sum_area(world)
    if not area > 0 or not np.isfinite(area):
        lost.append(f"{prim.GetPath()}: a light without an area")
        return None
    if kind in ("RectLight", "DiskLight"):
        lost.append(f"{prim.GetPath()}: emits to one side in USD, and to both sides in a scene")
    return world.astype(np.float32)


def compute_radiance(
    placed: PlacedPrim, triangles: NDArray[np.float32], time: Any, lost: list[str]
) -> NDArray[np.float32]:
    """Return the radiance [3] that the light API of a prim states.

    The prim is a light, or a mesh with the light API; its triangles [T, 3, 3] in meters have the
    area.
    """
    emitted = _read_light_color(placed.prim, time, lost)
    if placed.prim.GetAttribute("inputs:normalize").Get(time):
        area = sum_area(triangles) / placed.meters_per_unit**2
        emitted = emitted / max(area, 1e-30)
    if (emitted < 0).any():
        lost.append(f"{placed.prim.GetPath()}: negative radiance; the light emits nothing")
    emitted = np.maximum(emitted, 0)
    return np.where(np.isfinite(emitted), emitted, 0).astype(np.float32)


def _read_light_color(prim: Any, time: Any, lost: list[str]) -> NDArray[np.float64]:
    """Return intensity x 2^exposure x color [3] of a light, tinted by its temperature."""
    light = UsdLux.LightAPI(prim)
    strength = _read(light.GetIntensityAttr(), time)
    strength *= 2.0 ** _read(light.GetExposureAttr(), time, _EXPOSURES)
    stated = light.GetColorAttr()
    rgb = read_numbers(stated.Get(time), 3, str(stated.GetPath()))
    color = convert_to_rec709(stated, np.array(rgb))
    kelvin = light.GetColorTemperatureAttr()
    # Blender enables temperature on every light but sets none; the USD default would tint by 4 %
    if light.GetEnableColorTemperatureAttr().Get(time) and kelvin.HasAuthoredValue():
        color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(_read(kelvin, time)))
    _note_losses(prim, time, lost)
    return np.asarray(strength * color)


def _read(attribute: Any, time: Any, within: Within = FINITE) -> float:
    return read_number(attribute.Get(time), str(attribute.GetPath()), within)


def _note_losses(prim: Any, time: Any, lost: list[str]) -> None:
    where = prim.GetPath()
    files = {"inputs:texture:file", "inputs:shaping:ies:file"}
    if "Dome" in str(prim.GetTypeName()):
        files.remove(layout.MAP_PATH)
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        value = attribute.Get(time)
        is_lost = value is not None and value != _NEUTRAL.get(name, value)
        if is_lost or (name in files and value and value.path):
            lost.append(f"{where}.{name}: has no place here")
        if name in _OLD_NAMES:
            lost.append(f"{where}.{name}: USD has read inputs:{name} alone since 21.02")
        if attribute.HasAuthoredConnections():
            lost.append(f"{where}.{name}: a network that is not read")
    for relation in prim.GetRelationships():
        is_link = relation.GetName().startswith(("light:filters", "portals", "collection:"))
        if is_link and relation.HasAuthoredTargets():
            lost.append(f"{where}.{relation.GetName()}: has no place here")


def _square() -> NDArray[np.float64]:
    """Return a square of side 1 in XY that faces -Z, the direction of RectLight."""
    a, b, c, d = np.array([[-0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0]])
    return np.array([[a, b, c], [a, c, d]])


def _disk() -> NDArray[np.float64]:
    """Return a polygon with the area of the unit disk, facing -Z."""
    angle = -2 * math.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    return fan * math.sqrt(math.pi / sum_area(fan))


def _build_tube() -> NDArray[np.float64]:
    """Return a tube of length 1 along X, with the area of a cylinder of radius 1 without caps."""
    angle = 2 * math.pi * np.arange(_DISK_CORNERS) / _DISK_CORNERS
    low = np.stack([np.full_like(angle, -0.5), np.cos(angle), np.sin(angle)], axis=1)
    low[:, 1:] *= math.pi / _DISK_CORNERS / math.sin(math.pi / _DISK_CORNERS)
    along = np.array([1.0, 0.0, 0.0])
    high = low + along
    ahead = np.roll(low, -1, axis=0)
    sides = [(low, ahead, high), (high, ahead, ahead + along)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _sphere() -> NDArray[np.float64]:
    """Return 128 triangles with the total area of the unit sphere, facing out."""
    faces = octahedron()
    for _ in range(2):
        middle = (faces + np.roll(faces, -1, axis=1)) / 2
        middle /= np.linalg.norm(middle, axis=2, keepdims=True)
        corner = [np.stack([faces[:, i], middle[:, i], middle[:, i - 1]], axis=1) for i in range(3)]
        faces = np.concatenate([*corner, middle])
    return faces * math.sqrt(4 * math.pi / sum_area(faces))


_SHAPES: Mapping[str, tuple[Callable[[], NDArray[np.float64]], Sequence[str]]] = {
    "RectLight": (_square, ("width", "height")),
    "DiskLight": (_disk, ("radius", "radius")),
    "SphereLight": (_sphere, ("radius", "radius", "radius")),
    "CylinderLight": (_build_tube, ("length", "radius", "radius")),
}
"""Shape of each light, and its sizes along the axes of the light."""


def read_foreign_dome(
    prim: Any, to_world: NDArray[np.float64], time: Any, opened: OpenedStage
) -> Environment | None:
    """Read the environment of any DomeLight; return None, with a note, where it is unusable.

    `to_world` [4, 4] is its transform.

    Raises:
        TrilightError: the map file is outside the folder or on the network.
    """
    prim_path = str(prim.GetPath())
    radiance = _read_map(prim, time, opened)
    if radiance is None:
        return None
    tinted = radiance * _read_light_color(prim, time, opened.lost)
    left_basis, _, right_basis = np.linalg.svd(to_world[:3, :3] @ _pole_rotation(prim))
    rotation = left_basis @ right_basis
    if np.linalg.det(rotation) < 0:
        opened.lost.append(f"{prim_path}: a mirrored dome; its light was left out")
        return None
    visibility = prim.GetAttribute(layout.VISIBLE_TO_CAMERA)
    sky = Environment(
        radiance_rgb=tinted.astype(np.float32),
        rotation=(rotation @ layout.TO_OUR_AXES.T).astype(np.float32),
        is_seen=bool(visibility and visibility.Get(time)),
        source=MapSource(name=prim.GetName(), licence=USER_PROVIDED),
    )
    try:
        sky.check()
    except TrilightError as error:
        opened.lost.append(f"{prim_path}: {error}; its light was left out")
        return None
    return _take_held(sky, prim, time)


def _take_held(sky: Environment, dome: Any, time: Any) -> Environment:
    """Return an environment with the values that Trilight wrote on the prim of the scene."""
    stage = dome.GetStage()
    holder = next((prim for prim in stage.Traverse() if prim.HasAttribute(layout.SKY_SOURCE)), None)
    if holder is None:
        return sky

    def read_value(name: str) -> Any:
        return holder.GetAttribute(name).Get(time)

    held = layout.parse_map_text(read_value(layout.SKY_SOURCE))
    if held is None or held[0] != sky.sha256:
        return sky
    sky = dataclasses.replace(sky, source=held[1])
    if not dome.HasAttribute(layout.VISIBLE_TO_CAMERA):
        sky = dataclasses.replace(sky, is_seen=bool(read_value(layout.SKY_VISIBLE)))
    rows = list(map(read_value, layout.SKY_ROWS))
    if None in rows or not np.allclose(rows, sky.rotation, atol=layout.SAME_VALUE):
        return sky
    return dataclasses.replace(sky, rotation=np.array(rows, np.float32))


def _pole_rotation(prim: Any) -> NDArray[np.float64]:
    """Return the rotation of a dome from its pole +Y to the axis that a DomeLight_1 states."""
    stated = prim.GetAttribute("poleAxis")
    axis = stated.Get() if stated else UsdGeom.Tokens.y
    if axis == "scene":
        axis = UsdGeom.GetStageUpAxis(prim.GetStage())
    is_turned = axis == UsdGeom.Tokens.z
    return np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if is_turned else np.eye(3)


def _read_map(prim: Any, time: Any, opened: OpenedStage) -> NDArray[np.float64] | None:
    """Return the map [H, 2 H, 3] of a dome; uniform radiance 1 where it names no file."""
    prim_path = str(prim.GetPath())
    attribute = prim.GetAttribute(layout.MAP_PATH)
    asset = attribute.Get(time) if attribute else None
    if asset is None or not asset.path:
        return np.ones((1, 2, 3))
    projection = prim.GetAttribute("inputs:texture:format").Get(time)
    if projection not in (None, "automatic", "latlong"):
        opened.lost.append(f"{prim_path}: a picture of format {projection}; expected latlong")
        return None
    specs = attribute.GetPropertyStack(time)
    resolved = opened.resolve(specs[0].layer if specs else opened.root, asset.path)
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        opened.lost.append(f"{prim_path}: map {asset.path!r:.100} is missing")
        return None
    pixels = decode_pixels(data, asset.path, opened.lost)
    if pixels is None:
        opened.lost.append(
            f"{prim_path}: map {asset.path!r:.100} is not read; its light was left out"
        )
        return None
    linear = Picture(values=pixels, is_srgb=pixels.dtype == np.uint8).linear(pixels)
    rgb = linear[..., :3] if linear.shape[2] >= 3 else np.repeat(linear[..., :1], 3, axis=2)
    return rgb.astype(np.float64)
