"""Blender opens what we export, and shows it as we do: minutes long, and only where it is there."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.exchange.usd.read import read_usd
from pipeline.exchange.usd.write import write_usd
from storage.metrics import psnr_linear_db
from storage.records.scene import Scene
from tests.pipeline.exchange.usd.blender_kit import ours, run_blender
from tests.pipeline.scenes.example_scenes import example_scene

pytestmark = pytest.mark.slow("references")

RESOLUTION, SPP = 96, 256


def blender(folder: Path, usd: Path, **request: Any) -> tuple[dict[str, Any], np.ndarray]:
    """Return what Blender says of a USD file, and its picture [R, R, 3]."""
    asked = {"usd": str(usd), "exact": False, "export": None, "camera": "camera_0"}
    asked |= {"resolution": RESOLUTION, "spp": SPP, **request}
    picture = run_blender("blender_usd_process.py", folder, asked)
    return json.loads((folder / "facts.json").read_text()), picture


@pytest.mark.parametrize("name", ["cbox"])
def test_blender_shows_what_we_show(
    shared: Path, tmp_path: Path, name: str, record_property: Any
) -> None:
    scene = example_scene(shared, name)
    write_usd(tmp_path / "a.usdc", scene)
    theirs = tmp_path / "theirs.usdc"
    facts, imported = blender(tmp_path / "imported", tmp_path / "a.usdc", export=str(theirs))
    assert_found(facts, scene)
    _, exact = blender(tmp_path / "exact", tmp_path / "a.usdc", exact=True)
    picture = ours(scene, RESOLUTION, SPP)
    figures = {
        "as imported": psnr_linear_db(imported, picture),
        "after our script": psnr_linear_db(exact, picture),
    }
    print(figures)  # noqa: T201
    for key, value in figures.items():
        record_property(key, round(value, 2))
    assert figures["after our script"] >= 34  # the bound, at the noise of both pictures
    back = read_usd(theirs, None, None, "LicenseRef-user-provided")
    assert back.scene.num_triangles == scene.num_triangles


def assert_found(facts: dict[str, Any], scene: Scene) -> None:
    """Every mesh, material and camera is there with its values; single precision all over."""
    counts = np.bincount(scene.object_index)
    assert sorted(m["triangles"] for m in facts["meshes"].values()) == sorted(counts.tolist())
    assert all(mesh["custom_normals"] for mesh in facts["meshes"].values())
    assert len(facts["materials"]) == len(scene.materials)
    for row, values in enumerate(scene.materials):
        found = facts["materials"][f"material_{row}"]
        assert found["diffuse"] == pytest.approx(values[:3].tolist(), rel=1e-6)
        assert found["specular"] == pytest.approx(values[3:6].tolist(), rel=1e-6)
        assert found["roughness"] == pytest.approx(values[6], rel=1e-6)
        emission = np.array(found["emission"]) * found["strength"]
        assert emission == pytest.approx(values[7:], rel=1e-6)
    for view in range(scene.num_views):
        camera = facts["cameras"][f"camera_{view}"]
        assert camera["fov"] == pytest.approx(float(scene.fov_deg[view]), rel=1e-5)
        assert np.array(camera["c2w"]) == pytest.approx(scene.c2w[view], abs=1e-6)
