"""A glTF file as a scene: meshes in their places, materials with textures, cameras and lights.

Only children with limits come here (pipeline.isolation): a stranger's file is read.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.exchange.dressed import (
    DressedPiece,
    DressedTriangles,
    by_kind,
    dressed,
    joined_arrays,
    scene_with_worn,
)
from pipeline.exchange.gltf.document import GltfDocument, extension
from pipeline.exchange.gltf.materials import look_of
from pipeline.exchange.gltf.meshes import GltfTriangles
from pipeline.exchange.gltf.placed import PlacedNode, placed_nodes
from pipeline.exchange.gltf.seen_and_lit import camera_of, even_sky, light_triangles
from pipeline.exchange.usd.foreign_cameras import camera_that_sees_all
from storage.errors import TrilightError
from storage.records.material import EMISSION, default_rows
from storage.records.scene import ObjectKind, Scene, SceneObject
from storage.records.texture import MapSource

SUFFIXES = (".glb", ".gltf")
MAX_OBJECTS = 1 << 16
_POINTS_AND_LINES = (0, 1, 2, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class GltfScene:
    """A scene and what could not be carried over."""

    scene: Scene
    """It passes `Scene.check`."""
    lost: tuple[str, ...]
    """For people."""


def read_gltf(path: Path, licence: str) -> GltfScene:
    """Read the default scene of a file.

    Args:
        path: the file; buffers and pictures lie in its folder or in the file.
        licence: of its objects and textures, which glTF has no word for.

    Raises:
        TrilightError: the file is unusable, holds too much, or is none that a `Scene` can hold.
    """
    try:
        return _Reading(document=GltfDocument(path), licence=licence).scene()
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        if isinstance(error, TrilightError):
            raise
        raise TrilightError(f"{path.name}: the glTF tree is malformed ({error!r:.120}).") from error


@dataclass(kw_only=True, eq=False)
class _Reading:
    """One file on its way to a scene."""

    document: GltfDocument
    licence: str
    lost: list[str] = field(default_factory=list)
    names: set[str] = field(default_factory=set)

    def scene(self) -> GltfScene:
        """Return what the file shows."""
        tree = self.document.tree
        nodes = list(placed_nodes(tree))
        pieces = [piece for placed in nodes for piece in self._pieces(placed)]
        if not pieces:
            raise TrilightError(f"{self.document.name}: no triangle with an area is placed.")
        points = np.concatenate([each.piece.mesh.positions for each in pieces])
        reach = float(np.linalg.norm(np.ptp(points, axis=0)))
        pieces += [piece for placed in nodes for piece in self._lights(placed, reach)]
        arrays = joined_arrays(pieces)
        seen = [camera_of(tree, placed, self.lost) for placed in nodes if "camera" in placed.node]
        poses = [each for each in seen if each is not None]
        if poses:
            c2w = np.stack([pose for pose, _ in poses]).astype(np.float32)
            fov_deg = np.array([angle for _, angle in poses], np.float32)
        else:
            self.lost.append("no camera: one was added that sees everything")
            c2w, fov_deg = camera_that_sees_all(points)
        sky = None
        if not any(each.piece.entry.kind == "emitter" for each in pieces):
            self.lost.append("no light: an even sky of radiance 1 lights it")
            sky = even_sky()
        if tree.get("animations"):
            self.lost.append("animations: everything stands as it does without them")
        scene = scene_with_worn(
            arrays,
            pieces,
            c2w=c2w,
            fov_deg=fov_deg,
            provenance={"template": "gltf", "file": self.document.name},
            environment=sky,
        )
        return GltfScene(scene=scene, lost=tuple(dict.fromkeys(self.lost)))

    def _pieces(self, placed: PlacedNode) -> Iterator[DressedPiece]:
        if "mesh" not in placed.node:
            return
        mesh = self.document.tree["meshes"][placed.node["mesh"]]
        name = str(placed.node.get("name") or mesh.get("name") or "object")
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) in _POINTS_AND_LINES:
                self.lost.append("points and lines")
                continue
            for kind, triangles in by_kind(self._triangles(placed, primitive)):
                yield dressed(self._entry(name, kind), triangles)

    def _triangles(self, placed: PlacedNode, primitive: dict[str, Any]) -> DressedTriangles:
        found = GltfTriangles(self.document, primitive, placed.to_world)
        if found.without_area:
            self.lost.append("triangles without an area")
        if "COLOR_0" in primitive["attributes"]:
            self.lost.append("colours of vertices")
        number = primitive.get("material")
        material = {} if number is None else self.document.tree["materials"][number]
        source = MapSource(
            name=str(material.get("name", ""))[:200],
            licence=self.licence,
            attribution=self._attribution(),
        )
        look = look_of(self.document, material, found.coordinates, source, self.lost)
        count = len(found.positions)
        rows = default_rows(count)
        rows[:, EMISSION] = look.emission_rgb
        uv = np.zeros((count, 3, 2), np.float32) if look.uv is None else look.uv
        return DressedTriangles(
            positions=found.positions,
            normals=found.normals,
            rows=rows,
            uv=uv,
            worn=np.zeros(count, np.int64),
            wardrobe=(look.worn,),
        )

    def _lights(self, placed: PlacedNode, reach: float) -> Iterator[DressedPiece]:
        reference = extension(placed.node, "KHR_lights_punctual")
        if "light" not in reference:
            return
        lights = extension(self.document.tree, "KHR_lights_punctual")["lights"]
        found = light_triangles(lights[reference["light"]], placed, reach, self.lost)
        if found is not None:
            yield dressed(self._entry(str(placed.node.get("name") or "light"), "emitter"), found)

    def _attribution(self) -> str:
        return str(self.document.tree.get("asset", {}).get("copyright", ""))[:1000]

    def _entry(self, base: str, kind: ObjectKind) -> SceneObject:
        if len(self.names) >= MAX_OBJECTS:
            raise TrilightError(f"{self.document.name}: more than {MAX_OBJECTS} objects.")
        base, count = base[:200].replace("\0", "_"), 1
        name = base
        while name in self.names:
            count += 1
            name = f"{base}.{count}"
        self.names.add(name)
        return SceneObject(
            name=name, kind=kind, licence=self.licence, attribution=self._attribution()
        )
