"""Pictures and scenes at the ends of what they may hold come back, or are refused by name."""

import dataclasses
import io
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from pipeline.builds.named import named_build
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.material import EMISSION
from storage.records.profiles import PROFILES, Profile, keeps_law, pack_picture
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import MAX_POSITION_M, Scene, SceneObject
from tests.pipeline.exchange.exchange_kit import assert_usd_keeps_all
from tests.scenes_by_hand import LIGHT, tiny_sample, tiny_scene

FINITE = np.arange(0x7C00, dtype=np.uint16).view(np.float16)
"""Every half float from 0 to 65504."""
SMALLEST = float(FINITE[1])


def _spike(resolution: int) -> NDArray[np.float32]:
    picture = np.zeros((resolution, resolution, 3), np.float32)
    picture[resolution // 2, resolution // 2] = HALF_FLOAT_MAX
    return picture


def _any_halfs(resolution: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return rng.choice(FINITE, (resolution, resolution, 3)).astype(np.float32)


def _denormals(resolution: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(0)
    return rng.choice(FINITE[:1024], (resolution, resolution, 3)).astype(np.float32)


PICTURES: dict[str, Callable[[int], NDArray[np.float32]]] = {
    "zeros": lambda resolution: np.zeros((resolution, resolution, 3), np.float32),
    "brightest": lambda r: np.full((r, r, 3), HALF_FLOAT_MAX, np.float32),
    "one brightest pixel": _spike,
    "all half floats": _any_halfs,
    "denormals": _denormals,
    "smallest": lambda resolution: np.full((resolution, resolution, 3), SMALLEST, np.float32),
}


RESOLUTIONS = (1, 8, 9, 33, 72)
every_picture = pytest.mark.parametrize("make", PICTURES.values(), ids=PICTURES.keys())


@every_picture
def test_without_loss_every_half_float_comes_back(
    make: Callable[[int], NDArray[np.float32]],
) -> None:
    for resolution in RESOLUTIONS:
        picture = make(resolution)
        back = decode_exr(pack_picture(picture, 40.0, "lossless"))
        np.testing.assert_array_equal(back, picture, err_msg=f"{resolution} pixels")


@every_picture
def test_compact_keeps_the_law_or_loses_nothing(make: Callable[[int], NDArray[np.float32]]) -> None:
    """DWA turns the brightest half floats into infinity and zeros below 0: neither gets out."""
    for resolution in RESOLUTIONS:
        picture = make(resolution)
        for floor_db in (10.0, 45.0, 80.0, 90.0):
            _check_compact(picture, floor_db, f"{resolution} pixels, {floor_db} dB")


def test_a_compact_picture_of_two_chunks_keeps_the_law_or_loses_nothing() -> None:
    """A chunk of DWAB is 256 lines."""
    _check_compact(_denormals(264), 45.0, "264 pixels")


def _check_compact(picture: NDArray[np.float32], floor_db: float, case: str) -> None:
    back = decode_exr(pack_picture(picture, floor_db, "compact"))
    assert np.isfinite(back).all(), case
    assert (back >= 0).all(), case
    assert np.array_equal(back, picture) or keeps_law(picture, back, floor_db), case


@pytest.mark.parametrize("profile", PROFILES)
def test_what_no_picture_may_hold_is_refused(profile: Profile) -> None:
    for value in (np.nan, np.inf, -np.inf, -SMALLEST, 65520.0):
        picture = np.ones((8, 8, 3), np.float32)
        picture[7, 0, 2] = value
        with pytest.raises(TrilightError, match=r"radiance\[7, 0, 2\]"):
            pack_picture(picture, 40.0, profile)


def test_rounding_to_half_floats_is_the_only_loss() -> None:
    """Values between two half floats go to the nearer: 2^-11 of the value, or half of 6e-8."""
    exponents = np.random.default_rng(0).uniform(-9, 4.8, (64, 64, 3))
    picture = (10.0**exponents).astype(np.float32)
    back = decode_exr(encode_exr(picture))
    assert (np.abs(back - picture) <= np.maximum(picture * 2.0**-11, SMALLEST / 2)).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_a_scene_of_extreme_numbers_is_packed_exactly(profile: Profile) -> None:
    scene = tiny_scene()
    ends = np.finfo(np.float32)
    scene.vertex_positions[0] = np.array([MAX_POSITION_M, ends.tiny, -0.0], np.float32)
    scene.materials[LIGHT, EMISSION] = [1e38, 1e-45, 0]
    sample = dataclasses.replace(tiny_sample(), scene=scene)
    back = decode_sample("0", encode_sample(sample, profile)).scene
    assert back.vertex_positions.tobytes() == scene.vertex_positions.tobytes()
    assert back.materials.tobytes() == scene.materials.tobytes()


@pytest.mark.parametrize("emission", [65504.0, SMALLEST])
def test_the_ends_of_half_floats_go_through_hdf5(tmp_path: Path, emission: float) -> None:
    scene = tiny_scene()
    scene.materials[LIGHT, EMISSION] = emission
    pictures = np.stack([_spike(8), _any_halfs(8)])
    write_renderformer_h5(tmp_path / "a.h5", scene, pictures, texture_type="float16")
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


def _counted_to_the_end() -> Scene:
    """65536 materials and objects, and vertex rows beyond 16 bits."""
    scene, count = tiny_scene(), 1 << 16
    materials = np.repeat(scene.materials[[0]], count, axis=0)
    materials[-1] = scene.materials[LIGHT]
    shells = tuple(SceneObject(name=f"part{row}", kind="shell") for row in range(count - 1))
    positions, normals = (
        np.concatenate([np.repeat(array[:1], count, axis=0), array])
        for array in (scene.vertex_positions, scene.vertex_normals)
    )
    last = np.array([0, count - 2, count - 1], np.uint16)
    return dataclasses.replace(
        scene,
        vertex_positions=positions,
        vertex_normals=normals,
        faces=scene.faces + np.uint32(count),
        material_index=last,
        object_index=last,
        materials=materials,
        objects=(*shells, SceneObject(name="light", kind="emitter")),
    )


def test_the_ends_of_integers_are_packed_exactly() -> None:
    """65536 of each: the last row is 65535, the greatest that 16 bits hold."""
    scene = _counted_to_the_end()
    scene.check()
    sample = dataclasses.replace(tiny_sample(), scene=scene)
    for profile in PROFILES:
        back = decode_sample("0", encode_sample(sample, profile)).scene
        for name in ("faces", "material_index", "object_index"):
            found, wanted = getattr(back, name), getattr(scene, name)
            case = f"{name}, {profile}"
            assert found.dtype == wanted.dtype and np.array_equal(found, wanted), case
        assert back.objects == scene.objects, profile


NUMBERS = {
    "seed": 2**256 - 1, "far": -(2**64), "least": 5e-324, "largest": 1.7976931348623157e308,
    "zero": -0.0, "third": 1 / 3,
}  # fmt: skip


def test_numbers_of_json_come_back_digit_by_digit(tmp_path: Path) -> None:
    """Of provenance, in samples and in USD, and of settings: also integers beyond 64 bits."""
    scene = tiny_scene(provenance=NUMBERS)
    sample = dataclasses.replace(tiny_sample(), scene=scene)
    back = decode_sample("0", encode_sample(sample)).scene.provenance
    assert json.dumps(dict(back), sort_keys=True) == json.dumps(NUMBERS, sort_keys=True)
    for suffix in (".usda", ".usdc"):
        assert_usd_keeps_all(scene, tmp_path, suffix)
    build = named_build("smoke", seed=2**256 - 1)
    assert json.loads(json.dumps(build.as_json()))["seed"] == 2**256 - 1


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_json_holds_no_number_that_is_none(value: float) -> None:
    sample = dataclasses.replace(tiny_sample(), scene=tiny_scene(provenance={"value": value}))
    with pytest.raises(ValueError, match="JSON compliant"):
        encode_sample(sample)


HEADER = [
    ("most", 2**31 - 1), ("least", -(2**31)), ("float", float(np.finfo(np.float32).max)),
    ("text", str(2**256 - 1)),
]  # fmt: skip


def test_the_ends_of_numbers_go_through_the_header_of_a_picture() -> None:
    for name, value in HEADER:
        data = encode_exr(np.ones((8, 8, 3), np.float32), attributes={name: value})  # type: ignore[dict-item]
        header = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).header()
        assert header[name] == value, name


def test_numbers_beyond_a_header_are_refused() -> None:
    """OpenEXR would write 2^31 as -2^31, 1e39 as infinity, and raise SystemError for 2^64."""
    for value in (2**31, -(2**31) - 1, 2**64, 1e39, -1e39, math.inf, math.nan):
        with pytest.raises(TrilightError, match="attribute seed is .*; expected a number from -"):
            encode_exr(np.ones((8, 8, 3), np.float32), attributes={"seed": value})
