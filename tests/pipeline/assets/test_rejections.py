"""Every reason code has a file that earns it; none of them costs more than a moment."""

import gzip
import io
import itertools
import os
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as by_hand

BALL = by_hand.sphere(rings=5, columns=8)


def with_vertex(value: list[float], row: int = 3, mesh: TriangleMesh = BALL) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[row] = value
    return TriangleMesh(positions=positions, faces=mesh.faces)


def moved(scale: float, offset: float) -> TriangleMesh:
    return TriangleMesh(positions=BALL.positions * scale + offset, faces=BALL.faces)


OFF_FILES: dict[str, tuple[str, TriangleMesh]] = {
    "nan": ("nonfinite_vertices", with_vertex([0, np.nan, 0])),
    "infinity": ("nonfinite_vertices", with_vertex([np.inf, 0, 0])),
    "tiny": ("extent_range", moved(1e-10, 0)),
    "huge": ("extent_range", moved(1e10, 0)),
    "overflowing": ("extent_range", moved(1e308, 0)),
    "point": ("extent_range", moved(0.0, 1.0)),
    "line": ("degenerate", TriangleMesh(positions=BALL.positions * [1, 0, 0], faces=BALL.faces)),
    "needle": (
        "degenerate",
        TriangleMesh(positions=BALL.positions * [1, 1e-6, 1e-6], faces=BALL.faces),
    ),
    "outlier": (
        "far_outlier",
        TriangleMesh(
            positions=np.concatenate([by_hand.knot().positions, [[1e4, 0, 0], [1e4, 1e-3, 0]]]),
            faces=np.concatenate([by_hand.knot().faces, [[0, 1920, 1921]]]),
        ),
    ),
}


@for_each("name", OFF_FILES)
def test_bad_numbers(tmp_path: Path, name: str) -> None:
    reason, mesh = OFF_FILES[name]
    assert by_hand.reason_of(by_hand.write_off(tmp_path / "a.off", mesh)) == reason


def test_an_offset_is_judged_by_the_precision_of_the_format(tmp_path: Path) -> None:
    far = moved(1.0, 1e6)
    assert by_hand.reason_of(by_hand.write_stl(tmp_path / "a.stl", far)) == "offset_precision"
    near = by_hand.prepare(by_hand.write_obj(tmp_path / "a.obj", BALL))
    exact = by_hand.prepare(by_hand.write_obj(tmp_path / "b.obj", far))
    # Text keeps 17 digits: at 1e6 the ball is still known to 1e-10, far below the grid of 1e-6.
    assert exact.geometry_sha256 == near.geometry_sha256


def test_unused_vertices_do_not_count(tmp_path: Path) -> None:
    """A vertex without a face may be anything: exporters leave them behind."""
    positions = np.concatenate([[[1e30, np.nan, 0]], BALL.positions])
    mesh = TriangleMesh(positions=positions, faces=BALL.faces + 1)
    dirty = by_hand.prepare(by_hand.write_off(tmp_path / "a.off", mesh))
    tidy = by_hand.prepare(by_hand.write_off(tmp_path / "b.off", BALL))
    assert dirty.geometry_sha256 == tidy.geometry_sha256


