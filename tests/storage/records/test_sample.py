"""A sample comes back from its members exactly, and damaged members are named."""

import io
import json

import numpy as np
import OpenEXR
import pytest

from storage.conventions import SCHEMA_VERSION
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_sample


def test_round_trip_is_exact() -> None:
    sample = tiny_sample()
    back = decode_sample(sample.key, encode_sample(sample))
    for name in ARRAY_FIELDS:
        before, after = getattr(sample.scene, name), getattr(back.scene, name)
        assert before.dtype == after.dtype
        assert np.array_equal(before, after)
    assert back.scene.objects == sample.scene.objects
    assert back.scene.provenance == sample.scene.provenance
    assert back.views == sample.views
    assert np.array_equal(back.radiance_rgb, sample.radiance_rgb)


def test_equal_samples_give_equal_bytes() -> None:
    assert encode_sample(tiny_sample()) == encode_sample(tiny_sample())


@for_each("suffix", ["json", "scene.safetensors", "1.exr"])
def test_a_missing_member_is_named(suffix: str) -> None:
    members = encode_sample(tiny_sample())
    del members[suffix]
    with pytest.raises(TrilightError, match=f"{suffix}.*missing"):
        decode_sample("000000000", members)


@for_each("version", [None, 1, 99, "2", [2]])
def test_another_schema_version_is_refused(version: object) -> None:
    members = encode_sample(tiny_sample())
    record = json.loads(members["json"])
    members["json"] = json.dumps({**record, "schema_version": version}).encode()
    with pytest.raises(
        TrilightError, match=r"version .*; this Trilight reads 2, 3 and 4.*generate"
    ):
        decode_sample("000000000", members)


def test_version_2_is_read() -> None:
    """Its members are those of the profile `lossless`."""
    sample = tiny_sample()
    members = encode_sample(sample, "lossless")
    record = json.loads(members["json"])
    assert record["schema_version"] == SCHEMA_VERSION == 3
    members["json"] = json.dumps({**record, "schema_version": 2}).encode()
    back = decode_sample(sample.key, members)
    assert np.array_equal(back.radiance_rgb, sample.radiance_rgb)


def test_safetensors_header_bomb_is_refused() -> None:
    members = encode_sample(tiny_sample())
    members["scene.safetensors"] = (1 << 60).to_bytes(8, "little") + b"{}"
    with pytest.raises(TrilightError, match="header claims"):
        decode_sample("000000000", members)


def test_half_floats_keep_eleven_bits() -> None:
    rng = np.random.default_rng(0)
    picture = (rng.random((24, 16, 3)) * 1000).astype(np.float32)
    back = decode_exr(encode_exr(picture))
    # a half float has 11 significant bits, so rounding is at most 2^-11 of the value
    assert (abs(back - picture) <= picture * 2**-11).all()


@for_each("compression", ["ZIP", "DWAB"])
def test_float32_pictures_of_other_tools_are_read(compression: str) -> None:
    """Exact values that half floats do not hold; below 0 only where the codec put them there."""
    picture = np.full((16, 16, 3), 1.00001, np.float32)
    picture[8, 8] = -1.0
    codec = getattr(OpenEXR, f"{compression}_COMPRESSION")
    stream = io.BytesIO()
    header = {"compression": codec, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": picture}, num_threads=0).write(stream)
    back = decode_exr(stream.getvalue())
    assert back.dtype == np.float32
    if compression == "ZIP":
        assert np.array_equal(back, picture)
    else:
        assert (back >= 0).all()


@for_each("value", [np.nan, np.inf, -1e-6, 65505.0])
def test_what_a_half_float_cannot_hold_is_refused(value: float) -> None:
    picture = np.zeros((8, 8, 3), np.float32)
    picture[3, 2, 1] = value
    with pytest.raises(TrilightError, match=r"radiance\[3, 2, 1\]"):
        encode_exr(picture)


@for_each("keep", [0, 10, 300, -100])
def test_a_truncated_picture_is_refused(keep: int) -> None:
    data = encode_exr(np.random.default_rng(0).random((64, 64, 3)).astype(np.float32))
    with pytest.raises(TrilightError, match="picture"):
        decode_exr(data[:keep])


def test_an_enormous_window_is_refused_before_it_is_allocated() -> None:
    data = bytearray(encode_exr(np.zeros((16, 16, 3), np.float32)))
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[at + 8 : at + 16] = (1_000_000).to_bytes(4, "little") * 2
    with pytest.raises(TrilightError, match="data window spans|not a readable"):
        decode_exr(bytes(data))
