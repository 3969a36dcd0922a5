"""Writes a scene or a mesh as GLB, one file for modeling programs, browsers and game engines.

Materials become glTF dielectrics that reading (pipeline.foreign.material) converts back. The
specular albedo F is the mean of Schlick's term, F0 + (F90 - F0)/21. The strength of
KHR_materials_specular is F90. It is set to the strongest channel of F, which then reflects the same
at every angle, as in Trilight; the tint gives the other channels. The base color is
diffuse / (1 - F). Lamps are surfaces that emit (KHR_materials_emissive_strength).
"""

import itertools
import json
import operator
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.png import encode_png
from pipeline.exchange.textured_triangles import (
    Map,
    constant_map,
    group_triangles,
    is_constant,
    linear_map,
    resample_to_largest,
    used_textures,
)
from storage.atomic import write_atomically
from storage.conventions import srgb8
from storage.records.material import EMISSION, column_places
from storage.records.scene import Scene
from storage.records.texture import NORMAL, TEXTURED, Texture

_TO_Y_UP = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)
"""Quaternion of the root node, which rotates +Z up to the +Y up of glTF."""

MOST_SPECULAR = 25.0
"""Specular factor of a mirror: 25 times the F0 = 0.04 of an ordinary dielectric."""
_COMPONENTS = {"f": 5126, "u": 5125}
"""Component types of glTF accessors: float32, and unsigned 32-bit integers."""

_USED = ["KHR_materials_specular", "KHR_materials_emissive_strength"]


