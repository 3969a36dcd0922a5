"""Scenes and pictures at the ends of what they may hold come back, or are refused by name.

In samples, USD, JSON and HDF5.
"""

import dataclasses
import io
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from numpy.typing import ArrayLike, NDArray

from infra.bench.workloads.named_scenes import cost_scene
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from pipeline.presets.registry import preset_settings
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_channels, encode_exr
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.profiles import PROFILES, keeps_law, pack_picture
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import MAX_POSITION_M, Scene, SceneObject
from storage.settings.described import settings_record
from tests.extremes.test_scenes import SHAPES
from tests.for_each import case
from tests.pipeline.exchange.exchange_kit import (
    assert_h5_keeps_light,
    assert_json_keeps_light,
    assert_usd_keeps_all,
    h5_and_back,
    json_and_back,
)
from tests.pipeline.renders.scene_kit import flat, join, light, material, textured_floor
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_sample, tiny_scene

ENDS = np.finfo(np.float32)


COLUMNS: dict[str, tuple[int, int | slice]] = {
    "diffuse": (FLOOR, DIFFUSE), "specular": (FLOOR, SPECULAR), "roughness": (FLOOR, ROUGHNESS),
    "emission": (LIGHT, EMISSION),
}  # fmt: skip


def surface(**columns: ArrayLike) -> Scene:
    """Return the tiny scene with another floor, or a light of another emission."""
    scene = tiny_scene()
    for name, value in columns.items():
        scene.materials[COLUMNS[name]] = np.asarray(value, np.float32)
    return scene


def seen_at(*fov_deg: float) -> Scene:
    return tiny_scene(fov_deg=np.array(fov_deg, np.float32))


def shrunk(*corners: ArrayLike, first: int = 0) -> Scene:
    """Return the tiny scene with another triangle, of three vertices: in its floor, or the lamp."""
    scene = tiny_scene()
    scene.vertex_positions[first : first + 3] = np.asarray(corners, np.float32)
    return scene


SCENES: dict[str, Callable[[], Scene]] = {
    "roughness 0": lambda: surface(roughness=0),
    "white": lambda: surface(diffuse=1, specular=0),
    "mirror": lambda: surface(diffuse=0, specular=1, roughness=0),
    "sum of exactly 1": lambda: surface(diffuse=[0.25, 0.1, 0.7], specular=[0.75, 0.9, 0.3]),
    "emission 1e6": lambda: surface(emission=1e6),
    "emission in one channel": lambda: surface(emission=[0, float(ENDS.tiny), 0]),
    "fov 0.001 and 179": lambda: seen_at(0.001, 179),
    "64 lights": lambda: join(SHAPES["64 lights"]),
    "sliver 1e-7": lambda: shrunk([0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]),
    "to the farthest position": lambda: tiny_scene(
        vertex_positions=tiny_scene().vertex_positions * np.float32(500)
    ),
}


@pytest.mark.parametrize("form", [".usda", ".usdc", "JSON", "HDF5"])
def test_every_form_holds_it(tmp_path: Path, form: str) -> None:
    for name, make in SCENES.items():
        scene = make()
        with case(name):
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
    ("width", "num_flat"),
    [(1, 1), (0, 2)],  # where the first half has no size, the other half has no width
    ids=["no width", "no size"],
)
def test_triangles_without_area_stay_or_are_said_to_be_lost(
    tmp_path: Path, width: float, num_flat: int
) -> None:
    """A floor of which nothing is left is left out of the JSON, whose readers would refuse it."""
    floor = textured_floor(material(diffuse=0.5))
    ring = np.array([[0, 0, 0], [width, 0, 0], [width / 2, 0, 0], [-1, 1, 0]])
    shrunk_floor = dataclasses.replace(floor, triangles=ring[[[0, 1, 2], [0, 2, 3]]])
    wall = flat([[[-1, 1, 0], [1, 1, 0], [0, 1, 1]]], material(diffuse=0.5), "shell")
    scene = join([shrunk_floor, wall, light([[0, 0, 2], [0, 1, 2], [1, 0, 2]], 100.0)])
    assert_usd_keeps_all(scene, tmp_path, ".usdc")
    assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)
    back, lost = json_and_back(scene, tmp_path)
    assert back.num_triangles == scene.num_triangles - num_flat
    assert any(f"{num_flat} triangles without an area" in loss for loss in lost)


def at_the_ends_of_floats() -> Scene:
    scene = surface(emission=[1e38, float(ENDS.smallest_subnormal), 0])
    scene.vertex_positions[0] = np.array([MAX_POSITION_M, -ENDS.tiny, -0.0], np.float32)
    scene.vertex_positions[1] = np.array([ENDS.smallest_subnormal, 0, -MAX_POSITION_M], np.float32)
    return scene


