"""Scenes at the ends of what they may hold, in USD, JSON and HDF5: back, or refused."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from infra.bench.workloads.cost_scene import cost_scene
from pipeline.exchange.renderformer_json import described_files
from storage.errors import TrilightError
from storage.records.material import EMISSION
from storage.records.scene import MAX_POSITION_M, Scene, SceneObject
from tests.extremes.range_examples import naming
from tests.pipeline.exchange.exchange_kit import (
    assert_h5_keeps_light,
    assert_json_keeps_light,
    assert_usd_keeps_all,
    h5_and_back,
    json_and_back,
)
from tests.pipeline.renders.scene_kit import join, light, quad
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene

ENDS = np.finfo(np.float32)
FARTHER = np.nextafter(np.float32(MAX_POSITION_M), np.float32(np.inf))


def surface(**columns: ArrayLike) -> Scene:
    """Return the tiny scene with another floor: diffuse, specular, roughness."""
    scene = tiny_scene()
    for name, part in (("diffuse", slice(0, 3)), ("specular", slice(3, 6)), ("roughness", 6)):
        if name in columns:
            scene.materials[FLOOR, part] = np.asarray(columns[name], np.float32)
    return scene


def glowing(radiance: ArrayLike) -> Scene:
    scene = tiny_scene()
    scene.materials[LIGHT, EMISSION] = np.asarray(radiance, np.float32)
    return scene


def seen_at(*fov_deg: float) -> Scene:
    return tiny_scene(fov_deg=np.array(fov_deg, np.float32))


def many_lights() -> Scene:
    """Sixty-four triangles that emit differently."""
    lamps = [
        light([[x, y, 2], [x + 0.05, y, 2], [x, y + 0.05, 2]], 1.0 + 8 * x + y)
        for x in np.linspace(0, 1, 8)
        for y in np.linspace(0, 1, 8)
    ]
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], tiny_scene().materials[FLOOR])
    return join([floor, *lamps])


def scaled(size: float) -> Scene:
    scene = tiny_scene()
    scene.vertex_positions[:] *= np.float32(size)
    return scene


def shrunk(*corners: ArrayLike) -> Scene:
    """Return the tiny scene with another first triangle in its floor, of three vertices."""
    scene = tiny_scene()
    scene.vertex_positions[[0, 1, 2]] = np.asarray(corners, np.float32)
    return scene


SCENES: dict[str, Callable[[], Scene]] = {
    "roughness 0": lambda: surface(roughness=0),
    "roughness 1": lambda: surface(roughness=1),
    "smallest roughness": lambda: surface(roughness=ENDS.smallest_subnormal),
    "black": lambda: surface(diffuse=0, specular=0),
    "white": lambda: surface(diffuse=1, specular=0),
    "mirror": lambda: surface(diffuse=0, specular=1, roughness=0),
    "sum of exactly 1": lambda: surface(diffuse=[0.25, 0.1, 0.7], specular=[0.75, 0.9, 0.3]),
    "emission 1e-3": lambda: glowing(1e-3),
    "emission 1e6": lambda: glowing(1e6),
    "emission in one channel": lambda: glowing([0, float(ENDS.tiny), 0]),
    "fov 1 and 170": lambda: seen_at(1, 170),
    "fov 0.001 and 179": lambda: seen_at(0.001, 179),
    "64 lights": many_lights,
    "sliver 1e-7": lambda: shrunk([0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]),
    "a micrometre": lambda: scaled(1e-3),
    "to the farthest position": lambda: scaled(500),
}


@pytest.mark.parametrize("form", [".usda", ".usdc", "JSON", "HDF5"])
def test_every_form_holds_it(tmp_path: Path, form: str) -> None:
    for name, make in SCENES.items():
        scene = make()
        with naming(name):
            if form == "JSON":
                assert_json_keeps_light(json_and_back(scene, tmp_path)[0], scene)
            elif form == "HDF5":
                assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)
            else:
                assert_usd_keeps_all(scene, tmp_path, form)


def test_sixteen_thousand_triangles(tmp_path: Path) -> None:
    """Without HDF5, whose textures of them are 850 MB."""
    scene = cost_scene(16384, 8)
    assert scene.num_triangles > 15000
    assert_usd_keeps_all(scene, tmp_path, ".usdc")
    assert_json_keeps_light(json_and_back(scene, tmp_path)[0], scene)


@pytest.mark.parametrize(
    ("scene", "flat"),
    [
        (shrunk([0, 0, 0], [1, 0, 0], [0.5, 0, 0]), 1),
        (shrunk([0, 0, 0], [0, 0, 0], [0, 0, 0]), 2),  # then the other half has no width
    ],
    ids=["no width", "no size"],
)
def test_triangles_without_area_stay_or_are_said_to_be_lost(
    tmp_path: Path, scene: Scene, flat: int
) -> None:
    """A floor of which nothing is left is left out of the JSON, whose readers would refuse it."""
    assert_usd_keeps_all(scene, tmp_path, ".usdc")
    assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)
    back, lost = json_and_back(with_a_wall(scene), tmp_path)
    assert back.num_triangles == with_a_wall(scene).num_triangles - flat
    assert any(f"{flat} triangles without an area" in loss for loss in lost)


def with_a_wall(scene: Scene) -> Scene:
    """Return a scene with one more shell part, of the floor's material and one triangle."""
    corners = np.array([[-1, 1, 0], [1, 1, 0], [0, 1, 1]], np.float32)
    return dataclasses.replace(
        scene,
        vertex_positions=np.concatenate([scene.vertex_positions, corners]),
        vertex_normals=np.concatenate([scene.vertex_normals, [[0, -1, 0]] * 3]).astype(np.float32),
        faces=np.concatenate([scene.faces, [[7, 8, 9]]]).astype(np.uint32),
        material_index=np.append(scene.material_index, np.uint16(FLOOR)),
        object_index=np.append(scene.object_index, np.uint16(2)),
        objects=(*scene.objects, SceneObject(name="wall0", kind="shell")),
    )