def write_gltf(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write a scene, and return sentences about members in it that lose something.

    Args:
        path: ends in `.glb`.
        scene: passes `Scene.check`.

    Raises:
        TrilightError: the file cannot be written.
    """
    write_atomically(path, encode_scene_glb(scene))
    lost = []
    if scene.textures:
        lost.append("more than 8 bits of a texel")
    if any(entry.kind == "shell" for entry in scene.objects):
        lost.append("which objects are floors and walls")
    return tuple(lost)


def encode_scene_glb(scene: Scene) -> bytes:
    """Return a scene as the bytes of a GLB file; its environment and rights are left out."""
    file = GlbFile()
    nodes: list[dict[str, Any]] = [{"rotation": list(_TO_Y_UP), "children": []}]
    meshes = list[dict[str, Any]]()
    for row, parts in itertools.groupby(group_triangles(scene), key=operator.itemgetter(0)):
        name = scene.objects[row].name
        nodes.append({"name": name, "mesh": len(meshes)})
        primitives = [_scene_primitive(file, scene, *part[1:]) for part in parts]
        meshes.append({"name": name, "primitives": primitives})
    cameras = []
    for view, (c2w, fov_deg) in enumerate(zip(scene.c2w, scene.fov_deg, strict=True)):
        matrix = c2w.T.astype(float).reshape(-1).tolist()  # column by column
        nodes.append({"name": f"camera{view}", "camera": view, "matrix": matrix})
        lens = {"yfov": float(np.radians(fov_deg)), "aspectRatio": 1.0, "znear": 0.01}
        cameras.append({"type": "perspective", "perspective": lens})
    nodes[0]["children"] = list(range(1, len(nodes)))
    file.tree |= {
        "nodes": nodes,
        "meshes": meshes,
        "cameras": cameras,
        "materials": [
            {
                **_material(file, _maps(scene, row), scene.materials[row, EMISSION]),
                "name": f"material{row}",
            }
            for row in range(len(scene.materials))
        ],
        "extensionsUsed": _USED,
    }
    return file.encode()


def encode_mesh_glb(
    positions: NDArray[np.floating],
    faces: NDArray[np.integer],
    uv: NDArray[np.floating],
    textures: tuple[Texture, Texture, Texture],
) -> bytes:
    """Return a textured mesh as the bytes of a GLB file.

    Vertices [V, 3] are +Z up, faces [F, 3] rows of them, and coordinates [F, 3, 2] of corners v up.
    The textures are diffuse, specular and roughness.
    """
    file = GlbFile()
    maps = {name: linear_map(texture) for name, texture in zip(TEXTURED, textures, strict=True)}
    corners = positions[faces].reshape(-1, 3)
    primitive = _primitive(file, 0, np.arange(faces.size), corners, None, uv.reshape(-1, 2))
    file.tree |= {
        "nodes": [{"mesh": 0, "rotation": list(_TO_Y_UP)}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(file, maps, np.zeros(3))],
        "extensionsUsed": _USED[:1],
    }
    return file.encode()


def _scene_primitive(
    file: "GlbFile", scene: Scene, material: int, triangles: NDArray[np.intp]
) -> dict[str, Any]:
    corners = scene.faces[triangles].reshape(-1)
    if scene.uv is None:
        vertices, indices = np.unique(corners, return_inverse=True)
        uv = None
    else:
        vertices = corners
        indices = np.arange(len(corners))
        uv = scene.uv.reshape(-1, 3, 2)[triangles].reshape(-1, 2)
    points = scene.vertex_positions[vertices]
    return _primitive(file, material, indices, points, scene.vertex_normals[vertices], uv)


def _primitive(
    file: "GlbFile",
    material: int,
    indices: NDArray[np.integer],
    points: NDArray[np.floating],
    normals: NDArray[np.floating] | None,
    uv: NDArray[np.floating] | None,
) -> dict[str, Any]:
    """Return the JSON of positions and normals [V, 3], and coordinates [V, 2] with v up."""
    points = points.astype("<f4")
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    attributes = {"POSITION": file.accessor(points, bounds)}
    if normals is not None:
        attributes["NORMAL"] = file.accessor(normals.astype("<f4"))
    if uv is not None:
        from_top = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype("<f4")
        attributes["TEXCOORD_0"] = file.accessor(from_top)
    index = file.accessor(indices.astype("<u4"))
    return {"attributes": attributes, "indices": index, "material": material}


def _material(
    file: "GlbFile", maps: Mapping[str, Map], emission: NDArray[np.floating]
) -> dict[str, Any]:
    """Return the JSON of a material of its maps, a normal map among them, and its radiance [3]."""
    diffuse, specular = resample_to_largest(maps["diffuse"], maps["specular"])
    strength = float(specular.max())
    base: Map = np.clip(diffuse / np.maximum(1 - specular, 1e-6), 0, 1).astype(np.float32)
    tint: Map = np.clip((21 * specular / max(strength, 1e-6) - 1) / 20, 0, 1).astype(np.float32)
    surface: dict[str, Any] = {"metallicFactor": 0.0}
    lobe: dict[str, Any] = {"specularFactor": strength}
    if is_constant(base):
        surface["baseColorFactor"] = [*base[0, 0].astype(float).tolist(), 1.0]
    else:
        surface["baseColorTexture"] = {"index": file.picture(srgb8(base))}
    if is_constant(tint):
        lobe["specularColorFactor"] = (MOST_SPECULAR * tint[0, 0].astype(float)).tolist()
    else:
        lobe["specularColorFactor"] = [MOST_SPECULAR] * 3
        lobe["specularColorTexture"] = {"index": file.picture(srgb8(tint))}
    if is_constant(maps["roughness"]):
        surface["roughnessFactor"] = float(maps["roughness"][0, 0, 0])
    else:
        rough = np.round(255 * maps["roughness"]).astype(np.uint8)
        blank = np.zeros_like(rough)
        packed = np.concatenate([blank, rough, blank], axis=2)
        surface["metallicRoughnessTexture"] = {"index": file.picture(packed)}
    made: dict[str, Any] = {"pbrMetallicRoughness": surface, "doubleSided": True}
    if NORMAL in maps:
        codes = np.round(255 * maps[NORMAL]).astype(np.uint8)
        made["normalTexture"] = {"index": file.picture(codes)}
    extensions: dict[str, Any] = {"KHR_materials_specular": lobe}
    brightest = float(emission.max())
    if brightest > 0:
        made["emissiveFactor"] = (emission.astype(float) / brightest).tolist()
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": brightest}
    return {**made, "extensions": extensions}


def _maps(scene: Scene, row: int) -> Mapping[str, Map]:
    """Return the map of each column of a material that may be textured, and its normal map."""
    places = column_places()
    maps = {name: constant_map(scene.materials[row, places[name]]) for name in TEXTURED}
    used = used_textures(scene, row)
    return maps | {name: linear_map(texture) for name, (_, texture) in used.items()}


class GlbFile:
    """A GLB file under construction: one buffer, and a JSON tree that the caller completes."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "trilight"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "accessors": [],
            "bufferViews": [],
        }
        self._data = bytearray()

    def accessor(self, values: NDArray, more: Mapping[str, Any] | None = None) -> int:
        """Add an array of numbers or vectors; return the index of its accessor."""
        entry = {
            "bufferView": self._view(values.tobytes()),
            "componentType": _COMPONENTS[values.dtype.kind],
            "count": len(values),
            "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }
        self.tree["accessors"].append({**entry, **(more or {})})
        return len(self.tree["accessors"]) - 1

    def picture(self, values: NDArray[np.uint8]) -> int:
        """Add a picture [H, W, 3], bottom row first; return the index of its texture."""
        images, textures = (self.tree.setdefault(name, []) for name in ("images", "textures"))
        images.append({"bufferView": self._view(encode_png(values[::-1])), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        return len(textures) - 1

    def encode(self) -> bytes:
        """Return the bytes of the file."""
        self.tree["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.tree, sort_keys=True).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._data) + bytes(-len(self._data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _view(self, data: bytes) -> int:
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._data += data
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1
