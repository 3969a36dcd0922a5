"""Damaged USD files, read in a child: a lawful scene, or one line that names the file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdUtils

from pipeline.exchange.usd.read import read_usd, usd_keys
from pipeline.exchange.usd.write import SUFFIXES, write_usd
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from storage.errors import TrilightError
from tests.pipeline.exchange.strangers_stage import write_stage
from tests.scenes_by_hand import tiny_scene

COPIES = 60
LIMITS = ChildLimits(memory_bytes=4 << 30, wall_s=60, calls_per_child=1000)


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, setup=nothing)
    yield child
    child.close()


def nothing() -> None:
    """A child needs no preparation."""


def read_all(path: Path) -> int:
    """Read every scene of a file; only children come here."""
    for key in usd_keys(path)[:3]:
        read_usd(path, key or None, None, "").scene.check()
    return 1


def whole_file(folder: Path, suffix: str, ours: bool) -> bytes:
    path = folder / f"whole{suffix}"
    if ours:
        write_usd(path, tiny_scene())
    elif suffix == ".usdz":
        UsdUtils.CreateNewUsdzPackage(str(write_stage(folder)), str(path))
    else:
        Sdf.Layer.FindOrOpen(str(write_stage(folder))).Export(str(path))
    return path.read_bytes()


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut a file off, or give 1 to 12 of its bytes other values."""
    values = np.frombuffer(data, np.uint8).copy()
    if rng.random() < 1 / 3:
        return values[: rng.integers(1, len(values))].tobytes()
    at = rng.integers(0, len(values), rng.integers(1, 13))
    values[at] = rng.integers(0, 256, len(at))
    return values.tobytes()


@pytest.mark.parametrize("ours", [True, False], ids=["ours", "strangers"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damage_ends_in_one_line(
    tmp_path: Path, child: IsolatedChild, suffix: str, ours: bool
) -> None:
    """Native code may even crash there: that costs the child, which the command says in a line.

    These 360 files crash nothing (usd-core 26.11); what comes out of the reader is TrilightError.
    """
    data, refused = whole_file(tmp_path, suffix, ours), 0
    for seed in range(COPIES):
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(damaged(data, np.random.default_rng(seed)))
        try:
            child.call(read_all, path)
        except TrilightError as error:
            refused += 1
            text = str(error)
            assert text.startswith(path.name) and text.isprintable(), text
            assert str(tmp_path) not in text
        except ChildFailed as failure:
            assert failure.reason != "exception", failure.message
    assert refused > COPIES // 2


ODD: list[tuple[str, str, Any]] = [
    ("/W/Grid.points", "string", "x"),
    ("/W/Grid.points", "double[]", [1.0, 2.0]),
    ("/W/Grid.faceVertexCounts", "token[]", ["a"]),
    ("/W/Grid.faceVertexIndices", "float[]", [float("nan")]),
    ("/W/Grid.normals", "string[]", ["a"]),
    ("/W/Grid.primvars:st", "int", 3),
    ("/W/mat/preview.inputs:roughness", "string", "smooth"),
    ("/W/mat/texture.inputs:scale", "token", "x"),
    ("/W/rect.inputs:width", "string", "wide"),
    ("/W/rect.inputs:intensity", "float[]", [1.0, 2.0]),
    ("/W/rect.inputs:exposure", "float", 1e9),
    ("/W/cam.focalLength", "string", "long"),
    ("/W/cam.focalLength", "float", float("nan")),
    ("/W/many.protoIndices", "string[]", ["a"]),
    ("/W/many.positions", "point3f[]", [(0, 0, 0)]),
]


def test_values_of_another_kind_are_refused_or_noted(tmp_path: Path) -> None:
    """A layer may call an attribute of a schema by any type; so may one that a person wrote."""
    for number, (path, kind, value) in enumerate(ODD):
        (tmp_path / str(number)).mkdir()
        _require_refused_or_lawful(tmp_path / str(number), path, kind, value)


def _require_refused_or_lawful(tmp_path: Path, path: str, kind: str, value: Any) -> None:
    stage = Usd.Stage.Open(str(write_stage(tmp_path)))
    prim_path, name = path.split(".")
    prim = stage.GetPrimAtPath(prim_path)
    assert prim
    prim.RemoveProperty(name)
    spec = Sdf.AttributeSpec(
        stage.GetRootLayer().GetPrimAtPath(prim_path), name, Sdf.ValueTypeNames.Find(kind)
    )
    spec.default = value
    stage.GetRootLayer().Export(str(tmp_path / "odd.usda"))
    try:
        found = read_usd(tmp_path / "odd.usda", None, None, "")
    except TrilightError as error:
        assert str(error).startswith("odd.usda: ") and str(error).isprintable(), (path, kind)
    else:
        found.scene.check()
