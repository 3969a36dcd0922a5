"""`UsdSource`: the triangles and materials of a USD object; only child processes make one.

USD itself resolves the names of other files, so it receives a path; every file that it may open is
checked first (pipeline.foreign.usd.stage). Contents that would give a plausible but wrong mesh are
refused: a missing reference, surfaces other than polygons, bones without a pose.
`read_stage_materials` returns the materials of a stage by mesh and polygon, of scenes too.
"""

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.material_files import MaterialFiles
from pipeline.foreign.mesh import TriangleMesh, join_meshes
from pipeline.foreign.usd.placed import SOLIDS, PlacedPrim, UnposedMesh, placed_prims
from pipeline.foreign.usd.polygons import CutMesh, cut_mesh
from pipeline.foreign.usd.shaders import StatedMaterial, read_bindings, read_material
from pipeline.foreign.usd.stage import OpenedStage, OutsideFile, read_quietly
from pipeline.foreign.usd.texture_nodes import TextureNode, asset_bytes
from storage.errors import Rejected, TrilightError

ReadMaterial = Callable[[Any], StatedMaterial | None]

Binding = tuple[int, NDArray[np.int64] | None]
"""Index of a material, or -1 for none, and the polygons of a mesh that have it; None for all."""

_MAX_OFFSET = 1e5
"""Maximum distance of points from their mesh's origin, in sizes of the object: points are float32,
and off by 1 % of the size beyond it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StageMaterials:
    """The materials of a stage."""

    materials: tuple[StatedMaterial, ...]
    """Distinct materials in the order of their first use."""
    bindings: tuple[tuple[Binding, ...], ...]
    """Bindings of each mesh; later ones override earlier ones."""
    pictures: MaterialFiles
    """Contents of pictures by resolved path."""


def read_stage_materials(
    meshes: Sequence[PlacedPrim], max_bytes: int, read: ReadMaterial
) -> StageMaterials:
    """Return the materials of the visible meshes of a stage.

    Args:
        meshes: the meshes, which receive notes on what is not read.
        max_bytes: maximum bytes of all pictures together.
        read: function that reads a UsdShade.Material; None leaves it out.

    Raises:
        Rejected: texture_outside, materials_unreadable.
    """
    rows: dict[str, int] = {}
    materials: list[StatedMaterial] = []

    def find_row(material: Any) -> int:
        if not material:
            return -1
        name = str(material.GetPath())
        if name not in rows:
            stated = read(material)
            rows[name] = -1 if stated is None else len(materials)
            materials.extend([] if stated is None else [stated])
        return rows[name]

    try:
        bindings = tuple(
            tuple((find_row(material), polygons) for material, polygons in read_bindings(placed))
            for placed in meshes
        )
    except OutsideFile as error:
        raise Rejected("texture_outside", f"{error!s:.200}") from error
    except TrilightError as error:
        raise Rejected("materials_unreadable", f"{error!s:.200}") from error
    nodes = [node for material in materials for node in material.textures.values()]
    return StageMaterials(
        materials=tuple(materials), bindings=bindings, pictures=_read_pictures(nodes, max_bytes)
    )


def _read_pictures(nodes: Sequence[TextureNode], bytes_left: int) -> MaterialFiles:
    data: dict[str, bytes] = {}
    refused: dict[str, Rejected] = {}
    distinct: dict[str, TextureNode] = {}
    for node in nodes:
        distinct.setdefault(node.resolved or node.named, node)
    for path, node in distinct.items():
        try:
            picture = None if node.resolved is None else asset_bytes(node.resolved, bytes_left)
        except TrilightError as error:
            refused[path] = Rejected("texture_too_large", f"{error!s:.200}")
            continue
        if picture is not None:
            data[path] = picture
            bytes_left -= len(picture)
        elif "<UDIM>" in node.named:
            why = f"{node.named!r:.80} has UDIM tiles, which are not read"
            refused[path] = Rejected("texture_unreadable", why)
        else:
            why = f"{node.named!r:.80} is not beside the object"
            refused[path] = Rejected("texture_missing", why)
    return MaterialFiles(data=data, refused=refused)


def _cut_meshes(placed: Sequence[PlacedPrim], max_faces: int) -> Mapping[int, CutMesh]:
    meshes: dict[int, CutMesh] = {}
    faces_left = max_faces
    farthest = 0.0
    for number, each in enumerate(placed):
        cut = cut_mesh(each, faces_left)
        faces_left -= cut.num_faces
        if len(cut.corners):
            scale = np.linalg.norm(each.to_world[:3, :3], 2)
            farthest = max(farthest, float(scale * np.abs(cut.points).max()))
            meshes[number] = cut
    if not meshes:
        raise Rejected("no_faces", "the stage shows no mesh with triangles")
    used = [cut.world_points[cut.indices[cut.corners.ravel()]] for cut in meshes.values()]
    extent = float(np.ptp(np.concatenate(used), axis=0).max())
    if farthest > _MAX_OFFSET * extent > 0:
        raise Rejected(
            "offset_precision",
            f"points lie {farthest / extent:.3g} times the size of the object from their origin",
        )
    return meshes


class UsdSource:
    """The contents of a USD file; materials are read where limits include them."""

    def __init__(self, path: Path, limits: ReadLimits) -> None:
        """Open the file and those that it names.

        Raises:
            Rejected: external_uri, load_error, missing_file, too_many_instances,
                unsupported_primitive, skinned_mesh, or too_large_bytes for all layers together.
        """
        self._path = path
        self._limits = limits
        with _reject_errors(path):
            self.opened = OpenedStage(path, max_file_bytes=limits.max_bytes)
            """Opened layers, with notes on unread contents."""
            self._placed = _place_meshes(self.opened, limits)
        digest = hashlib.sha256()
        bytes_left = limits.max_bytes
        for layer in self.opened.files:
            data = layer.read_bytes()
            if len(data) > bytes_left:
                why = f"the layers together; {bytes_left} bytes are left"
                raise Rejected("too_large_bytes", why)
            digest.update(data)
            bytes_left -= len(data)
        self._materials = self._read_materials(bytes_left)
        if isinstance(self._materials, StageMaterials):
            pictures = self._materials.pictures.data
            for place in sorted(pictures):
                digest.update(pictures[place])
        self.sha256 = digest.hexdigest()
        """Digest of all layers, the root first, and of the pictures of materials."""

    @cached_property
    def meshes(self) -> Mapping[int, CutMesh]:
        """Return the meshes that have triangles, by their index within the stage.

        Raises:
            Rejected: no_faces, too_many_faces, offset_precision, or load_error where arrays of a
                mesh contradict each other, or are not finite.
        """
        with _reject_errors(self._path):
            return _cut_meshes(self._placed, self._limits.max_faces)

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Return all meshes as one, unwelded, in meters, +Z up; raises Rejected as `meshes`."""
        return join_meshes(
            [
                TriangleMesh(positions=cut.world_points, faces=cut.indices[cut.corners])
                for cut in self.meshes.values()
            ]
        )

    @property
    def materials(self) -> StageMaterials:
        """Return the materials; raises Rejected as `read_stage_materials`, or no_materials."""
        if isinstance(self._materials, Rejected):
            raise self._materials
        return self._materials

    def _read_materials(self, bytes_left: int) -> StageMaterials | Rejected:
        """Return the materials, or why there are none: to read those of a large stage costs a lot.

        The reason is new, since the traceback of a raised one would hold the stage.
        """
        if not self._limits.with_materials:
            return Rejected("no_materials", "materials were not asked for")

        def read(material: Any) -> StatedMaterial:
            normals = self._limits.with_normal_maps
            stated = read_material(material, self.opened, normals=normals)
            if stated is None:
                name = str(material.GetPath())
                raise TrilightError(f"{name!r:.100} has no shader that is understood")
            return stated

        try:
            with _reject_errors(self._path):
                return read_stage_materials(self._placed, bytes_left, read)
        except Rejected as why:
            return Rejected(why.reason, why.message)


