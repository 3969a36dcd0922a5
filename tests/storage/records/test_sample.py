"""A sample comes back from its members in every profile; damaged and hostile ones are named.

A process of its own reads pictures that speak of too many pixels, and says how much memory it took.
"""

import dataclasses
import gzip
import io
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from storage.conventions import SCHEMA_VERSION
from storage.dataset.dataset import open_dataset
from storage.dataset.statistics import dataset_statistics
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr, encode_channels, encode_exr
from storage.records.lights import ALL_LIGHT, MAX_LIGHTS, decode_parts_exr, encode_parts_exr
from storage.records.profiles import (
    DWA_LEVELS,
    LAW_DB,
    PROFILES,
    Profile,
    keeps_law,
    pack_arrays,
    pack_picture,
    unpack_arrays,
)
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene_file import encode_scene
from tests.command_line import run_program
from tests.for_each import case, for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes
from tests.scenes_by_hand import tiny_sample
from tests.storage.dataset.test_verify import replace_shard


@for_each("profile", PROFILES)
def test_round_trip_is_exact(profile: Profile) -> None:
    """But for the pictures of the compact profile."""
    sample = tiny_sample()
    members = encode_sample(sample, profile)
    assert members == encode_sample(tiny_sample(), profile)
    back = decode_sample(sample.key, members)
    assert encode_scene(back.scene) == encode_scene(sample.scene)
    assert back.views == sample.views
    if profile == "lossless":
        assert np.array_equal(back.radiance_rgb, sample.radiance_rgb)


def test_a_missing_member_and_another_schema_version_are_refused() -> None:
    """Version 2 is read: its members are those of the profile `lossless`."""
    sample = tiny_sample()
    members = encode_sample(sample)
    for suffix in ("json", "scene.safetensors", "1.exr"):
        with pytest.raises(TrilightError, match=f"{suffix}.*missing"):
            decode_sample(sample.key, {k: v for k, v in members.items() if k != suffix})
    record = json.loads(members["json"])
    assert record["schema_version"] == SCHEMA_VERSION == 3
    for version in (None, 1, 99, "2", 2):
        members["json"] = json.dumps({**record, "schema_version": version}).encode()
        if version == 2:
            back = decode_sample(sample.key, members)
            assert np.array_equal(back.radiance_rgb, sample.radiance_rgb)
            continue
        with pytest.raises(TrilightError, match=r"version .*; this Trilight reads 2, 3 and 4.*gen"):
            decode_sample(sample.key, members)


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


