"""The materials of a USD stage, by mesh and polygon, with the bytes of their pictures."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material_files import MaterialFiles
from pipeline.foreign.usd.object_stage import UsdStage
from pipeline.foreign.usd.shaders import StatedMaterial, read_bindings, read_material
from pipeline.foreign.usd.stage import OutsideFile
from pipeline.foreign.usd.texture_nodes import TextureNode, asset_bytes
from storage.errors import Rejected, TrilightError

_LOST = {
    "opacity": "transparency",
    "transmission": "transmission",
    "clearcoat": "clearcoat",
    "coat": "clearcoat",
    "subsurface": "subsurface",
    "displacement": "displacement",
    "normal": "normal map",
}
"""Words for unsupported inputs, by the beginnings of their names."""


ReadMaterial = Callable[[Any], StatedMaterial | None]

Binding = tuple[int, NDArray[np.int64] | None]
"""Index of a material, or -1 for none, and the polygons of a mesh that have it; None for all."""


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
    stage: UsdStage,
    max_bytes: int,
    read: ReadMaterial | None = None,
    *,
    normals: bool = False,
) -> StageMaterials:
    """Return the materials of the visible meshes of a stage.

    Args:
        stage: the open stage.
        max_bytes: maximum bytes of all pictures together.
        read: function that reads a UsdShade.Material, None leaving it out; by default one that
            refuses a material without a shader that is understood.
        normals: whether that function reads normal maps, too.

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
            stated = read(material) if read else _read_strictly(stage, material, normals=normals)
            rows[name] = -1 if stated is None else len(materials)
            materials.extend([] if stated is None else [_drop_ior_texture(stage, stated)])
        return rows[name]

    try:
        bindings = tuple(
            tuple(
                (find_row(material), polygons)
                for material, polygons in read_bindings(placed.prim, stage.time)
            )
            for placed in stage.meshes
        )
    except OutsideFile as error:
        raise Rejected("texture_outside", f"{error!s:.200}") from error
    except TrilightError as error:
        raise Rejected("materials_unreadable", f"{error!s:.200}") from error
    nodes = [node for material in materials for node in material.textures.values()]
    return StageMaterials(
        materials=tuple(materials), bindings=bindings, pictures=_read_pictures(nodes, max_bytes)
    )


def _read_strictly(stage: UsdStage, material: Any, *, normals: bool) -> StatedMaterial:
    stated = read_material(material, stage.time, stage.opened, normals=normals)
    if stated is None:
        name = str(material.GetPath())
        raise TrilightError(f"{name!r:.100} has no shader that is understood")
    return stated


def _drop_ior_texture(stage: UsdStage, stated: StatedMaterial) -> StatedMaterial:
    textures = dict(stated.textures)
    if textures.pop("ior", None):
        stage.opened.lost.append(f"{stated.where}.ior: its texture is not read; 1.5 taken")
    return dataclasses.replace(stated, textures=textures)


def name_unsupported(stated: StatedMaterial) -> tuple[str, ...]:
    """Return words for the unsupported inputs that a material states."""
    words = {
        word for name in stated.lost for start, word in _LOST.items() if name.startswith(start)
    }
    return tuple(sorted(words | {"networks of shaders"} if stated.has_networks else words))


def _read_pictures(nodes: Sequence[TextureNode], bytes_left: int) -> MaterialFiles:
    data: dict[str, bytes] = {}
    refused: dict[str, Rejected] = {}
    for node in nodes:
        path = node.resolved or node.named
        if path in data or path in refused:
            continue
        try:
            picture = None if node.resolved is None else asset_bytes(node.resolved, bytes_left)
        except TrilightError as error:
            refused[path] = Rejected("texture_too_large", f"{error!s:.200}")
            continue
        if picture is None:
            why = f"{node.named!r:.80} is not beside the object"
            refused[path] = Rejected("texture_missing", why)
            if "<UDIM>" in node.named:
                why = f"{node.named!r:.80} has UDIM tiles, which are not read"
                refused[path] = Rejected("texture_unreadable", why)
        else:
            data[path] = picture
            bytes_left -= len(picture)
    return MaterialFiles(data=data, refused=refused)
