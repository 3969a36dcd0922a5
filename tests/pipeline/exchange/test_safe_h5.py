"""Hostile HDF5 files: links, bytes elsewhere, lying shapes, bombs, plug-ins, damage."""

import resource
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from storage.errors import TrilightError
from tests.conftest import ROOT
from tests.for_each import with_folders
from tests.scenes_by_hand import tiny_sample

SHAPE, MANY = (3, 3, 3), (1_000_000, 3, 3)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    sample = tiny_sample()
    write_renderformer_h5(tmp_path / "a.h5", sample.scene, sample.radiance_rgb)
    return tmp_path / "a.h5"


def _soft_link(file: Any) -> None:
    file["hidden"] = np.ones(SHAPE, "<f4")
    file["triangles"] = h5py.SoftLink("/hidden")


def _made(*shape_and_type: Any, **options: Any) -> Callable[[Any], None]:
    return lambda file: file.create_dataset("triangles", *shape_and_type, **options)


def _virtual(file: Any) -> None:
    layout = h5py.VirtualLayout(shape=SHAPE, dtype="<f4")
    layout[:] = h5py.VirtualSource("other.h5", "triangles", shape=SHAPE)
    file.create_virtual_dataset("triangles", layout)


def _filter_of_a_plug_in(file: Any) -> None:
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk(SHAPE)
    plan.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)  # zstd's registered number
    h5py.h5d.create(file.id, b"triangles", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple(SHAPE), plan)


def _raw_chunk(data: bytes) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        made = file.create_dataset("triangles", SHAPE, "<f4", chunks=SHAPE, compression="gzip")
        made.id.write_direct_chunk((0, 0, 0), data)

    return change


def _skipped_filter(file: Any) -> None:
    made = file.create_dataset("triangles", SHAPE, "<f4", chunks=SHAPE, compression="gzip")
    made.id.write_direct_chunk((0, 0, 0), bytes(108), filter_mask=1)


