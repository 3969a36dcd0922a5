"""Reads a glTF file as a scene: placed meshes, materials with textures, cameras and lights.

glTF lights are points without an area, or directions; a `Scene` has surfaces and skies. A point
becomes a small octahedron of equal candela, and a direction a spot in the sky of equal lux, both in
the units of a scene's radiance.

Only child processes with limits import this (pipeline.isolation), since the file is untrusted.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.part_materials import Part, PartConverter, drop_empty, unit_normals
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import (
    LoadedScene,
    SceneParts,
    TexturedTriangles,
    build_lamp,
    octahedron,
    rigid_pose,
    sum_area,
)
from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import PlacedNode, entry, extension, placed_nodes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.numbers import read_number, read_numbers
from pipeline.foreign.source_file import read_source
from pipeline.objects.licences import USER_PROVIDED
from storage.conventions import latlong_direction, latlong_uv
from storage.errors import Rejected, TrilightError
from storage.records.scene import SceneObject
from storage.records.texture import Environment, MapSource

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
        self._materials = GltfMaterials(
            document,
            lambda data, name: decode_values(data, name, self.lost),
            emission=True,
            notes=self.lost,
        )

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
