"""Reads glTF scenes, `.glb` and `.gltf`; writes a scene or a mesh as GLB, one file.

glTF lights are points without an area, or directions; a `Scene` has surfaces and skies. A point
becomes a small octahedron of equal candela, and a direction a spot in the sky of equal lux, both in
the units of a scene's radiance. Only child processes with limits read (pipeline.isolation), since
the file is untrusted.

Written materials are glTF dielectrics that reading (pipeline.foreign.material) converts back. The
specular albedo F is the mean of Schlick's term, F0 + (F90 - F0)/21. The strength of
KHR_materials_specular is F90. It is set to the strongest channel of F, which then reflects the same
at every angle, as in Trilight; the tint gives the other channels. The base color is
diffuse / (1 - F). Lamps are surfaces that emit (KHR_materials_emissive_strength).
"""

import itertools
import json
import math
import operator
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.png import encode_png
from pipeline.exchange.part_materials import Part, PartConverter, drop_empty, unit_normals
from pipeline.exchange.textured_triangles import (
    LoadedScene,
    Map,
    SceneParts,
    TexturedTriangles,
    build_lamp,
    constant_map,
    group_triangles,
    is_constant,
    linear_map,
    octahedron,
    resample_to_largest,
    rigid_pose,
    sum_area,
    used_textures,
)
from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import PlacedNode, entry, extension, placed_nodes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.numbers import read_number, read_numbers
from pipeline.foreign.picture import MAX_PIXELS, FilePictures
from pipeline.foreign.source_file import read_source
from pipeline.objects.licences import USER_PROVIDED
from storage.atomic import write_atomically
from storage.conventions import latlong_direction, latlong_uv, srgb8
from storage.errors import Rejected, TrilightError
from storage.records.material import EMISSION, column_places
from storage.records.scene import Scene, SceneObject
from storage.records.texture import NORMAL, TEXTURED, Environment, MapSource, Texture

SUFFIXES = (".glb", ".gltf")
_LIMITS = ReadLimits(max_bytes=1 << 30, with_materials=True)

_SUN_ROWS = 256
"""Number of rows of the sky of directional lights: a sun is 0.7 degrees wide."""

_HALF_TEXEL = np.array([0.25, 0.5]) / _SUN_ROWS

_SIZE = 0.01
"""Radius of a light as a fraction of the diagonal of the scene."""


def read_gltf(path: Path) -> LoadedScene:
    """Read the default scene of a file; buffers and pictures are in its folder or in the file.

    Raises:
        TrilightError: the file is unusable or too large, or a `Scene` cannot hold it.
    """
    try:
        with refuse_malformed("load_error", "the glTF tree is"):
            document = read_source(path, _LIMITS).gltf
            assert document is not None
            return _GltfReader(document, path.name).scene()
    except Rejected as error:
        raise TrilightError(f"{path.name}: {error}") from error


class _GltfReader:
    """Reads the scene of one file."""

    def __init__(self, document: GltfDocument, name: str) -> None:
        self.document = document
        self.name = name
        self.lost: list[str] = []
        self._attribution = str(document.tree.get("asset", {}).get("copyright", ""))[:1000]
        self._converter = PartConverter(self.lost)
        pictures = FilePictures(MAX_PIXELS, lost=self.lost)
        self._materials = GltfMaterials(document, pictures, emission=True)

    def scene(self) -> LoadedScene:
        """Build the scene of the file."""
        tree = self.document.tree
        nodes = list(placed_nodes(tree))
        parts = SceneParts(self.name)
        for placed in nodes:
            if not placed.is_visible or "mesh" not in placed.node:
                continue
            mesh = entry(tree, "meshes", placed.node["mesh"])
            name = placed.node.get("name") or mesh.get("name") or "object"
            for primitive in placed_primitives(self.document, placed):
                parts.add(self._entry(name), self._triangles(primitive))
        reach = float(np.linalg.norm(np.ptp(parts.surface_points(), axis=0)))
        suns = []
        lights = extension(tree, "KHR_lights_punctual")
        for placed in nodes:
            reference = extension(placed.node, "KHR_lights_punctual")
            if not placed.is_visible or "light" not in reference:
                continue
            light = entry(lights, "lights", reference["light"])
            if light.get("type") == "directional":
                suns.append((light, placed.to_world))
            elif (lamp := _light_triangles(light, placed, reach, self.lost)) is not None:
                parts.add(self._entry(placed.node.get("name") or "light"), lamp, is_lamp=True)
        cameras = [
            _read_camera(tree, placed, self.lost) for placed in nodes if "camera" in placed.node
        ]
        sky = _build_sun_sky(suns, self.lost)
        if sky is None and not parts.has_emitters:
            self.lost.append("no light: an even sky of radiance 1 lights it")
            radiance_rgb = np.ones((1, 2, 3), np.float32)
            sky = Environment(radiance_rgb=radiance_rgb, source=MapSource(name="even light"))
        scene = parts.build(cameras, sky, {"template": "gltf", "file": self.name}, self.lost)
        notes = dict.fromkeys([*self.document.unread, *self.lost])
        return LoadedScene(scene=scene, notes=tuple(notes))

    def _triangles(self, primitive: PlacedPrimitive) -> TexturedTriangles:
        corners = primitive.positions[primitive.faces]
        if not np.isfinite(corners).all():
            raise Rejected("nonfinite_vertices", "positions are not finite")
        positions, flat, has_area = drop_empty(corners)
        if not has_area.all():
            self.lost.append("triangles without an area")

        def select(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if values is None else values[has_area]

        def coordinates(number: int) -> NDArray[np.float64] | None:
            uv = select(primitive.coordinates(number))
            if uv is not None and not np.isfinite(uv).all():
                raise Rejected("texture_coordinates_not_finite", f"TEXCOORD_{number} is not finite")
            return uv

        number = primitive.material
        row = {} if number is None else entry(self.document.tree, "materials", number)
        material = DEFAULT if number is None else self._materials.material(number)
        self.lost += [f"{word} of materials" for word in material.lost if word != "emission"]
        part = Part(
            where="",
            material=material,
            positions=positions,
            normals=unit_normals(select(primitive.normals), flat),
            coordinates=coordinates,
            colors=select(primitive.colors),
        )
        name = str(row.get("name", ""))[:200]
        source = MapSource(name=name, licence=USER_PROVIDED, attribution=self._attribution)
        return self._converter.convert(part, source)

    def _entry(self, stated: Any) -> SceneObject:
        return SceneObject(
            name=str(stated)[:200].replace("\0", "_"),
            kind="object",
            licence=USER_PROVIDED,
            attribution=self._attribution,
        )


def _read_camera(
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


def _light_triangles(
    light: dict[str, Any], placed: PlacedNode, reach: float, lost: list[str]
) -> TexturedTriangles | None:
    """Return an octahedron for a punctual light; None for other lights and dark ones.

    `light` is its JSON, and `reach` the diagonal of the scene in meters.
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


def _build_sun_sky(
    suns: Sequence[tuple[dict[str, Any], NDArray[np.float64]]], lost: list[str]
) -> Environment | None:
    """Return a black sky with the directional lights; None where none of them shines.

    `suns` has the JSON of each light, and the pose [4, 4] of its node; it shines along -z.
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