def test_a_scene_whose_light_has_no_area_is_no_json() -> None:
    scene = tiny_scene()
    scene.vertex_positions[4:] = 1.0
    with pytest.raises(TrilightError, match="no emitter has an area"):
        described_files(scene, "a")


def at_the_ends_of_floats() -> Scene:
    scene = tiny_scene()
    scene.vertex_positions[0] = np.array([MAX_POSITION_M, -ENDS.tiny, -0.0], np.float32)
    scene.vertex_positions[1] = np.array([ENDS.smallest_subnormal, 0, -MAX_POSITION_M], np.float32)
    scene.materials[LIGHT, EMISSION] = np.array([1e38, ENDS.smallest_subnormal, 0], np.float32)
    return scene


def test_the_ends_of_floats_come_back_in_usd_and_hdf5(tmp_path: Path) -> None:
    scene = at_the_ends_of_floats()
    for suffix in (".usda", ".usdc", ".usdz"):
        assert_usd_keeps_all(scene, tmp_path, suffix)
    assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)


REFUSED: dict[str, tuple[Callable[[], Scene], str]] = {
    "brighter than the form says": (lambda: glowing(2e9), "emissive.*expected"),
    "the ends of floats": (at_the_ends_of_floats, "emissive.*expected"),
    "wider than the form says": (lambda: seen_at(40, 179.5), "fov.*expected"),
    "narrower": (lambda: seen_at(40, 5e-4), "fov.*expected"),
}


def test_json_that_readers_would_refuse_is_not_written() -> None:
    for name, (make, message) in REFUSED.items():
        with naming(name), pytest.raises(TrilightError, match=message):
            described_files(make(), "a")


UNLAWFUL: dict[str, dict[str, object]] = {
    "NaN": {"vertex_positions": np.full((7, 3), np.nan, np.float32)},
    "too far": {"vertex_positions": np.full((7, 3), FARTHER, np.float32)},
    "infinite": {"vertex_positions": np.full((7, 3), np.inf, np.float32)},
    "fov 0": {"fov_deg": np.array([0, 40], np.float32)},
    "fov 180": {"fov_deg": np.array([40, 180], np.float32)},
    "sum over 1": {"materials": tiny_scene().materials + np.float32(0.5)},
}


def test_what_no_scene_may_be_is_not_written(tmp_path: Path) -> None:
    for name, changes in UNLAWFUL.items():
        scene = dataclasses.replace(tiny_scene(), **changes)  # type: ignore[arg-type]
        with naming(name):
            with pytest.raises(TrilightError):
                assert_usd_keeps_all(scene, tmp_path, ".usda")
            with pytest.raises(TrilightError):
                described_files(scene, "a")
            assert not list(tmp_path.iterdir())