def test_the_ends_of_floats_come_back_in_usd_and_hdf5(tmp_path: Path) -> None:
    scene = at_the_ends_of_floats()
    for suffix in (".usda", ".usdc", ".usdz"):
        assert_usd_keeps_all(scene, tmp_path, suffix)
    assert_h5_keeps_light(h5_and_back(scene, tmp_path), scene)


def test_what_readers_would_refuse_or_no_scene_may_be_is_not_written(tmp_path: Path) -> None:
    """Brighter or wider than the form says, and a light of no area."""
    for refused, message in (
        (surface(emission=2e9), "emissive.*expected"),
        (seen_at(40, 179.5), "fov.*expected"),
        (shrunk(*np.ones((3, 3)), first=4), "no emitter has an area"),
    ):
        with case(message), pytest.raises(TrilightError, match=message):
            write_renderformer_json(tmp_path / "a.json", refused)
    farther = np.nextafter(np.float32(MAX_POSITION_M), np.float32(np.inf))
    too_far = tiny_scene(vertex_positions=np.full((7, 3), farther, np.float32))
    unlawful = {"far": too_far, "fov 0": seen_at(0, 40), "sum over 1": surface(diffuse=1)}
    for name, scene in unlawful.items():
        with case(name):
            with pytest.raises(TrilightError):
                assert_usd_keeps_all(scene, tmp_path, ".usda")
            with pytest.raises(TrilightError):
                write_renderformer_json(tmp_path / "a.json", scene)
            assert not list(tmp_path.iterdir())


FINITE = np.arange(0x7C00, dtype=np.uint16).view(np.float16)
"""Every half float from 0 to 65504."""
SMALLEST = float(FINITE[1])


def _halfs(resolution: int, numbers: NDArray[np.float16] = FINITE) -> NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return rng.choice(numbers, (resolution, resolution, 3)).astype(np.float32)


def _constant(resolution: int, value: float = 0.0) -> NDArray[np.float32]:
    return np.full((resolution, resolution, 3), value, np.float32)


