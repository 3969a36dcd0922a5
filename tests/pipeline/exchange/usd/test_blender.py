"""Blender opens what we export and exports what we read; only where it is installed."""

import dataclasses
import json
import os
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from infra.bench.workloads.blender_environment import installed_python
from infra.bench.workloads.cycles import CyclesOptions, cycles_of_usd
from infra.bench.workloads.shots import fixed_samples, shots
from pipeline.exchange.usd.read import UsdScene, read_usd
from pipeline.exchange.usd.write import write_usd
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.variant import activate, choose_variant
from scene_templates.rotations import uniform_rotation
from storage.conventions import preview_srgb8
from storage.metrics import psnr_linear_db
from storage.records.environment import Environment
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.pipeline.scenes.example_scenes import example_scene
from tests.sky_maps import as_sky, six_poles
from tests.textured_by_hand import number_texture, textured_scene


def run_blender(process: str, folder: Path, request: dict[str, Any]) -> NDArray[np.float32]:
    """Run a script of this folder in Blender's Python; return the picture [R, R, 3] that it makes.

    Skips where Blender has not been installed: that is 380 MB, which tests do not download.
    """
    python = installed_python()
    if python is None:
        pytest.skip("Blender is not installed: run `trilight bench cycles` once")
    folder.mkdir(exist_ok=True)
    asked = {"bounces": 8, "denoise": True, "seed": 0, "threads": 2, **request}
    (folder / "request.json").write_text(json.dumps(asked))
    result = subprocess.run(
        [str(python), "-I", str(Path(__file__).with_name(process)), str(folder)],
        env={**os.environ, "HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    picture: NDArray[np.float32] = np.load(folder / "picture.npy")
    return picture


def ours(scene: Scene, resolution: int, spp: int) -> NDArray[np.float32]:
    """Return our picture [R, R, 3] of the first view."""
    limits = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1)
    child = IsolatedChild(limits=limits, setup=activate, setup_args=(choose_variant(),))
    try:
        settings = {"ours": fixed_samples(resolution, spp)}
        return child.call(shots, scene, settings)["ours"].view.radiance_rgb
    finally:
        child.close()


RESOLUTION, SPP = 96, 256


def blender(folder: Path, usd: Path, **request: Any) -> tuple[dict[str, Any], np.ndarray]:
    """Return what Blender says of a USD file, and its picture [R, R, 3]."""
    asked = {"usd": str(usd), "exact": False, "export": None, "camera": "camera_0"}
    asked |= {"resolution": RESOLUTION, "spp": SPP, **request}
    picture = run_blender("blender_usd_process.py", folder, asked)
    return json.loads((folder / "facts.json").read_text()), picture


@pytest.mark.slow("references")
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


SCENE_PX, SCENE_SPP = 192, 128
WATTS, AREA = 60.0, 0.8 * 0.5


@pytest.mark.slow("references")
def test_a_scene_that_blender_exports_looks_as_blender_renders_it(
    tmp_path: Path, record_property: Any
) -> None:
    """Measured: 37.5 dB (linear); mean radiance 1.029, 1.028, 1.023 times Blender's.

    What differs, and no `Scene` holds: the Principled BSDF's coat of index 1.5 takes light from
    the diffuse part below it and reflects more at grazing angles, ours does neither (the 3 %); a
    texture is one colour a triangle, which shows as facets (0.023 root mean square in linear
    light); a rectangle emits to one side there. The bounds leave 1.4 dB, and 2 % of radiance, to
    the noise of 128 samples on another processor. A light 10 % brighter gives 27.7 dB.
    """
    theirs = run_blender(
        "blender_scene_process.py", tmp_path, {"resolution": SCENE_PX, "spp": SCENE_SPP}
    )
    found = read_usd(tmp_path / "scene.usdc", None, None, "LicenseRef-user-provided")
    picture = ours(found.scene, SCENE_PX, SCENE_SPP)
    both = np.concatenate([preview_srgb8(theirs), preview_srgb8(picture)], axis=1)
    Image.fromarray(both).save(tmp_path / "blender_and_ours.png")
    agreement = psnr_linear_db(picture, theirs)
    ratio = picture.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))
    print(f"{agreement:.2f} dB, radiance {ratio}, {tmp_path / 'blender_and_ours.png'}")  # noqa: T201
    record_property("psnr_linear_db", round(agreement, 2))
    assert agreement > 36
    assert ratio == pytest.approx([1, 1, 1], abs=0.05)
    assert_read(found)
    again = read_usd(tmp_path / "instances.usdc", None, None, "LicenseRef-user-provided")
    assert sizes(again) == sizes(found)  # instances or copies: the same triangles


