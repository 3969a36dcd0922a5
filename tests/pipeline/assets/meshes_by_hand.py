"""Small meshes, and files of every format written by hand: so they can be written wrongly too."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.prepare import prepare_asset
from pipeline.assets.quality.measure import level_mesh
from pipeline.assets.settings import AssetSettings
from pipeline.foreign.mesh import TriangleMesh, join_meshes
from pipeline.objects.builtin.surfaces import superquadric, torus_knot
from storage.errors import Rejected
from storage.records.asset import Asset
from storage.records.objects import ObjectRecord
from tests.pipeline.foreign.gltf.gltf_writer import GltfWriter


def record_of(path: Path, uid: str = "object") -> ObjectRecord:
    rights = {"licence": "CC0-1.0", "licence_source": "tests", "attribution": "", "source_url": ""}
    return ObjectRecord(uid=uid, path=str(path), title="", **rights)


def prepare(
    path: Path, settings: AssetSettings | None = None, method: str = "pymeshlab_collapse"
) -> Asset:
    """What one method makes of a file; raises Rejected where it makes no level at all."""
    wanted = settings or AssetSettings()
    attempt = prepare_asset(path, wanted, method)
    if not attempt.asset.levels:
        raise Rejected(*attempt.missed[wanted.budgets[0]])
    return attempt.asset


def reason_of(
    path: Path, settings: AssetSettings | None = None, method: str = "pymeshlab_collapse"
) -> str:
    with pytest.raises(Rejected) as caught:
        prepare(path, settings, method)
    assert caught.value.message.isprintable()
    return caught.value.reason


def cleaned(mesh: TriangleMesh) -> TriangleMesh:
    return clean(normalize(mesh))


def with_faces(mesh: TriangleMesh, faces: NDArray) -> TriangleMesh:
    return TriangleMesh(positions=mesh.positions, faces=faces)


def with_vertex(mesh: TriangleMesh, place: ArrayLike, row: int = 3) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[row] = place
    return TriangleMesh(positions=positions, faces=mesh.faces)


def check_levels(asset: Asset) -> None:
    """Assert the laws of levels, which hold whatever came in."""
    sizes = [len(level.faces) for level in asset.levels]
    assert sizes == sorted(set(sizes), reverse=True)
    for level in asset.levels:
        assert 1 <= len(level.faces) <= level.record.budget
        assert level.record.quality.error_p99 <= AssetSettings().gate.max_error_p99
        assert np.isfinite(level.positions).all()
        assert np.abs(level.positions).max() <= 0.5 + 0.01 * np.sqrt(3)
        assert level.faces.max() < len(level.positions)
        assert (np.linalg.norm(level_mesh(level).double_area_vectors, axis=1) > 0).all()


def geometry(asset: Asset) -> bytes:
    return b"".join(level.positions.tobytes() + level.faces.tobytes() for level in asset.levels)


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """All of them as one mesh."""
    return join_meshes(meshes)


def moved(mesh: TriangleMesh, scale: ArrayLike = 1.0, offset: ArrayLike = 0.0) -> TriangleMesh:
    positions = mesh.positions * np.asarray(scale, float) + np.asarray(offset, float)
    return TriangleMesh(positions=positions, faces=mesh.faces)


def book(pages: int) -> TriangleMesh:
    """Faces that all share one edge."""
    page = np.arange(2, pages + 2)
    return TriangleMesh(
        positions=np.random.default_rng(0).random((pages + 2, 3)),
        faces=np.column_stack([np.zeros_like(page), np.ones_like(page), page]),
    )


def fan(corners: int) -> TriangleMesh:
    """One face with that many corners, as loaders split it: around the first."""
    turn = 2 * np.pi * np.arange(corners) / corners
    rim = np.column_stack([np.cos(turn), np.sin(turn), 0.1 * np.cos(3 * turn)])
    spokes = np.arange(1, corners - 1)
    faces = np.column_stack([np.zeros_like(spokes), spokes, spokes + 1])
    return TriangleMesh(positions=rim, faces=faces)


def grid(cells: int) -> TriangleMesh:
    """A flat unit square around the origin of 2 cells^2 faces that look up."""
    axis = np.linspace(-0.5, 0.5, cells + 1)
    u, v = (values.ravel() for values in np.meshgrid(axis, axis, indexing="ij"))
    start = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1, 1)
    quads = start + np.array([0, cells + 1, cells + 2, 1])
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return TriangleMesh(positions=np.column_stack([u, v, np.zeros(len(u))]), faces=faces)


def cube(cells: int = 1) -> TriangleMesh:
    """A closed cube of 12 cells^2 faces, every side a grid of squares."""
    flat = grid(cells)
    sides = []
    for k in range(3):
        for end in (-0.5, 0.5):
            place = np.roll(moved(flat, 1, [0, 0, end]).positions, k + 1, axis=1)
            faces = flat.faces if end > 0 else flat.faces[:, ::-1]
            sides.append(TriangleMesh(positions=place, faces=faces))
    return joined(*sides)


def sphere(rings: int = 15, columns: int = 24) -> TriangleMesh:
    """A closed ellipsoid of 2 rings columns faces, without symmetry of its axes."""
    positions, faces = superquadric(
        exponent_profile=1.0,
        exponent_plan=1.0,
        half_sizes=(1.0, 0.8, 0.6),
        rings=rings,
        columns=columns,
    )
    return TriangleMesh(positions=positions, faces=faces)


def knot(segments: int = 160, sides: int = 12) -> TriangleMesh:
    """A trefoil of 2 segments sides faces: no symmetric axes, and it hides parts of itself."""
    positions, faces = torus_knot(
        windings=(2, 3),
        minor_radius=0.45,
        fill=0.6,
        ribs=3,
        rib_depth=0.4,
        rib_turns=1,
        flatten=0.8,
        segments=segments,
        sides=sides,
    )
    return TriangleMesh(positions=positions, faces=faces)


def flip_some(mesh: TriangleMesh, share: float, rng: np.random.Generator) -> TriangleMesh:
    """Turn the winding of a share of the faces around."""
    flipped = rng.random(len(mesh.faces)) < share
    return with_faces(mesh, np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces))


def _lines(mesh: TriangleMesh, vertex: str, face: str, first: int) -> str:
    """Return a line for each vertex and face, of doubles as text that reads back exactly."""
    lines = [f"{vertex}{x!r} {y!r} {z!r}\n" for x, y, z in mesh.positions.tolist()]
    lines += [f"{face}{a} {b} {c}\n" for a, b, c in (mesh.faces + first).tolist()]
    return "".join(lines)


def write_obj(path: Path, mesh: TriangleMesh) -> Path:
    path.write_text(_lines(mesh, "v ", "f ", 1))
    return path


def write_off(path: Path, mesh: TriangleMesh) -> Path:
    header = f"OFF\n{len(mesh.positions)} {len(mesh.faces)} 0\n"
    path.write_text(header + _lines(mesh, "", "3 ", 0))
    return path


def write_stl(path: Path, mesh: TriangleMesh) -> Path:
    rows = np.zeros(
        len(mesh.faces), np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    )
    rows["v"] = mesh.corners
    path.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes())
    return path


def write_ply(path: Path, mesh: TriangleMesh) -> Path:
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(mesh.positions)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_text(header + _lines(mesh, "", "3 ", 0))
    return path


def gltf_tree(mesh: TriangleMesh) -> tuple[dict[str, Any], bytes]:
    """A glTF of one node, and its buffer; tests then break the tree in one place."""
    file = GltfWriter()
    upright = mesh.positions[:, [0, 2, 1]] * [1, 1, -1]  # glTF has +Y up, we have +Z
    attributes = {"POSITION": file.accessor(upright, "f4")}
    indices = file.accessor(mesh.faces.ravel(), "u4")
    file.add("meshes", {"primitives": [{"attributes": attributes, "indices": indices}]})
    file.add("nodes", {"mesh": 0})
    file.add("scenes", {"nodes": [0]})
    file.tree["buffers"] = [{"byteLength": len(file.data)}]
    return file.tree, bytes(file.data)


def write_glb(path: Path, tree: dict[str, Any], buffer: bytes) -> Path:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)
    return path


WRITERS = {".obj": write_obj, ".off": write_off, ".ply": write_ply, ".stl": write_stl}


def as_rows(mesh_positions: NDArray, faces: NDArray) -> set[tuple[tuple[float, ...], ...]]:
    """Faces as sets of corner positions: equal for equal surfaces, whatever the order."""
    return {tuple(sorted(map(tuple, corners))) for corners in mesh_positions[faces].tolist()}


OUTSIDE = [
    "../secret.png",
    "a/../../secret.png",
    "%2e%2e/secret.png",
    "/etc/hostname",
    "file:///etc/hostname",
    "http://127.0.0.1:1/a.png",
    "//host/a.png",
    "link.png",
]
"""Addresses that no file may be read from; `secret_beside` lays out the folder."""


def secret_beside(tmp_path: Path, data: bytes) -> Path:
    """Make a folder for an object, with a link to a file beside it."""
    folder = tmp_path / "objects"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(data)
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    return folder
