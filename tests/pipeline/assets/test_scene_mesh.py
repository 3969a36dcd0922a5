"""Meshes that a scene file names: remeshed where asked for, or refused by name."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.scene_mesh import load_scene_mesh
from pipeline.assets.settings import AssetSettings
from storage.errors import Rejected
from tests.pipeline.assets.meshes_by_hand import knot, write_obj

SETTINGS = AssetSettings()


def test_remeshing_keeps_size_place_and_number(tmp_path: Path) -> None:
    moved = TriangleMesh(positions=3 * knot().positions + [5, -2, 1], faces=knot().faces)
    path = write_obj(tmp_path / "knot.obj", moved)
    as_it_is = load_scene_mesh(path, SETTINGS, None).mesh
    even = load_scene_mesh(path, SETTINGS, 1000).mesh
    assert len(as_it_is.faces) == len(moved.faces)
    assert 500 < len(even.faces) <= 1000
    for end in ("min", "max"):
        before, after = (getattr(mesh.positions, end)(axis=0) for mesh in (as_it_is, even))
        # A thousand triangles cut the corners of a tube by a few percent of its box at most.
        np.testing.assert_allclose(after, before, atol=0.03 * np.ptp(moved.positions))


def test_a_mesh_without_area_cannot_be_remeshed(tmp_path: Path) -> None:
    line = TriangleMesh(
        positions=np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2], [3, 4, 5]])
    )
    path = write_obj(tmp_path / "line.obj", line)
    assert len(load_scene_mesh(path, SETTINGS, None).mesh.faces) == 2
    with pytest.raises(Rejected) as caught:
        load_scene_mesh(path, SETTINGS, 100)
    assert caught.value.reason == "remesh_failed"
