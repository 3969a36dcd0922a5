"""A glTF file made by hand: a quad of two triangles, with what a test wants to be different."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

POSITIONS = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
"""A floor in glTF's axes: +Y up. In ours, the corners are (-1, -1), (1, -1), (1, 1), (-1, 1)."""

UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""v goes down: the first corner is the lower left one of the picture."""

RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)
PICTURE = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
"""The top row first: red is the upper left corner, at (-1, 1)."""


def png(pixels: NDArray[np.uint8]) -> str:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def quad(**changes: Any) -> dict[str, Any]:
    """Return the tree of a textured quad; `uv`, `pictures`, `material` and `node` may be others."""
    uv = changes.pop("uv", UV)
    arrays: list[NDArray[Any]] = [POSITIONS, np.array([0, 1, 2, 0, 2, 3], np.uint16)]
    arrays += [] if uv is None else [uv]
    data = b"".join(array.tobytes() for array in arrays)
    ends = np.cumsum([array.nbytes for array in arrays])
    attributes = {"POSITION": 0} | ({} if uv is None else {"TEXCOORD_0": 2})
    kinds = [(5126, "VEC3"), (5123, "SCALAR"), (5126, "VEC2")]
    pictures = changes.pop("pictures", [png(PICTURE)])
    material = changes.pop("material", {})
    surface = {"metallicFactor": 0, "roughnessFactor": 0.5, "baseColorTexture": {"index": 0}}
    return {
        "asset": {"version": "2.0", "copyright": "A. Maker"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "floor", **changes.pop("node", {})}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, "material": 0}]}],
        "materials": [{"name": "m", "pbrMetallicRoughness": surface, **material}],
        "textures": [{"source": row, "sampler": 0} for row in range(len(pictures))],
        "samplers": [changes.pop("sampler", {})],
        "images": [{"uri": uri} for uri in pictures],
        "buffers": [
            {"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(end - array.nbytes), "byteLength": array.nbytes}
            for array, end in zip(arrays, ends, strict=True)
        ],
        "accessors": [
            {"bufferView": row, "componentType": kinds[row][0], "type": kinds[row][1],
             "count": array.size if kinds[row][1] == "SCALAR" else len(array)}
            for row, array in enumerate(arrays)
        ],
        **changes,
    }  # fmt: skip


def write_gltf(folder: Path, tree: dict[str, Any], name: str = "a.gltf") -> Path:
    (folder / name).write_text(json.dumps(tree))
    return folder / name
