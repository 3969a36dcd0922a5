"""Reads a glTF file as a scene: placed meshes, materials with textures, cameras and lights.

Only child processes with limits import this (pipeline.isolation), since the file is untrusted.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.gltf.cameras_and_lights import (
    DIRECTIONAL,
    build_sun_sky,
    even_sky,
    light_triangles,
    read_camera,
)
from pipeline.exchange.loaded_scene import LoadedScene
from pipeline.exchange.part_materials import PartConverter
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import SceneParts, TexturedTriangles
from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import PlacedNode, entry, extension, placed_nodes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.part import Part, drop_empty, unit_normals
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected, TrilightError
from storage.records.scene import SceneObject
from storage.records.texture import MapSource

SUFFIXES = (".glb", ".gltf")
_LIMITS = ReadLimits(max_bytes=1 << 30, with_materials=True)


def read_gltf(path: Path, licence: str) -> LoadedScene:
    """Read the default scene of a file.

    Args:
        path: the file; buffers and pictures are in its folder or in the file.
        licence: licence of its objects and textures, which glTF cannot state.

    Raises:
        TrilightError: the file is unusable or too large, or a `Scene` cannot hold it.
    """
    try:
        with refuse_malformed("load_error", "the glTF tree is"):
            document = read_source(path, _LIMITS).gltf
            assert document is not None
            return _GltfReader(document, path.name, licence).scene()
    except Rejected as error:
        raise TrilightError(f"{path.name}: {error}") from error


class _GltfReader:
    """Reads the scene of one file."""

    def __init__(self, document: GltfDocument, name: str, licence: str) -> None:
        self.document = document
        self.name = name
        self.licence = licence
        self.lost: list[str] = []
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
        visible = [placed for placed in nodes if placed.is_visible]
        parts = SceneParts(self.name)
        for placed in visible:
            self._add_mesh(placed, parts)
        reach = float(np.linalg.norm(np.ptp(parts.surface_points(), axis=0)))
        suns = []
        for placed in visible:
            light = self._light(placed)
            if light is None:
                continue
            if light.get("type") == DIRECTIONAL:
                suns.append((light, placed.to_world))
            elif (lamp := light_triangles(light, placed, reach, self.lost)) is not None:
                parts.add(self._entry(placed.node.get("name") or "light"), lamp, is_lamp=True)
        cameras = [
            read_camera(tree, placed, self.lost) for placed in nodes if "camera" in placed.node
        ]
        sky = build_sun_sky(suns, self.lost)
        if sky is None and not parts.has_emitters:
            self.lost.append("no light: an even sky of radiance 1 lights it")
            sky = even_sky()
        usable = [camera for camera in cameras if camera is not None]
        scene = parts.build(usable, sky, {"template": "gltf", "file": self.name}, self.lost)
        notes = dict.fromkeys([*self.document.unread, *self.lost])
        return LoadedScene(scene=scene, notes=tuple(notes))

    def _add_mesh(self, placed: PlacedNode, parts: SceneParts) -> None:
        if "mesh" not in placed.node:
            return
        mesh = entry(self.document.tree, "meshes", placed.node["mesh"])
        name = placed.node.get("name") or mesh.get("name") or "object"
        for primitive in placed_primitives(self.document, placed):
            parts.add(self._entry(name), self._triangles(primitive))

    def _material(self, number: int | None) -> SourceMaterial:
        material = DEFAULT if number is None else self._materials.material(number)
        self.lost += [f"{word} of materials" for word in material.lost if word != "emission"]
        return material

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
        part = Part(
            where="",
            material=self._material(number),
            positions=positions,
            normals=unit_normals(select(primitive.normals), flat),
            coordinates=coordinates,
            colors=select(primitive.colors),
        )
        name = str(row.get("name", ""))[:200]
        source = MapSource(name=name, licence=self.licence, attribution=self._attribution())
        return self._converter.convert(part, source)

    def _light(self, placed: PlacedNode) -> dict[str, Any] | None:
        """Return the JSON of a node's light; None where it has none."""
        reference = extension(placed.node, "KHR_lights_punctual")
        if "light" not in reference:
            return None
        return entry(
            extension(self.document.tree, "KHR_lights_punctual"), "lights", reference["light"]
        )

    def _attribution(self) -> str:
        return str(self.document.tree.get("asset", {}).get("copyright", ""))[:1000]

    def _entry(self, stated: Any) -> SceneObject:
        return SceneObject(
            name=str(stated)[:200].replace("\0", "_"),
            kind="object",
            licence=self.licence,
            attribution=self._attribution(),
        )