def _tar(data: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        entry = tarfile.TarInfo("a.obj")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


def _zip(data: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.obj", data)
    return stream.getvalue()


@for_each(
    ("suffix", "pack"),
    itertools.product([".obj", ".glb", ".stl", ".ply"], [_zip, _tar, gzip.compress]),
)
def test_archives_are_not_opened(
    tmp_path: Path, suffix: str, pack: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(pack(b"v 0 0 0\n" * 100_000))
    assert by_hand.reason_of(path) == "archive_refused"


def _ply(header: str, body: bytes = b"") -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{header}\nend_header\n".encode() + body


_XYZ = "property float x\nproperty float y\nproperty float z"
_LIST = "property list uchar int vertex_indices"

RAW_FILES: dict[str, tuple[str, str, bytes]] = (
    {
        "empty obj": ("no_faces", ".obj", b""),
        "empty stl": ("header_size_mismatch", ".stl", b""),
        "empty ply": ("load_error", ".ply", b""),
        "empty off": ("load_error", ".off", b""),
        "empty glb": ("load_error", ".glb", b""),
        "text in glb": ("load_error", ".glb", b"hello " * 50),
        "text in obj": ("no_faces", ".obj", b"hello " * 50),
        "noise in stl": ("header_size_mismatch", ".stl", bytes(range(256)) * 4),
        "noise in off": ("load_error", ".off", bytes(range(256)) * 4),
        "list in gltf": ("load_error", ".gltf", b"[1, 2]"),
        "number as meshes": ("load_error", ".gltf", b'{"meshes": 7}'),
        "deep json": ("load_error", ".gltf", b'{"a":' + b"[" * 100_000),
        "no scene": ("no_faces", ".gltf", b'{"asset": {"version": "2.0"}}'),
        "stl bomb": ("header_size_mismatch", ".stl", bytes(80) + b"\xff" * 4 + bytes(500)),
        "points": ("point_cloud", ".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "obj range": ("index_range", ".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        "ply range": (
            "index_range",
            ".ply",
            _ply(
                f"element vertex 3\n{_XYZ}\nelement face 1\n{_LIST}",
                np.eye(3, dtype="<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, 77),
            ),
        ),
        "text as archive": ("unsupported_format", ".zip", b"v 0 0 0"),
    }
    | {
        f"{form} ply bomb {count} {element}": (
            "header_size_mismatch",
            ".ply",
            _ply(f"element {element} {count}\n{_XYZ if element == 'vertex' else _LIST}", body)
            .replace(b"binary_little_endian", form.encode()),
        )
        for form, body, counts in (
            ("binary_little_endian", bytes(64), ()), ("ascii", b"0 0 0\n" * 9, (11,)),
        )
        for count in (*counts, 2**31 - 1, 2**31, 10**18, -5)
        for element in ("vertex", "face")
    }
)  # fmt: skip


@for_each("name", RAW_FILES)
def test_bad_files(tmp_path: Path, name: str) -> None:
    reason, suffix, data = RAW_FILES[name]
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    assert by_hand.reason_of(path) == reason


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.97])
def test_files_that_were_cut_off(tmp_path: Path, keep: float) -> None:
    tree, buffer = by_hand.gltf_tree(BALL)
    for path in (
        by_hand.write_glb(tmp_path / "a.glb", tree, buffer),
        by_hand.write_stl(tmp_path / "a.stl", BALL),
        by_hand.write_ply(tmp_path / "a.ply", BALL),
        by_hand.write_off(tmp_path / "a.off", BALL),
    ):
        data = path.read_bytes()
        path.write_bytes(data[: int(keep * len(data))])
        expected = {"cut_off", "load_error", "header_size_mismatch", "index_range", "no_faces"}
        assert by_hand.reason_of(path) in expected


@for_each("write", [by_hand.write_stl, by_hand.write_ply, by_hand.write_off, by_hand.write_obj])
def test_limits_of_size(tmp_path: Path, write: Callable[[Path, TriangleMesh], Path]) -> None:
    path = write(tmp_path / f"a.{write.__name__[-3:]}", BALL)
    assert by_hand.reason_of(path, AssetSettings(max_source_faces=79)) == "too_many_faces"
    small = AssetSettings(max_source_bytes=path.stat().st_size - 1)
    assert by_hand.reason_of(path, small) == "too_large_bytes"


def test_a_header_of_too_many_faces_is_enough(tmp_path: Path) -> None:
    """They are refused before anything is made of them: what follows may be no faces at all."""
    path = by_hand.write_ply(tmp_path / "a.ply", BALL)
    header, end, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(header + end + b"\xff" * len(body))
    assert by_hand.reason_of(path, AssetSettings(max_source_faces=79)) == "too_many_faces"
    assert by_hand.reason_of(path, AssetSettings(max_source_faces=80)) != "too_many_faces"


def test_errors_beyond_the_bound_are_stated_and_their_levels_left_out(tmp_path: Path) -> None:
    path = by_hand.write_obj(tmp_path / "a.obj", by_hand.knot())
    settings = AssetSettings(budgets=(1000,), gate=GateSettings(max_error_p99=1e-4))
    with pytest.raises(Rejected, match=r"error_over_bound: p99 distance \d+\.\d+%"):
        by_hand.prepare(path, settings)
    gate = GateSettings(max_error_p99=0.01)
    asset = by_hand.prepare(path, AssetSettings(budgets=(1400, 60), gate=gate))
    assert [level.record.budget for level in asset.levels] == [1400]


@for_each("make", ["nothing", "folder", "pipe", "link to nothing"])
def test_what_is_no_file(tmp_path: Path, make: str) -> None:
    path = tmp_path / "a.obj"
    if make == "folder":
        path.mkdir()
    elif make == "pipe":
        os.mkfifo(path)
    elif make == "link to nothing":
        path.symlink_to(tmp_path / "b.obj")
    assert by_hand.reason_of(path) == "missing_file"