def _of(values: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        file["triangles"] = values

    return change


def _not_finite(wrong: float) -> Callable[[Any], None]:
    values = np.ones(SHAPE, np.float64)
    values[1, 2, 0] = wrong
    return _of(values)


def _bomb(file: Any) -> None:
    _raw_chunk(zlib.compress(bytes(200 << 20)))(file)


TEXT = np.array([[["a" * 8] * 3] * 3] * 3, dtype=h5py.string_dtype())
HOSTILE: dict[str, tuple[Callable[[Any], None], str]] = {
    "missing": (lambda file: None, "missing"),
    "soft link": (_soft_link, "is a link"),
    "external link": (_of(h5py.ExternalLink("other.h5", "/triangles")), "is a link"),
    "external bytes": (_made(SHAPE, "<f4", external=[("secret.bin", 0, 108)]), "elsewhere"),
    "virtual": (_virtual, "elsewhere"),
    "group": (lambda file: file.create_group("triangles"), "no array"),
    "no chunk stored": (_made(MANY, "<f4", chunks=(1000, 3, 3)), "chunk at .* is missing"),
    "nothing stored": (_made(MANY, "<f4"), "other bytes"),
    "too long": (_made((1 << 40, 3, 3), "<f4", chunks=(1000, 3, 3)), "at most 1000000"),
    "huge chunk": (_made(MANY, "<f8", chunks=MANY), "would take"),
    "plug-in": (_filter_of_a_plug_in, "filters .32015"),
    "chunk too small": (_raw_chunk(b"x\x9c\x03\x00\x00\x00\x00\x01"), "other bytes"),
    "chunk is no zlib": (_raw_chunk(b"nonsense" * 20), "damaged"),
    "chunk inflates": (_bomb, "too early or too late"),
    "filter skipped": (_skipped_filter, "chunk at .* is missing"),
    "integers": (_of(np.ones(SHAPE, np.int32)), "another type"),
    "big-endian": (_of(np.ones(SHAPE, ">f4")), "another type"),
    "text": (_of(TEXT), "another type"),
    "empty": (_of(h5py.Empty("<f4")), "has shape"),
    "no triangles": (_of(np.zeros((0, 3, 3), "<f4")), "has shape"),
    "NaN": (_not_finite(np.nan), "holds nan"),
    "infinite as float32": (_not_finite(1e39), "holds 1e"),
}


def test_hostile_arrays_are_refused(path: Path) -> None:
    """`other.h5` and `secret.bin` are there, and would be read if they were not refused."""
    for folder, (change, message) in with_folders(path.parent, HOSTILE.values()):
        hostile = Path(shutil.copy(path, folder))
        shutil.copy(path, folder / "other.h5")
        (folder / "secret.bin").write_bytes(np.ones(27, "<f4").tobytes())
        with h5py.File(hostile, "r+") as file:
            del file["triangles"]
            change(file)
        with pytest.raises(TrilightError, match=rf"a\.h5: triangles: .*{message}"):
            read_renderformer_h5(hostile)


def _ones_without_light() -> Any:
    texture = np.ones((3, 13, 32, 32), "<f4")
    texture[:2, 10:] = 0
    return texture


OTHERS: dict[str, tuple[str, Any, str]] = {
    "texture of another count": ("texture", np.zeros((4, 13, 32, 32), "<f2"), "has shape"),
    "texture not finite": ("texture", np.full((3, 13, 32, 32), np.nan, "<f4"), "holds nan"),
    "a camera that is none": ("c2w", np.ones((2, 4, 4), "<f4"), "orthonormal"),
    "angle of zero": ("fov", np.zeros(2, "<f4"), "above 0 and below 180"),
    "albedo over 1": ("texture", _ones_without_light(), "diffuse . specular at most 1"),
    "no light": ("texture", np.zeros((3, 13, 32, 32), "<f4"), "no emission"),
    "pictures without end": ("img", None, "img: would take"),
    "pictures not finite": ("img", np.full((2, 8, 8, 4), np.inf, "<f2"), "holds inf"),
}


def test_other_arrays_are_checked_too(path: Path) -> None:
    for folder, (name, values, message) in with_folders(path.parent, OTHERS.values()):
        other = Path(shutil.copy(path, folder))
        with h5py.File(other, "r+") as file:
            del file[name]
            if values is None:
                file.create_dataset(name, (2, 8192, 8192, 4), "<f2", chunks=(1, 64, 64, 4))
            else:
                file[name] = values
        with pytest.raises(TrilightError, match=message):
            read_renderformer_h5(other)


def test_a_normal_of_a_face_without_area_cannot_be_made(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["vn"][1] = 0
        file["triangles"][1] = 1
    with pytest.raises(TrilightError, match=r"vn\[1\] is zero"):
        read_renderformer_h5(path)


def test_a_file_that_is_cut_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    for keep in (0, 7, 100, 2000, -500):
        path.write_bytes(whole[:keep])
        with pytest.raises(TrilightError, match=r"a\.h5"):
            read_renderformer_h5(path)


def test_nothing_runs_and_little_memory_is_taken(path: Path) -> None:
    """A child with an audit hook reads the worst of them in 2 GiB of address space.

    The bomb alone would inflate to 200 MiB; the shapes claim up to 36 TB.
    """
    files = []
    for name in ("chunk inflates", "too long", "no chunk stored", "plug-in", "external link"):
        hostile = path.with_name(f"{name}.h5")
        shutil.copy(path, hostile)
        with h5py.File(hostile, "r+") as file:
            del file["triangles"]
            HOSTILE[name][0](file)
        files.append(str(hostile))
    code = (
        "import sys, pathlib\n"
        "import h5py, h5py.h5ds, numpy\n"
        "from pipeline.exchange.renderformer_h5 import read_renderformer_h5\n"
        "from storage.errors import TrilightError\n"
        f"read_renderformer_h5(pathlib.Path({str(path)!r}))\n"
        "bad = ('os.system', 'subprocess.Popen', 'os.exec', 'exec', 'import', 'ctypes.dlopen')\n"
        "seen = []\n"
        "sys.addaudithook(lambda event, args: seen.append(event) if event in bad else None)\n"
        "for name in sys.argv[1:]:\n"
        "    try:\n"
        "        read_renderformer_h5(pathlib.Path(name))\n"
        "    except TrilightError:\n"
        "        continue\n"
        "    raise SystemExit(name + ' was read')\n"
        "assert not seen, seen\n"
    )
    limit = 2 << 30
    result = subprocess.run(
        [sys.executable, "-c", code, *files],
        cwd=ROOT, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