def noisy_picture(noise_db: float, resolution: int = 64) -> NDArray[np.float32]:
    """Return a bright disc on black, with noise of that floor where it is not black."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:resolution, :resolution] / resolution - 0.5
    disc = ((x**2 + y**2) < 0.16)[..., None]
    clean = (3 + 2 * x + np.sin(9 * y))[..., None] * np.array([1.0, 0.8, 0.5])
    rms = 10 ** (-noise_db / 20) / np.sqrt(disc.mean())
    noisy = 10 ** (np.log10(1 + clean) + rms * rng.standard_normal(clean.shape)) - 1
    return np.where(disc, np.maximum(noisy, 0), 0).astype(np.float32)


@for_each(("floor_db", "level"), [(20.0, 200), (40.0, 100), (45.0, None), (85.0, None)])
def test_the_law_of_the_tenth(floor_db: float, level: float | None) -> None:
    """The coarsest level that keeps it, where that is smaller; otherwise nothing is lost."""
    picture = noisy_picture(floor_db)
    data = pack_picture(picture, floor_db, "compact")
    exact = encode_exr(picture)
    if level is None:
        assert data == exact
        return
    back = decode_exr(data)
    assert psnr_log_db(picture, back) >= floor_db + LAW_DB
    assert (back >= 0).all()
    assert data == encode_exr(picture, level)
    assert len(data) < len(exact)
    for coarser in [tried for tried in DWA_LEVELS if tried > level]:
        stored = encode_exr(picture, coarser)
        assert not keeps_law(picture, decode_exr(stored), floor_db)


def test_the_law_means_a_tenth_of_the_mean_square() -> None:
    """0.41 dB is what a tenth more noise costs: 10 log10 1.1. What is not finite never keeps it."""
    picture = np.full((16, 16, 3), 9.0, np.float32)  # log10(1 + 9) = 1
    for excess_db, kept in ((9.9, False), (10.1, True)):
        rms = 10 ** (-(40 + excess_db) / 20)
        assert keeps_law(picture, (10 ** (1 + rms) - 1) * np.ones_like(picture), 40.0) == kept
    for wrong in (np.nan, np.inf):
        stored = picture.copy()
        stored[0, 0, 0] = wrong
        assert not keeps_law(picture, stored, 1.0)


@for_each("floor_db", [91.0, 100.0, np.nan, np.inf])
def test_a_floor_that_nothing_can_beat_is_packed_without_loss(floor_db: float) -> None:
    picture = noisy_picture(30.0)
    assert pack_picture(picture, floor_db, "compact") == encode_exr(picture)


def test_each_view_has_its_own_floor() -> None:
    sample = tiny_sample(resolution=64)
    views = tuple(
        dataclasses.replace(view, noise_floor_db=floor)
        for view, floor in zip(sample.views, (20.0, 95.0), strict=True)
    )
    back = decode_sample("0", encode_sample(dataclasses.replace(sample, views=views), "compact"))
    assert not np.array_equal(back.radiance_rgb[0], sample.radiance_rgb[0])
    assert np.array_equal(back.radiance_rgb[1], sample.radiance_rgb[1])


def test_the_digest_of_scenes_does_not_know_the_profile(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    before = dataset_statistics(dataset)
    for shard in dataset.manifest.shards:
        samples = list(dataset.read_shard(shard))
        packed = [(sample.key, encode_sample(sample, "compact")) for sample in samples]
        replace_shard(dataset, shard.name, packed)
    after = open_dataset(str(edit_manifest(dataset)))
    assert dataset_statistics(after).scene_digest == before.scene_digest
    assert after.manifest.dataset_digest != dataset.manifest.dataset_digest
    (first, *_) = after.manifest.shards
    assert len(list(after.read_scenes(first))) == first.num_samples


def test_hostile_arrays_are_refused_and_a_bomb_before_it_goes_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a member that inflates beyond the limit nothing more than the limit is unpacked."""
    plain = b"the arrays of a scene" * 100
    for members, message in [
        ({}, "is missing"),
        ({"scene.safetensors": plain, **pack_arrays(plain, "compact")}, "there in two forms"),
        ({"scene.safetensors.gz": plain}, "damaged"),
        ({"scene.safetensors.gz": gzip.compress(plain)[:-9]}, "cut short"),
        ({"scene.safetensors.gz": gzip.compress(plain)[:-8] + b"\0" * 8}, "damaged"),
        ({"scene.safetensors.gz": gzip.compress(plain) * 2}, "after its end"),
    ]:
        with case(message), pytest.raises(TrilightError, match=message):
            unpack_arrays(members)
    monkeypatch.setattr("storage.records.profiles.MAX_ARRAY_BYTES", 1 << 20)
    bomb = gzip.compress(bytes((1 << 20) + 1))
    assert len(bomb) < 2000
    with pytest.raises(TrilightError, match="holds more than 1048576"):
        unpack_arrays({"scene.safetensors.gz": bomb})
    assert len(unpack_arrays({"scene.safetensors.gz": gzip.compress(bytes(1 << 20))})) == 1 << 20


_SIZE = 2048
"""A plane of half floats takes 8 MiB, and in a file of zeros 9 kB."""

_MOST_GROWTH_MB = 24
"""Reading the headers alone took 1 MB here; three planes would take 24 and their copy 48."""

_CHILD = """
import resource, sys
from pathlib import Path
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.records.lights import decode_parts_exr
for path, read_as in zip(sys.argv[1::2], sys.argv[2::2]):
    data = Path(path).read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        decode_exr(data) if read_as == "picture" else decode_parts_exr(data, [""], (2048, 2048), 2)
    except TrilightError as error:
        print(error)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(grown // 1024)
"""


