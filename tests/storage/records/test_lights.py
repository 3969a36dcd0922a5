"""Pictures by light: they come back exactly, and their sum is the picture, as verify demands."""

import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.dataset.manifest import Manifest
from storage.dataset.shard import write_shard
from storage.dataset.verify import check_sample
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import (
    MAX_LIGHTS,
    decode_lights_exr,
    encode_lights_exr,
    rounded_to_half,
    sum_of_lights,
)
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import SceneObject
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_sample, tiny_scene


def _lights(count: int, resolution: int = 16, seed: int = 0) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    radiance = rng.exponential(size=(count, resolution, resolution, 3)) * 10.0 ** rng.uniform(-4, 3)
    return rounded_to_half(radiance.astype(np.float32))


def _sample(changes: Mapping[str, Any] | None = None) -> Sample:
    """Return the tiny sample with two lights, the second without a triangle of its own."""
    made = tiny_sample()
    objects = (*made.scene.objects, SceneObject(name="light 2", kind="emitter"))
    scene = tiny_scene(objects=objects)
    lights = np.stack([_lights(2, seed=view) for view in range(2)])
    pictures = np.stack([sum_of_lights(view) for view in lights])
    whole = dataclasses.replace(made, scene=scene, lights_rgb=lights, radiance_rgb=pictures)
    return dataclasses.replace(whole, **(changes or {}))


def _manifest(**renders: Any) -> Manifest:
    return Manifest(
        build="x",
        settings={"renders": {"resolution": 16, **renders}},
        environment={},
        num_scenes=1,
        num_views=2,
        objects_lock_sha256="",
        shards=(),
    )


def _faults(sample: Sample, **renders: Any) -> list[str]:
    return list(check_sample(sample, "train", _manifest(**renders), {}))


@for_each("count", [1, 2, 8, MAX_LIGHTS])
def test_lights_come_back_exactly_and_in_order(count: int) -> None:
    lights = _lights(count)
    back = decode_lights_exr(encode_lights_exr(lights), (count, 16, 16))
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, lights)
    assert encode_lights_exr(lights) == encode_lights_exr(back)


def test_any_reader_finds_the_channels_by_name() -> None:
    lights = _lights(12)
    file = OpenEXR.File(io.BytesIO(encode_lights_exr(lights)), separate_channels=True)
    names = {f"light{i}.{name}" for i in range(12) for name in "RGB"}
    assert set(file.channels()) == names
    np.testing.assert_array_equal(file.channels()["light11.G"].pixels, lights[11, ..., 1])


def test_the_stored_sum_is_exact() -> None:
    """Lights and picture, each through its own file: the sum of the one is the other, bitwise."""
    for seed in range(5):
        lights = _lights(7, seed=seed)
        picture = decode_exr(encode_exr(sum_of_lights(lights)))
        back = decode_lights_exr(encode_lights_exr(lights), (7, 16, 16))
        np.testing.assert_array_equal(sum_of_lights(back), picture)
        # one rounding to half floats of the exact sum, and seven to float32
        exact = lights.astype(np.float64).sum(axis=0)
        np.testing.assert_allclose(picture, exact, rtol=2**-11 + 7 * 2**-24, atol=6e-8)


def test_a_sum_beyond_half_floats_is_seen() -> None:
    lights = np.full((2, 8, 8, 3), HALF_FLOAT_MAX * 0.6, np.float32)
    assert np.isinf(sum_of_lights(rounded_to_half(lights))).all()


@for_each("shape", [(3, 16, 16), (2, 8, 16), (2, 16, 24), (MAX_LIGHTS + 1, 16, 16)])
def test_another_shape_is_refused(shape: tuple[int, int, int]) -> None:
    with pytest.raises(
        TrilightError, match="lights: |channels are light0.B, .*; expected light0.B"
    ):
        decode_lights_exr(encode_lights_exr(_lights(2)), shape)


@for_each("keep", [0, 10, 300, -100])
def test_a_truncated_file_is_refused(keep: int) -> None:
    data = encode_lights_exr(_lights(2, 64))
    with pytest.raises(TrilightError, match="picture"):
        decode_lights_exr(data[:keep], (2, 64, 64))


def test_another_window_is_refused_before_it_is_allocated() -> None:
    data = bytearray(encode_lights_exr(_lights(2)))
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[at + 8 : at + 16] = (1_000_000).to_bytes(4, "little") * 2
    with pytest.raises(TrilightError, match=r"^lights: \[1000001, 1000001\] pixels"):
        decode_lights_exr(bytes(data), (2, 16, 16))


def test_a_sample_with_lights_comes_back() -> None:
    sample = _sample()
    members = encode_sample(sample)
    assert {"0.lights.exr", "1.lights.exr"} <= set(members)
    back = decode_sample(sample.key, members)
    assert back.lights_rgb is not None
    np.testing.assert_array_equal(back.lights_rgb, sample.lights_rgb)
    assert back.lights_rgb.shape == (2, 2, 16, 16, 3)
    del members["1.lights.exr"]
    with pytest.raises(TrilightError, match="1.lights.exr.*missing"):
        decode_sample(sample.key, members)
    assert decode_sample("000000000", encode_sample(tiny_sample())).lights_rgb is None


def test_stock_webdataset_reads_the_names(tmp_path: Path) -> None:
    import webdataset

    sample = _sample()
    write_shard(tmp_path / "train-000000.tar", [(sample.key, encode_sample(sample))])
    (read,) = webdataset.WebDataset(str(tmp_path / "train-000000.tar"), shardshuffle=False)
    assert read["__key__"] == sample.key
    assert {"0.exr", "0.lights.exr", "1.exr", "1.lights.exr"} <= set(read)


def test_verify_demands_the_sum() -> None:
    sample = _sample()
    assert _faults(sample, per_light=True) == []
    assert _faults(tiny_sample()) == []  # a manifest from before there was the setting
    assert "has pictures by light" in _faults(sample, per_light=False)[0]
    without = _sample({"lights_rgb": None})
    assert "lacks pictures by light" in _faults(without, per_light=True)[0]
    pictures = sample.radiance_rgb.copy()
    pictures[1, 3, 5, 2] = np.nextafter(np.float16(pictures[1, 3, 5, 2]), np.float16(np.inf))
    (fault,) = _faults(_sample({"radiance_rgb": pictures}), per_light=True)
    assert "view 1 is not the sum of its lights in 1 pixels, first in (3, 5)" in fault
