"""The triangles of a file with their materials: the same ones that `load` gives.

Of a glTF, the mesh library is shown a file without any picture: what it would decode itself, it
would decode without limits. Materials come to it as bare names, and coordinates as custom
attributes.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.mesh import FileMesh, TriangleMesh
from storage.errors import Rejected

MOST_UV_SETS = 4
"""Sets of texture coordinates of a mesh that are looked at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedParts:
    """The triangles of a source, unwelded, in its own units, +Z up."""

    mesh: TriangleMesh
    """Its triangles."""
    material: NDArray[np.int64]
    """[F] row of `materials`."""
    materials: Sequence[SourceMaterial]
    """What surfaces are made of."""
    uv: NDArray[np.float64]
    """[F, S, 3, 2] coordinates of each set at each corner, v up; not a number where there are none.
    """
    colour: NDArray[np.float64] | None = None
    """[F, 3, 3] linear colour of each corner, times the base colour; None where it is white."""


def build_parts(
    contents: FileMesh, materials: Sequence[SourceMaterial], default: SourceMaterial
) -> TexturedParts:
    """Return the triangles of a file, given its materials and that of faces without any."""
    count = len(contents.mesh.faces)
    rows = np.full(count, -1) if contents.material is None else contents.material
    uv = np.full((count, 3, 2), np.nan) if contents.uv is None else contents.uv
    return TexturedParts(
        mesh=contents.mesh,
        material=np.where(rows < 0, len(materials), rows),
        materials=(*materials, default),
        uv=uv[:, None],
        colour=contents.color,
    )


def load_parts(
    data: bytes,
    kind: str,
    files: Mapping[str, bytes],
    materials: Mapping[str, SourceMaterial],
    default: SourceMaterial,
) -> TexturedParts:
    """Return the triangles of a file whose materials are named by `materials`.

    Args:
        data: the file, in which nothing names a picture.
        kind: its suffix without the dot.
        files: what it may open, by name.
        materials: by the name that the library gives each.
        default: of faces without any of them.

    Raises:
        Rejected: materials_unreadable where the library cannot read it so.
    """
    rows = {name: row for row, name in enumerate(materials)}
    start, found = 0, []
    for part in _dump(data, kind, files):
        found.append(_part(part, start, rows.get(_material_name(part), len(rows))))
        start += len(part.vertices)
    if not found:
        raise Rejected("materials_unreadable", "the file holds no triangles")
    joined = {name: np.concatenate([each[name] for each in found]) for name in found[0]}
    return TexturedParts(
        mesh=TriangleMesh(positions=joined["positions"], faces=joined["faces"]),
        material=joined["material"],
        materials=(*materials.values(), default),
        uv=joined["uv"],
        colour=None if (joined["colour"] == 1).all() else joined["colour"],
    )


def _dump(data: bytes, kind: str, files: Mapping[str, bytes]) -> list[trimesh.Trimesh]:
    """Return the meshes of a file, each as often as it is placed.

    Raises:
        Rejected: materials_unreadable where the library cannot read it.
    """
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=kind,
            resolver=dict(files),
            process=False,
        )
        return [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except MemoryError:
        raise
    except Exception as error:  # readers of other people's files fail in every way
        raise Rejected(
            "materials_unreadable", f"trimesh: {type(error).__name__}: {error!s:.200}"
        ) from error


def _part(part: trimesh.Trimesh, start: int, material: int) -> dict[str, NDArray]:
    faces = np.asarray(part.faces, np.int64)
    x, y, z = np.asarray(part.vertices, np.float64).T
    positions = np.stack([x, -z, y], axis=1)
    sets = np.full((len(positions), MOST_UV_SETS, 2), np.nan)
    for number, values in _coordinates(part).items():
        if len(values) == len(positions) and values.ndim == 2 and values.shape[1] == 2:
            sets[:, number] = values
    colour = np.ones((len(positions), 3))
    tint: Any = part.vertex_attributes.get("_TRILIGHT_COLOUR")
    if tint is not None and np.ndim(tint) == 2 and len(tint) == len(positions):
        colour[:] = _unit(np.asarray(tint))[:, :3]
    return {
        "positions": positions,
        "faces": faces + start,
        "material": np.full(len(faces), material),
        "uv": sets[faces].transpose(0, 2, 1, 3),
        "colour": colour[faces],
    }


def _material_name(part: trimesh.Trimesh) -> str:
    material = getattr(part.visual, "material", None)
    return str(getattr(material, "name", ""))


def _coordinates(part: trimesh.Trimesh) -> dict[int, NDArray[np.float64]]:
    """Return the sets of coordinates by number, v up."""
    found: dict[int, NDArray[np.float64]] = {}
    for number in range(MOST_UV_SETS):
        values: Any = part.vertex_attributes.get(f"_TRILIGHT_UV_{number}")
        if values is not None and np.ndim(values) == 2:
            unit = _unit(np.asarray(values))
            found[number] = np.stack([unit[:, 0], 1 - unit[:, 1]], axis=1)
    return found


def _unit(values: NDArray) -> NDArray[np.float64]:
    """Return numbers as they are, and normalised integers as shares of their greatest value."""
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float64) / np.iinfo(values.dtype).max
    return values.astype(np.float64)
