"""Writes and reads the environment map of a scene as a USD DomeLight with a map file.

A dome has the middle of its picture towards +Z, a quarter from the left towards +X and the top
towards +Y, whatever the axis of the stage; the axes of an `Environment` are a cyclic permutation of
these. Writing and reading both apply it, so that a scene round-trips bit for bit and other programs
show the same sky. The file is an OpenEXR of float32, because half floats end below the radiance of
suns.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.pictures import MAX_BYTES, decode_pixels, linear_rgb
from pipeline.exchange.usd.authoring import Attributes, add_attributes, add_prim
from pipeline.exchange.usd.foreign_lights import read_light_color
from pipeline.exchange.usd.held_materials import parse_map_text
from pipeline.exchange.usd.prim_names import (
    MAP_TEXTS,
    SKY_ROWS,
    SKY_SOURCE,
    SKY_VISIBLE,
    VISIBLE_TO_CAMERA,
    format_map,
)
from pipeline.foreign.usd.stage import OpenedStage
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.exr import MAX_RESOLUTION, decode_exr, encode_channels
from storage.records.texture import MapSource

TO_OUR_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from the axes of a dome to those of a map: X to Y, Y to Z, Z to X."""

_PATH = "inputs:texture:file"

_SAME_ROTATION = 1e-5
"""Tolerance for a rotation that Trilight wrote: other programs keep angles in float32."""


def add_dome(layer: Any, path: str, sky: Environment) -> None:
    """Write the prim of an environment."""
    add_attributes(add_prim(layer, path, "DomeLight"), dome_attributes(sky))


def map_files(sky: Environment | None) -> dict[str, bytes]:
    """Return the map file of an environment by name.

    Raises:
        TrilightError: the map is larger than the OpenEXR reader accepts.
    """
    if sky is None:
        return {}
    if max(sky.radiance_rgb.shape) > MAX_RESOLUTION:
        raise TrilightError(
            f"environment: {sky.radiance_rgb.shape[1]} texels wide; expected at most "
            f"{MAX_RESOLUTION} in USD. Write it as .safetensors, or make it smaller."
        )
    return {map_file(sky): encode_channels({"RGB": sky.radiance_rgb})}


def map_file(sky: Environment) -> str:
    """Return the file name of a map; equal maps share a file."""
    return f"sky-{sky.sha256[:16]}.exr"


def dome_attributes(sky: Environment) -> Attributes:
    """Return the attributes of the prim of an environment."""
    to_world = np.eye(4)
    to_world[:3, :3] = sky.rotation.astype(np.float64) @ TO_OUR_AXES
    texts = {name: ("string", getattr(sky.source, field)) for field, name in MAP_TEXTS.items()}
    return {
        "xformOp:transform": ("matrix4d", to_world.T.tolist()),  # USD multiplies from the left
        "xformOpOrder": ("uniform token[]", ("xformOp:transform",)),
        _PATH: ("asset", f"./{map_file(sky)}"),
        "inputs:texture:format": ("token", "latlong"),
        "inputs:intensity": ("float", 1.0),
        VISIBLE_TO_CAMERA: ("bool", sky.is_seen),
        **texts,
    }


def sky_attributes(sky: Environment | None) -> Attributes:
    """Return the attributes of a scene's prim about its environment; empty without one."""
    if sky is None:
        return {}
    return {
        **{
            name: ("float3", tuple(map(float, row)))
            for name, row in zip(SKY_ROWS, sky.rotation, strict=True)
        },
        SKY_VISIBLE: ("bool", sky.is_seen),
        SKY_SOURCE: ("string", format_map(sky.sha256, sky.source)),
    }


