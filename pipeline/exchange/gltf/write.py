"""Writes a scene as GLB, a single file for modeling programs, browsers and game engines.

Materials become glTF dielectrics that reading (pipeline.exchange.gltf.materials) converts back. The
specular albedo F is the mean of Schlick's term, F0 + (F90 - F0)/21. The strength of
KHR_materials_specular is F90. It is set to the strongest channel of F, which then reflects the same
at every angle, as in Trilight; the tint gives the other channels. The base color is
diffuse / (1 - F). Lamps are surfaces that emit (KHR_materials_emissive_strength).
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.linear_maps import (
    Map,
    constant_map,
    is_constant,
    linear_map,
    resample_to_largest,
)
from pipeline.objects.glb import FLOAT, MOST_SPECULAR, UNSIGNED, GlbFile
from storage.atomic import write_atomically
from storage.conventions import srgb8
from storage.records.material import DIFFUSE, EMISSION, PUBLISHED_COLUMNS, ROUGHNESS, SPECULAR
from storage.records.scene import ARRAY_FIELDS, Scene
from storage.records.texture import TEXTURED

CARRIED = frozenset(
    {*ARRAY_FIELDS, "objects.name", "objects.kind", "textures"} - {"materials"}
    | {f"materials.{name}" for name in PUBLISHED_COLUMNS}
)
"""Members of a scene that the file holds (pipeline.exchange.formats)."""

_TO_Y_UP = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)
"""Quaternion of the root node, which rotates +Z up to the +Y up of glTF."""

_USED = ["KHR_materials_specular", "KHR_materials_emissive_strength"]


def write_gltf(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write a scene, and return sentences about members in CARRIED that lose something.

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
    parts = list(_group_triangles(scene))
    nodes: list[dict[str, Any]] = [{"rotation": list(_TO_Y_UP), "children": []}]
    meshes = list[dict[str, Any]]()
    for row, entry in enumerate(scene.objects):
        primitives = [_primitive(file, scene, *part[1:]) for part in parts if part[0] == row]
        if primitives:
            nodes.append({"name": entry.name, "mesh": len(meshes)})
            meshes.append({"name": entry.name, "primitives": primitives})
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
        "materials": [_material(file, scene, row) for row in range(len(scene.materials))],
        "extensionsUsed": _USED,
    }
    return file.encode()


def _group_triangles(scene: Scene) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Yield object, material and triangles of each pair of the two."""
    pair = scene.object_index.astype(np.int64) << 16 | scene.material_index
    order = np.argsort(pair, kind="stable")
    values, first = np.unique(pair[order], return_index=True)
    for value, triangles in zip(values, np.split(order, first[1:]), strict=True):
        yield int(value) >> 16, int(value) & 0xFFFF, triangles


def _primitive(
    file: GlbFile, scene: Scene, material: int, triangles: NDArray[np.int64]
) -> dict[str, Any]:
    corners = scene.faces[triangles].reshape(-1)
    if scene.uv is None:
        vertices, indices = np.unique(corners, return_inverse=True)
    else:
        vertices = corners
        indices = np.arange(len(corners))
    points = scene.vertex_positions[vertices].astype("<f4")
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    normals = scene.vertex_normals[vertices].astype("<f4")
    attributes = {
        "POSITION": file.accessor(points, "VEC3", FLOAT, bounds),
        "NORMAL": file.accessor(normals, "VEC3", FLOAT),
    }
    if scene.uv is not None:
        uv = scene.uv.reshape(-1, 3, 2)[triangles].reshape(-1, 2)
        from_top = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype("<f4")
        attributes["TEXCOORD_0"] = file.accessor(from_top, "VEC2", FLOAT)
    return {
        "attributes": attributes,
        "indices": file.accessor(indices.astype("<u4"), "SCALAR", UNSIGNED),
        "material": material,
    }


def _material(file: GlbFile, scene: Scene, row: int) -> dict[str, Any]:
    values = scene.materials[row]
    maps = _maps(scene, row)
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
    made = {"pbrMetallicRoughness": surface, "doubleSided": True, "name": f"material{row}"}
    extensions: dict[str, Any] = {"KHR_materials_specular": lobe}
    brightest = float(values[EMISSION].max())
    if brightest > 0:
        made["emissiveFactor"] = (values[EMISSION].astype(float) / brightest).tolist()
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": brightest}
    return {**made, "extensions": extensions}


def _maps(scene: Scene, row: int) -> Mapping[str, Map]:
    """Return the map of each column of a material that may be textured."""
    column_slices = {"diffuse": DIFFUSE, "specular": SPECULAR, "roughness": ROUGHNESS}
    maps = {name: constant_map(scene.materials[row, part]) for name, part in column_slices.items()}
    if scene.material_textures is not None:
        for name, texture in zip(TEXTURED, scene.material_textures[row], strict=True):
            if texture >= 0:
                maps[name] = linear_map(scene.textures[texture])
    return maps