def _planes(names: list[str]) -> dict[str, np.ndarray]:
    return dict.fromkeys(names, np.zeros((_SIZE, _SIZE), np.float16))


def _halves(*names: str) -> bytes:
    return encode_channels(_planes(list(names)))


def _second_part() -> bytes:
    small = {"RGB": np.zeros((8, 8, 3), np.float16)}
    shown = (np.array([0, 0], np.int32), np.array([_SIZE - 1, _SIZE - 1], np.int32))
    parts = [
        OpenEXR.Part({"displayWindow": shown}, small, "a"),
        OpenEXR.Part({"displayWindow": shown}, _planes(["R", "G", "B"]), "b"),
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts, num_threads=0).write(stream)
    return stream.getvalue()


def _deep_pixels() -> bytes:
    """Return a file of 64 pixels, each of which holds 100,000 values of each channel."""
    deep = np.full((8, 8), None, object)
    for pixel in np.ndindex(8, 8):
        deep[pixel] = np.zeros(100_000, np.float16)
    stream = io.BytesIO()
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", deep), num_threads=0).write(stream)
    return stream.getvalue()


MANY = [f"c{i}" for i in range(16)]
HOSTILE_EXR: list[tuple[Callable[[], bytes], str, str]] = [
    (lambda: _halves(*"RGB", *MANY[3:]), "picture", "expected B, G, R."),
    (lambda: _halves(*MANY), "picture", "channels are c0, c1, c10, c11, c12, c13 and 10 more"),
    (lambda: _halves(*MANY), "lights", "expected light0.B"),
    (_second_part, "picture", "the file has 2 parts; expected one"),
    (_deep_pixels, "picture", "deepscanline; expected lines or tiles"),
]


def test_what_is_not_expected_takes_no_memory(tmp_path: Path) -> None:
    """Not even the most that a process ever took: so one process may read all of them."""
    words: list[str] = []
    for number, (made, read_as, _) in enumerate(HOSTILE_EXR):
        path = tmp_path / f"{number}.exr"
        path.write_bytes(made())
        words += [str(path), read_as]
    lines = run_program([sys.executable, "-c", _CHILD, *words]).stdout.splitlines()
    assert len(lines) == 2 * len(HOSTILE_EXR)
    for (_, _, said), message, grown_mb in zip(HOSTILE_EXR, lines[::2], lines[1::2], strict=True):
        assert said in message
        assert int(grown_mb) < _MOST_GROWTH_MB, message


def _with_window(data: bytes, height: int, width: int) -> bytes:
    """Return a file whose header speaks of so many pixels; those of the file stay as they are."""
    key = b"dataWindow\0box2i\0"
    at = data.index(key) + len(key) + 4
    return data[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + data[at + 16 :]


def test_bytes_are_bounded_by_what_is_expected() -> None:
    lights = encode_parts_exr({ALL_LIGHT: np.zeros((MAX_LIGHTS, 8, 8, 3), np.float32)})

    def decode(side: int, expected: int) -> None:
        data = _with_window(lights, side, side)
        decode_parts_exr(data, (ALL_LIGHT,), (expected, expected), MAX_LIGHTS)

    with pytest.raises(
        TrilightError, match=r"192 channels of \[4096, 4096\] pixels may take 128849"
    ):
        decode(4096, 4096)
    # What the renderer writes at most is not refused for its size, but for its missing pixels.
    with pytest.raises(TrilightError, match="not a readable OpenEXR file|a channel is no"):
        decode(2048, 2048)
    with pytest.raises(TrilightError, match=r"^lights: \[1000001, 1000001\] pixels"):
        decode(1_000_001, 8)
    picture = encode_exr(np.zeros((16, 16, 3), np.float32))
    with pytest.raises(TrilightError, match="data window spans|not a readable"):
        decode_exr(_with_window(picture, 1_000_001, 1_000_001))
