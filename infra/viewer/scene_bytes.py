"""Scene as one block of bytes for the browser's 3D view, which reads it in place.

    4 bytes      length of the JSON, little-endian; the JSON is padded to a multiple of 4
    JSON         groups, materials, textures, sky, cameras, lamps, bounds
    float32      positions [3T, 3], normals [3T, 3], and uv [3T, 2] where anything is textured

Triangles are sorted into groups of one object and one material. The 3D view is for orientation
only; the rendered pictures beside it are exact.
"""

import dataclasses
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.png import encode_png
from storage.conventions import srgb8
from storage.errors import TrilightError
from storage.records.lookup import environment_values
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from storage.records.scene_facts import lights
from storage.records.texture import TEXTURED, Texture

MOST_TRIANGLES = 1_500_000
"""Maximum number of triangles; a browser holds 96 bytes of each, three times."""

MOST_GROUPS = 5000
"""Maximum number of pairs of object and material; each needs a draw call."""

_SIDE = 2048
"""Maximum width and height in pixels of textures for the browser; larger ones are reduced."""

_SKY_ROWS = 128


def scene_bytes(scene: Scene) -> bytes:
    """Return the block of bytes of a scene.

    Raises:
        TrilightError: the scene has more triangles or groups than a browser draws.
    """
    if scene.num_triangles > MOST_TRIANGLES:
        raise TrilightError(
            f"{scene.num_triangles} triangles; expected at most {MOST_TRIANGLES} to turn the scene "
            "in 3D. Its pictures are made all the same."
        )
    order, groups = _groups(scene)
    corners = scene.faces[order].reshape(-1)
    arrays = [scene.vertex_positions[corners], scene.vertex_normals[corners]]
    if scene.uv is not None:
        arrays.append(scene.uv.reshape(-1, 3, 2)[order].reshape(-1, 2))
    head = {
        "groups": groups,
        "materials": [_material(scene, row) for row in range(len(scene.materials))],
        "objects": [{"name": entry.name, "kind": entry.kind} for entry in scene.objects],
        "lamps": [
            {"object": light.row, "centre": light.centre, "area": light.area,
             "radiance": light.radiance_rgb}
            for light in lights(scene)
        ],
        "cameras": [
            {"c2w": c2w.reshape(-1).tolist(), "fov": float(fov_deg)}
            for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
        ],
        "corners": len(corners),
        "uv": scene.uv is not None,
        "sky": None if scene.environment is None else {"seen": scene.environment.is_seen},
    }  # fmt: skip
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    blocks = [np.ascontiguousarray(array, "<f4").tobytes() for array in arrays]
    return b"".join((struct.pack("<I", len(text)), text, *blocks))


def texture_png(texture: Texture) -> bytes:
    """Return a texture as PNG: colors sRGB-encoded, numbers linear, the bottom row last."""
    linear = texture.linear(texture.texels)[::-1]
    if texture.channels == 3:
        pixels = srgb8(linear)
    else:
        pixels = np.round(255 * linear).astype(np.uint8).repeat(3, axis=2)
    if max(pixels.shape[:2]) > _SIDE:
        picture = Image.fromarray(pixels)
        picture.thumbnail((_SIDE, _SIDE))
        pixels = np.asarray(picture)
    return encode_png(pixels)


def sky_bytes(scene: Scene) -> bytes:
    """Return the environment map in the layout of three.js, for directions of Trilight's world.

    There u is atan2(z, x) / 2 pi + 1/2 and v is asin(y) / pi + 1/2: small, [rows, 2 rows, 4] in
    float32, v rising, after its width and height as two unsigned integers.
    """
    assert scene.environment is not None
    texels = scene.environment.radiance_rgb
    step = max(1, len(texels) // _SKY_ROWS)  # blocks of texels are averaged
    rows = len(texels) // step
    blocks = texels[: rows * step, : 2 * rows * step].reshape(rows, step, 2 * rows, step, 3)
    sky = dataclasses.replace(scene.environment, radiance_rgb=blocks.mean(axis=(1, 3)))
    height = (np.arange(rows) + 0.5) / rows * np.pi - np.pi / 2
    around = (np.arange(2 * rows) + 0.5) / rows * np.pi - np.pi
    flat = np.cos(height)[:, None]
    up = np.broadcast_to(np.sin(height)[:, None], (rows, 2 * rows))
    directions = np.stack([flat * np.cos(around), up, flat * np.sin(around)], axis=-1)
    rgba = np.ones((rows, 2 * rows, 4), "<f4")
    rgba[..., :3] = environment_values(sky, directions)
    return struct.pack("<II", 2 * rows, rows) + rgba.tobytes()


def _groups(scene: Scene) -> tuple[NDArray[np.int64], list[Mapping[str, int]]]:
    """Return the order of triangles, and the range of each pair of object and material in it."""
    pair = scene.object_index.astype(np.int64) << 16 | scene.material_index
    order = np.argsort(pair, kind="stable")
    values, first, count = np.unique(pair[order], return_index=True, return_counts=True)
    if len(values) > MOST_GROUPS:
        raise TrilightError(
            f"{len(values)} parts of objects and materials; expected at most {MOST_GROUPS} to turn "
            "the scene in 3D. Its pictures are made all the same."
        )
    return order, [
        {"object": v >> 16, "material": v & 0xFFFF, "first": 3 * f, "count": 3 * n}
        for v, f, n in zip(values.tolist(), first.tolist(), count.tolist(), strict=True)
    ]


def _material(scene: Scene, row: int) -> Mapping[str, Any]:
    values = scene.materials[row]
    worn = None if scene.material_textures is None else scene.material_textures[row].tolist()
    maps = {name: at for name, at in zip(TEXTURED, worn or (), strict=False) if at >= 0}
    return {
        "diffuse": values[DIFFUSE].tolist(),
        "specular": values[SPECULAR].tolist(),
        "roughness": float(values[ROUGHNESS]),
        "emission": values[EMISSION].tolist(),
        "maps": maps,
    }