def read_exact_dome(prim: Any, layer: Any, opened: OpenedStage) -> Environment:
    """Read the environment that `add_dome` wrote; raises LookupError without its file."""
    resolved = opened.resolve(layer, prim.attributes[_PATH].default.path)
    data = None if resolved is None else asset_bytes(resolved, MAX_BYTES)
    if data is None:
        raise LookupError(_PATH)
    matrix = np.array(prim.attributes["xformOp:transform"].default).T
    texts = {field: prim.attributes[name].default for field, name in MAP_TEXTS.items()}
    return Environment(
        radiance_rgb=decode_exr(data),
        rotation=(matrix[:3, :3] @ TO_OUR_AXES.T).astype(np.float32),
        is_seen=bool(prim.attributes[VISIBLE_TO_CAMERA].default),
        source=MapSource(**texts),
    )


def read_foreign_dome(
    prim: Any, to_world: NDArray[np.float64], time: Any, opened: OpenedStage, licence: str
) -> Environment | None:
    """Read the environment of any DomeLight; return None, with a note, where it is unusable.

    Args:
        prim: the light.
        to_world: [4, 4] transform to world space.
        time: time code of the values.
        opened: the open file, which collects notes on losses.
        licence: licence of a map that states none.

    Raises:
        TrilightError: the map file is outside the folder or on the network.
    """
    prim_path = str(prim.GetPath())
    radiance = _read_map(prim, time, opened)
    if radiance is None:
        return None
    tinted = radiance * read_light_color(prim, time, opened.lost)
    left_basis, _, right_basis = np.linalg.svd(to_world[:3, :3] @ _pole_rotation(prim))
    rotation = left_basis @ right_basis
    if np.linalg.det(rotation) < 0:
        opened.lost.append(f"{prim_path}: a mirrored dome; its light was left out")
        return None
    visibility = prim.GetAttribute(VISIBLE_TO_CAMERA)
    sky = Environment(
        radiance_rgb=tinted.astype(np.float32),
        rotation=(rotation @ TO_OUR_AXES.T).astype(np.float32),
        is_seen=bool(visibility and visibility.Get(time)),
        source=MapSource(name=prim.GetName(), licence=licence),
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
    holder = next((prim for prim in stage.Traverse() if prim.HasAttribute(SKY_SOURCE)), None)
    held = None if holder is None else parse_map_text(holder.GetAttribute(SKY_SOURCE).Get(time))
    if holder is None or held is None or held[0] != sky.sha256:
        return sky
    sky = dataclasses.replace(sky, source=held[1])
    if not dome.HasAttribute(VISIBLE_TO_CAMERA):
        sky = dataclasses.replace(sky, is_seen=bool(holder.GetAttribute(SKY_VISIBLE).Get(time)))
    rows = [holder.GetAttribute(name).Get(time) for name in SKY_ROWS]
    if None in rows or not np.allclose(rows, sky.rotation, atol=_SAME_ROTATION):
        return sky
    return dataclasses.replace(sky, rotation=np.array(rows, np.float32))


def _pole_rotation(prim: Any) -> NDArray[np.float64]:
    """Return the rotation of a dome from its pole +Y to the axis that a DomeLight_1 states."""
    from pxr import UsdGeom

    stated = prim.GetAttribute("poleAxis")
    axis = stated.Get() if stated else UsdGeom.Tokens.y
    if axis == "scene":
        axis = UsdGeom.GetStageUpAxis(prim.GetStage())
    is_turned = axis == UsdGeom.Tokens.z
    return np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if is_turned else np.eye(3)


def _read_map(prim: Any, time: Any, opened: OpenedStage) -> NDArray[np.float64] | None:
    """Return the map [H, 2 H, 3] of a dome; uniform radiance 1 where it names no file."""
    prim_path = str(prim.GetPath())
    attribute = prim.GetAttribute(_PATH)
    asset = attribute.Get(time) if attribute else None
    if asset is None or not asset.path:
        return np.ones((1, 2, 3))
    layout = prim.GetAttribute("inputs:texture:format").Get(time)
    if layout not in (None, "automatic", "latlong"):
        opened.lost.append(f"{prim_path}: a picture of format {layout}; expected latlong")
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
    return linear_rgb(pixels).astype(np.float64)