@contextlib.contextmanager
def _reject_errors(path: Path) -> Iterator[None]:
    """Turn the errors of reading a USD file into Rejected.

    Raises:
        Rejected: external_uri, skinned_mesh, load_error, or as the block.
    """
    try:
        with read_quietly(path):
            yield
    except TrilightError as error:
        reasons = {OutsideFile: "external_uri", UnposedMesh: "skinned_mesh"}
        raise Rejected(reasons.get(type(error), "load_error"), f"{error!s:.300}") from error


def _place_meshes(opened: OpenedStage, limits: ReadLimits) -> list[PlacedPrim]:
    """Return the visible meshes of a stage with transforms to meters, +Z up."""
    stage = opened.compose()
    if opened.unresolved:
        raise Rejected("missing_file", f"{opened.unresolved[0]}; an object needs all of its parts")
    placed = placed_prims(stage, opened.time, opened.lost, ("Mesh", *SOLIDS, "NurbsPatch"))
    if len(placed) > limits.max_instances:
        raise Rejected("too_many_instances", f"{len(placed)} meshes; <= {limits.max_instances}")
    for each in placed:
        kind = each.prim.GetTypeName()
        where = str(each.prim.GetPath())
        if kind == "NurbsPatch":
            raise Rejected("unsupported_primitive", f"{where!r:.100} is a {kind}; make it a mesh")
        scheme = each.prim.GetAttribute("subdivisionScheme")
        if scheme and scheme.Get() != "none":
            each.note("subdivision; its cage was read")
    return placed
