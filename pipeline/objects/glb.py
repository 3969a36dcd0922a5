"""GLB: a mesh with its textures in one file that every modeling program opens.

The three columns become a glTF dielectric that reads back as the same columns
(pipeline.foreign.material): the specular albedo F goes back to F0 = (21 F - 1)/20, which
KHR_materials_specular can say up to 1, and the base color is diffuse / (1 - F).
"""

import io
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.conventions import srgb8
from storage.records.texture import Texture

MOST_SPECULAR = 25.0
"""Specular factor of a mirror: 25 times the F0 = 0.04 of an ordinary dielectric."""
_JSON = 0x4E4F534A
_BIN = 0x004E4942
FLOAT = 5126
UNSIGNED = 5125
"""Component types of glTF accessors: float32, and unsigned 32-bit integers."""


def encode_glb(
    positions: NDArray[np.floating],
    faces: NDArray[np.integer],
    uv: NDArray[np.floating],
    textures: tuple[Texture, Texture, Texture],
) -> bytes:
    """Return a textured mesh as GLB.

    Args:
        positions: [V, 3], +Z up.
        faces: [F, 3] rows of `positions`.
        uv: [F, 3, 2] texture coordinates of the corners, v up.
        textures: diffuse, specular and roughness.
    """
    file = GlbFile()
    corners = positions[faces].reshape(-1, 3)
    upright = np.stack([corners[:, 0], corners[:, 2], -corners[:, 1]], axis=1)
    flipped = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1).reshape(-1, 2)
    bounds = {"min": upright.min(axis=0).tolist(), "max": upright.max(axis=0).tolist()}
    attributes = {
        "POSITION": file.accessor(upright.astype("<f4"), "VEC3", FLOAT, bounds),
        "TEXCOORD_0": file.accessor(flipped.astype("<f4"), "VEC2", FLOAT),
    }
    indices = file.accessor(np.arange(len(corners), dtype="<u4"), "SCALAR", UNSIGNED)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    file.tree |= {
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(file, *textures)],
        "extensionsUsed": ["KHR_materials_specular"],
    }
    return file.encode()


def _material(
    file: "GlbFile", diffuse: Texture, specular: Texture, roughness: Texture
) -> dict[str, Any]:
    albedos = [texture.linear(texture.texels).astype(np.float64) for texture in (diffuse, specular)]
    base = np.clip(albedos[0] / np.maximum(1 - albedos[1], 1e-6), 0, 1)
    f0 = np.clip((21 * albedos[1] - 1) / 20, 0, 1)
    metal: dict[str, Any] = {"metallicFactor": 0}
    if base.shape[:2] == (1, 1):
        metal["baseColorFactor"] = [*base[0, 0].tolist(), 1]
    else:
        metal["baseColorTexture"] = {"index": file.picture(srgb8(base))}
    if roughness.constant is not None:
        metal["roughnessFactor"] = float(roughness.constant[0])
    else:
        rough = np.round(roughness.linear(roughness.texels) * 255).astype(np.uint8)
        packed = np.concatenate([np.zeros_like(rough), rough, np.zeros_like(rough)], axis=2)
        metal["metallicRoughnessTexture"] = {"index": file.picture(packed)}
    lobe: dict[str, Any] = {"specularColorFactor": [MOST_SPECULAR] * 3}
    if f0.shape[:2] == (1, 1):
        lobe["specularColorFactor"] = (MOST_SPECULAR * f0[0, 0]).tolist()
    else:
        lobe["specularColorTexture"] = {"index": file.picture(srgb8(f0))}
    return {"pbrMetallicRoughness": metal, "extensions": {"KHR_materials_specular": lobe}}


class GlbFile:
    """A GLB file under construction: one buffer, and a JSON tree that the caller completes."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "trilight"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "accessors": [],
            "bufferViews": [],
        }
        self._data = bytearray()

    def accessor(
        self, values: NDArray, kind: str, component: int, more: Mapping[str, Any] | None = None
    ) -> int:
        """Add an array of numbers; return the index of its accessor."""
        entry = {"bufferView": self._view(values.tobytes()), "componentType": component}
        self.tree["accessors"].append({**entry, "count": len(values), "type": kind, **(more or {})})
        return len(self.tree["accessors"]) - 1

    def picture(self, values: NDArray[np.uint8]) -> int:
        """Add a picture [H, W, 3], bottom row first; return the index of its texture."""
        stream = io.BytesIO()
        Image.fromarray(values[::-1]).save(stream, "PNG")
        images, textures = (self.tree.setdefault(name, []) for name in ("images", "textures"))
        images.append({"bufferView": self._view(stream.getvalue()), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        return len(textures) - 1

    def encode(self) -> bytes:
        """Return the bytes of the file."""
        self.tree["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.tree, sort_keys=True).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._data) + bytes(-len(self._data) % 4)
        chunks = struct.pack("<II", len(text), _JSON) + text
        chunks += struct.pack("<II", len(data), _BIN) + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _view(self, data: bytes) -> int:
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._data += data
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1