def assert_read(found: UsdScene) -> None:
    """What Blender says of the scene that it made: faces, colours, watts, angle, and losses."""
    scene = found.scene
    assert sizes(found) == {
        "Grid": 512, "Plane": 2, "Cylinder": 12 * 2 + 2 * 10, "Sphere": 24 * 22, "Suzanne": 968,
        "Suzanne.2": 968, "Area": 2,
    }  # fmt: skip
    rows = {
        entry.name: scene.materials[scene.material_index[scene.object_index == row]]
        for row, entry in enumerate(scene.objects)
    }
    # single precision of what stands in the file
    assert rows["Sphere"][0, :7] == pytest.approx([0, 0, 0, 0.8, 0.6, 0.3, 0.4], rel=1e-6)
    assert rows["Plane"][0, :7] == pytest.approx([0.7, 0.65, 0.6, 0.04, 0.04, 0.04, 0.7], rel=1e-6)
    radiance = WATTS / (np.pi * AREA) * np.array([1, 0.9, 0.8])
    assert rows["Area"][0, EMISSION] == pytest.approx(radiance, rel=1e-6)
    assert float(scene.fov_deg[0]) == pytest.approx(42, rel=1e-5)
    (paint,) = scene.textures  # the bytes of the picture that Blender wrote
    assert paint.is_srgb and paint.texels.shape == (64, 64, 3)
    for words in ("emits to one side", "are square"):
        assert any(words in text for text in found.lost), words
    assert len(found.lost) == 2


def sizes(found: UsdScene) -> dict[str, int]:
    """Return the triangles of each object."""
    counts = Counter(found.scene.object_index.tolist())
    return {entry.name: counts[row] for row, entry in enumerate(found.scene.objects)}


MAP_PX, MAP_SPP = 48, 256


def _map_scene() -> Scene:
    """A floor with four colours below a sky that is seen, turned by any rotation."""
    colours = np.array([[[180, 20, 20], [20, 180, 20]], [[20, 20, 180], [170, 170, 20]]], np.uint8)
    texture = Texture(texels=colours, is_srgb=True)  # wide texels: mostly what is between them
    turn = uniform_rotation(np.random.default_rng(4)).astype(np.float32)
    sky = as_sky(six_poles().radiance_rgb / 10, rotation=turn, is_seen=True)
    scene = textured_scene(0, texture, number_texture(), environment=sky)
    uv = 0.5 * scene.vertex_positions[scene.faces.ravel(), :2] + 0.5
    return dataclasses.replace(scene, uv=uv.astype(np.float32))


def _turned(sky: Environment | None) -> Environment:
    assert sky is not None
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    return dataclasses.replace(sky, rotation=(sky.rotation @ quarter).astype(np.float32))


@pytest.mark.slow("references")
def test_textures_and_sky_are_where_we_show_them(tmp_path: Path, record_property: Any) -> None:
    """A mirrored texture and a sky a quarter off lose far more than the noise of both.

    So does a texture that is interpolated before it is decoded, as Cycles does by itself.
    """
    if installed_python() is None:
        pytest.skip("Blender is not installed: run `trilight bench cycles` once")
    scene = _map_scene()
    write_usd(tmp_path / "a.usdc", scene)
    request = CyclesOptions(resolution=MAP_PX, spp=MAP_SPP, denoise=False, threads=2)
    (theirs,) = cycles_of_usd(tmp_path / "a.usdc", request, (0,)).pictures_rgb
    assert scene.uv is not None
    mirrored = scene.uv * np.array([-1, 1], np.float32)
    wrong = {
        "mirrored u": dataclasses.replace(scene, uv=mirrored),
        "a quarter turn of the sky": dataclasses.replace(
            scene, environment=_turned(scene.environment)
        ),
    }
    agreement = _db(scene, theirs)
    record_property("psnr_linear_db", round(agreement, 2))
    print(f"as it is: {agreement:.2f} dB")  # noqa: T201
    assert agreement > 36  # the aim of study S53
    for name, other in wrong.items():
        found = _db(other, theirs)
        print(f"{name}: {found:.2f} dB")  # noqa: T201
        assert found < 25, name


def _db(scene: Scene, theirs: NDArray[np.float32]) -> float:
    return psnr_linear_db(ours(scene, MAP_PX, MAP_SPP), theirs)