def _spike(resolution: int) -> NDArray[np.float32]:
    picture = _constant(resolution)
    picture[resolution // 2, resolution // 2] = HALF_FLOAT_MAX
    return picture


PICTURES: dict[str, Callable[[int], NDArray[np.float32]]] = {
    "zeros": _constant,
    "brightest": lambda resolution: _constant(resolution, HALF_FLOAT_MAX),
    "one brightest pixel": _spike,
    "all half floats": _halfs,
    "denormals": lambda resolution: _halfs(resolution, FINITE[:1024]),
    "smallest": lambda resolution: _constant(resolution, SMALLEST),
}
RESOLUTIONS = (1, 8, 9, 33, 72)


@pytest.mark.parametrize("make", PICTURES.values(), ids=PICTURES.keys())
def test_every_half_float_comes_back_or_keeps_the_law(
    make: Callable[[int], NDArray[np.float32]],
) -> None:
    """DWA turns the brightest half floats into infinity and zeros below 0: neither gets out."""
    for resolution in RESOLUTIONS:
        picture = make(resolution)
        back = decode_exr(pack_picture(picture, 40.0, "lossless"))
        np.testing.assert_array_equal(back, picture, err_msg=f"{resolution} pixels")
    floors_db = (10.0, 45.0, 80.0, 90.0)
    cases = [*itertools.product(RESOLUTIONS, floors_db), (264, 45.0)]  # a chunk is 256 lines
    for resolution, floor_db in cases:
        picture = make(resolution)
        back = decode_exr(pack_picture(picture, floor_db, "compact"))
        with case(f"{resolution} pixels, {floor_db} dB"):
            assert np.isfinite(back).all()
            assert (back >= 0).all()
            assert np.array_equal(back, picture) or keeps_law(picture, back, floor_db)


def test_rounding_to_half_floats_is_the_only_loss() -> None:
    """Values between two half floats go to the nearer: 2^-11 of the value, or half of 6e-8."""
    exponents = np.random.default_rng(0).uniform(-9, 4.8, (64, 64, 3))
    picture = (10.0**exponents).astype(np.float32)
    back = decode_exr(encode_exr(picture))
    assert (np.abs(back - picture) <= np.maximum(picture * 2.0**-11, SMALLEST / 2)).all()


@pytest.mark.parametrize("emission", [65504.0, SMALLEST, 1e5, 1e-8])
def test_the_ends_of_half_floats_go_through_hdf5(tmp_path: Path, emission: float) -> None:
    """Lights beyond them too: only pictures are half floats."""
    scene = surface(emission=emission)
    pictures = np.stack([_spike(8), _halfs(8)])
    write_renderformer_h5(tmp_path / "a.h5", scene, pictures)
    read = read_renderformer_h5(tmp_path / "a.h5")
    assert read.radiance_rgb is not None
    assert np.array_equal(read.radiance_rgb, pictures)
    lit = read.scene.materials[read.scene.material_index[read.scene.triangle_emits]]
    assert (lit[:, EMISSION] == emission).all()


def test_hdf5_refuses_what_no_picture_may_hold(tmp_path: Path) -> None:
    for value in (np.nan, np.inf, 65520.0, -1.0):
        pictures = np.ones((2, 8, 8, 3), np.float32)
        pictures[1, 0, 0, 0] = value
        with pytest.raises(TrilightError, match=r"expected a finite value in \[0, 65504\]"):
            write_renderformer_h5(tmp_path / "a.h5", tiny_scene(), pictures)
        assert not list(tmp_path.iterdir())


def test_the_ends_of_numbers_are_packed_exactly() -> None:
    """65536 materials and objects, vertex rows beyond 16 bits, and extreme numbers.

    The last row is 65535, the greatest that 16 bits hold.
    """
    scene, count = at_the_ends_of_floats(), 1 << 16
    materials = np.repeat(scene.materials[[0]], count, axis=0)
    materials[-1] = scene.materials[LIGHT]
    shells = tuple(SceneObject(name=f"part{row}", kind="shell") for row in range(count - 1))
    positions, normals = (
        np.concatenate([np.repeat(array[:1], count, axis=0), array])
        for array in (scene.vertex_positions, scene.vertex_normals)
    )
    last = np.array([0, count - 2, count - 1], np.uint16)
    scene = dataclasses.replace(
        scene,
        vertex_positions=positions,
        vertex_normals=normals,
        faces=scene.faces + np.uint32(count),
        material_index=last,
        object_index=last,
        materials=materials,
        objects=(*shells, SceneObject(name="light", kind="emitter")),
    )
    scene.check()
    sample = dataclasses.replace(tiny_sample(), scene=scene)
    for profile in PROFILES:
        back = decode_sample("0", encode_sample(sample, profile)).scene
        for name in ("faces", "material_index", "object_index", "vertex_positions", "materials"):
            found, wanted = getattr(back, name), getattr(scene, name)
            case = f"{name}, {profile}"
            assert found.dtype == wanted.dtype and found.tobytes() == wanted.tobytes(), case
        assert back.objects == scene.objects, profile


NUMBERS = {
    "seed": 2**256 - 1, "far": -(2**64), "least": 5e-324, "largest": 1.7976931348623157e308,
    "zero": -0.0, "third": 1 / 3,
}  # fmt: skip


def test_numbers_of_json_come_back_digit_by_digit_and_no_others(tmp_path: Path) -> None:
    """Of provenance, in samples and in USD, and of settings: also integers beyond 64 bits."""
    scene = tiny_scene(provenance=NUMBERS)
    sample = dataclasses.replace(tiny_sample(), scene=scene)
    back = decode_sample("0", encode_sample(sample)).scene.provenance
    assert json.dumps(dict(back), sort_keys=True) == json.dumps(NUMBERS, sort_keys=True)
    for suffix in (".usda", ".usdc"):
        assert_usd_keeps_all(scene, tmp_path, suffix)
    build = preset_settings("smoke", seed=2**256 - 1)
    assert json.loads(json.dumps(settings_record(build)))["seed"] == 2**256 - 1
    sample = dataclasses.replace(tiny_sample(), scene=tiny_scene(provenance={"value": math.nan}))
    with pytest.raises(ValueError, match="JSON compliant"):
        encode_sample(sample)


def test_the_ends_of_numbers_go_through_the_header_of_a_picture_and_no_others() -> None:
    picture = {"RGB": np.ones((8, 8, 3), np.float16)}
    for value in (2**31 - 1, -(2**31), float(ENDS.max), str(2**256 - 1)):
        data = encode_channels(picture, attributes={"seed": value})
        header = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).header()
        assert header["seed"] == value
    # OpenEXR would write 2^31 as -2^31, 1e39 as infinity, and raise SystemError for 2^64
    for value in (2**31, -(2**31) - 1, 2**64, 1e39, -1e39, math.inf, math.nan):
        with pytest.raises(TrilightError, match="attribute seed is .*; expected a number from -"):
            encode_channels(picture, attributes={"seed": value})
