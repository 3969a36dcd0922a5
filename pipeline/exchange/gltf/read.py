"""Reads a glTF file as a scene: placed meshes, materials with textures, cameras and lights.

Only child processes with limits import this (pipeline.isolation), since the file is untrusted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
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
from pipeline.exchange.part_materials import convert_part
from pipeline.exchange.pictures import decode_values
from pipeline.exchange.textured_triangles import (
    TexturedPiece,
    TexturedTriangles,
    build_piece,
    build_textured_scene,
    join_arrays,
    split_by_kind,
)
from pipeline.exchange.usd.foreign_cameras import fit_camera
from pipeline.foreign.gltf.document import GltfDocument, refuse_malformed
from pipeline.foreign.gltf.materials import DEFAULT, GltfMaterials
from pipeline.foreign.gltf.nodes import PlacedNode, entry, extension, placed_nodes
from pipeline.foreign.gltf.primitives import PlacedPrimitive, placed_primitives
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.part import Part, drop_empty, unit_normals
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected, TrilightError
from storage.records.scene import ObjectKind, Scene, SceneObject
from storage.records.texture import MapSource

SUFFIXES = (".glb", ".gltf")
MAX_OBJECTS = 1 << 16
_LIMITS = ReadLimits(max_bytes=1 << 30, with_materials=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class GltfScene:
    """A scene that was read, with its losses."""

    scene: Scene
    """The scene, which passes `Scene.check`."""
    lost: tuple[str, ...]
    """Sentences about parts of the file that were lost."""


def read_gltf(path: Path, licence: str) -> GltfScene:
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
            return _GltfReader(document=document, name=path.name, licence=licence).scene()
    except Rejected as error:
        raise TrilightError(f"{path.name}: {error}") from error


@dataclass(kw_only=True, eq=False)
class _GltfReader:
    """State of reading one file: the document, names in use and losses."""

    document: GltfDocument
    name: str
    licence: str
    lost: list[str] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)

    def scene(self) -> GltfScene:
        """Build the scene of the file."""
        tree = self.document.tree
        nodes = list(placed_nodes(tree))
        visible = [placed for placed in nodes if placed.is_visible]
        pieces = [piece for placed in visible for piece in self._pieces(placed)]
        if not pieces:
            raise TrilightError(f"{self.name}: no triangle with an area is placed.")
        points = np.concatenate([each.piece.mesh.positions for each in pieces])
        reach = float(np.linalg.norm(np.ptp(points, axis=0)))
        pieces += [piece for placed in visible for piece in self._lights(placed, reach)]
        arrays = join_arrays(pieces)
        cameras = [
            read_camera(tree, placed, self.lost) for placed in nodes if "camera" in placed.node
        ]
        poses = [each for each in cameras if each is not None]
        if poses:
            c2w = np.stack([pose for pose, _ in poses]).astype(np.float32)
            fov_deg = np.array([angle for _, angle in poses], np.float32)
        else:
            self.lost.append("no camera: one was added that sees everything")
            c2w, fov_deg = fit_camera(points)
        sky = build_sun_sky([each for placed in visible for each in self._suns(placed)], self.lost)
        if sky is None and not any(each.piece.entry.kind == "emitter" for each in pieces):
            self.lost.append("no light: an even sky of radiance 1 lights it")
            sky = even_sky()
        scene = build_textured_scene(
            arrays,
            pieces,
            c2w=c2w,
            fov_deg=fov_deg,
            provenance={"template": "gltf", "file": self.name},
            environment=sky,
        )
        lost = dict.fromkeys([*self.document.unread, *self.lost])
        return GltfScene(scene=scene, lost=tuple(lost))

    def _pieces(self, placed: PlacedNode) -> Iterator[TexturedPiece]:
        if "mesh" not in placed.node:
            return
        mesh = entry(self.document.tree, "meshes", placed.node["mesh"])
        name = str(placed.node.get("name") or mesh.get("name") or "object")
        for primitive in placed_primitives(self.document, placed):
            for kind, triangles in split_by_kind(self._triangles(primitive)):
                yield build_piece(self._entry(name, kind), triangles)

    @cached_property
    def _materials(self) -> GltfMaterials:
        def decode(data: bytes, name: str) -> NDArray:
            return decode_values(data, name, self.lost)

        return GltfMaterials(self.document, decode, emission=True, notes=self.lost)

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

        number = primitive.primitive.material
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
        return convert_part(part, source, self.lost)

    def _light(self, placed: PlacedNode) -> dict[str, Any] | None:
        """Return the JSON of a node's light; None where it has none."""
        reference = extension(placed.node, "KHR_lights_punctual")
        if "light" not in reference:
            return None
        return entry(
            extension(self.document.tree, "KHR_lights_punctual"), "lights", reference["light"]
        )

    def _lights(self, placed: PlacedNode, reach: float) -> Iterator[TexturedPiece]:
        light = self._light(placed)
        if light is not None and light.get("type") != DIRECTIONAL:
            triangles = light_triangles(light, placed, reach, self.lost)
            name = str(placed.node.get("name") or "light")
            if triangles is not None:
                yield build_piece(self._entry(name, "emitter"), triangles)

    def _suns(self, placed: PlacedNode) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
        light = self._light(placed)
        if light is not None and light.get("type") == DIRECTIONAL:
            yield light, placed.to_world

    def _attribution(self) -> str:
        return str(self.document.tree.get("asset", {}).get("copyright", ""))[:1000]

    def _entry(self, base: str, kind: ObjectKind) -> SceneObject:
        if len(self.names) >= MAX_OBJECTS:
            raise TrilightError(f"{self.name}: more than {MAX_OBJECTS} objects.")
        base = base[:200].replace("\0", "_")
        count = self.names.get(base, 0) + 1
        name = base if count == 1 else f"{base}.{count}"
        while count > 1 and name in self.names:
            count += 1
            name = f"{base}.{count}"
        self.names[base] = count
        self.names.setdefault(name, 1)
        return SceneObject(
            name=name, kind=kind, licence=self.licence, attribution=self._attribution()
        )
