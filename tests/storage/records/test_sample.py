"""A sample comes back from its members in every profile; damaged and hostile ones are named.

A process of its own reads pictures that speak of too many pixels, and says how much memory it took.
Pictures by light and by part: they come back exactly, and their sum is the picture.
"""

import dataclasses
import gzip
import io
import itertools
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX, SCHEMA_VERSION
from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import Manifest
from storage.dataset.statistics import dataset_statistics
from storage.dataset.verify import check_sample
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr, encode_channels, encode_exr
from storage.records.lights import (
    ALL_LIGHT,
    KNOWN_PARTS,
    MAX_LIGHTS,
    decode_parts_exr,
    encode_parts_exr,
    light_sources,
    num_lights,
    part_names,
    rounded_to_half,
    sum_of_lights,
    sum_of_parts,
)
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
from storage.records.sample import PictureErrors, Sample, decode_sample, decode_scene, encode_sample
from storage.records.scene import SceneObject
from storage.records.scene_file import encode_scene
from tests.command_line import run_program
from tests.for_each import case, for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes
from tests.scenes_by_hand import tiny_sample, tiny_scene
from tests.sky_maps import constant
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


def test_what_a_half_float_cannot_hold_and_a_truncated_picture_are_refused() -> None:
    picture = np.zeros((8, 8, 3), np.float32)
    for value in (np.nan, np.inf, -1e-6, 65505.0):
        picture[3, 2, 1] = value
        with case(value), pytest.raises(TrilightError, match=r"radiance\[3, 2, 1\]"):
            encode_exr(picture)
    data = encode_exr(np.random.default_rng(0).random((64, 64, 3)).astype(np.float32))
    for keep in (0, 10, 300, -100):
        with case(keep), pytest.raises(TrilightError, match="picture"):
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


@for_each(
    ("noise_db", "floor_db", "level"),
    [(20.0, 20.0, 200), (40.0, 40.0, 100), (45.0, 45.0, None), (85.0, 85.0, None)]
    + [(30.0, unbeatable_db, None) for unbeatable_db in (91.0, 100.0, np.nan, np.inf)],
)
def test_the_law_of_the_tenth(noise_db: float, floor_db: float, level: float | None) -> None:
    """The coarsest level that keeps it, where that is smaller; otherwise nothing is lost."""
    picture = noisy_picture(noise_db)
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


def test_hostile_arrays_and_bombs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
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


SIZE = (16, 16)


def _noise(*shape: int, seed: Any = 0) -> NDArray[np.float32]:
    """Return light [..., 3] in half floats, of any size."""
    rng = np.random.default_rng(seed)
    radiance = rng.exponential(size=(*shape, 3)) * 10.0 ** rng.uniform(-4, 3)
    return rounded_to_half(radiance.astype(np.float32))


def _lit_sample(**changes: Any) -> Sample:
    """Return the tiny sample with two lights, the second without a triangle of its own."""
    made = tiny_sample()
    objects = (*made.scene.objects, SceneObject(name="light 2", kind="emitter"))
    lights = np.stack([_noise(2, *SIZE, seed=view) for view in range(2)])
    fields: dict[str, Any] = {
        "scene": tiny_scene(objects=objects),
        "lights_rgb": lights,
        "radiance_rgb": np.stack([sum_of_lights(view) for view in lights]),
    }
    return dataclasses.replace(made, **fields | changes)


def test_a_sky_is_one_more_light_of_a_sample() -> None:
    scene = dataclasses.replace(_lit_sample().scene, environment=constant(0.5))
    assert len(light_sources(scene)) == 3 and num_lights(scene) == 2
    lights = rounded_to_half(np.stack([_noise(3, *SIZE), _noise(3, *SIZE)]))
    pictures = np.stack([sum_of_lights(view) for view in lights])
    views = [dataclasses.replace(view, lights=(FLOOR,) * 3) for view in _lit_sample().views]
    whole = _lit_sample(scene=scene, lights_rgb=lights, radiance_rgb=pictures, views=tuple(views))
    members = encode_sample(whole)
    back = decode_sample(whole.key, members)
    np.testing.assert_array_equal(back.lights_rgb, lights)
    assert back.views == whole.views
    assert faults(back, per_light=True) == []
    fewer = [dataclasses.replace(view, lights=(FLOOR,)) for view in views]
    (first, second) = faults(dataclasses.replace(back, views=tuple(fewer)), per_light=True)
    assert "view 0 has 1 stated errors of lights; expected 3" in first and "view 1" in second
    del members["1.lights.exr"]
    with pytest.raises(TrilightError, match="1.lights.exr.*missing"):
        decode_sample(whole.key, members)


def _one_bit_off(sample: Sample) -> Sample:
    pictures = sample.radiance_rgb.copy()
    pictures[1, 3, 5, 2] = np.nextafter(np.float16(pictures[1, 3, 5, 2]), np.float16(np.inf))
    return dataclasses.replace(sample, radiance_rgb=pictures)


def test_verify_demands_the_sums_of_lights_and_of_parts() -> None:
    sample = _lit_sample()
    assert faults(sample, per_light=True) == []
    assert faults(tiny_sample()) == []  # a manifest from before there was the setting
    assert "has pictures by light" in faults(sample, per_light=False)[0]
    without = _lit_sample(lights_rgb=None)
    assert "lacks pictures by light" in faults(without, per_light=True)[0]
    (fault,) = faults(_one_bit_off(sample), per_light=True)
    assert "view 1 is not the sum of its lights in 1 pixels, first in (3, 5)" in fault
    sample = _sample()
    assert "parts are direct, indirect; the settings" in faults(sample)[0]
    assert "every view expect diffuse, specular" in faults(sample, split_lobes=True)[0]
    assert "parts are none" in faults(tiny_sample(), split=True)[0]
    views = (sample.views[0], dataclasses.replace(sample.views[1], parts=None))
    assert faults(dataclasses.replace(sample, views=views), split=True)
    (fault,) = faults(_one_bit_off(sample), split=True)
    assert "view 1 has a picture that is not the sum of its parts in 1 pixels" in fault
    assert fault.endswith("first in (3, 5)")
    both = _sample(lights=True)
    assert both.parts_rgb is not None
    wrong = {name: 2 * part for name, part in both.parts_rgb.items()}
    found = faults(dataclasses.replace(both, parts_rgb=wrong), split=True, per_light=True)
    assert len(found) == 2 and "a light that is not the sum" in found[0]


FLOOR = PictureErrors(noise_floor_db=40.5, noise_floor_linear_db=30.25, object_noise_floor_db=39.0)
RENDERS = {
    ("direct", "indirect"): {"split": True},
    ("diffuse", "specular"): {"split_lobes": True},
    ("diffuse_direct", "diffuse_indirect", "specular_direct", "specular_indirect"): {
        "split": True,
        "split_lobes": True,
    },
}


def _parts(
    names: tuple[str, ...], shape: tuple[int, ...], seed: int = 0
) -> dict[str, NDArray[np.float32]]:
    return {name: _noise(*shape, seed=(seed, row)) for row, name in enumerate(names)}


def _sample(names: tuple[str, ...] = KNOWN_PARTS[0], *, lights: bool = False) -> Sample:
    """Return the tiny sample by parts; with its only light apart where that is asked for."""
    made = tiny_sample()
    parts = _parts(names, (2, 1, *SIZE) if lights else (2, *SIZE))
    apart = sum_of_parts(parts)
    return dataclasses.replace(
        made,
        parts_rgb=parts,
        lights_rgb=apart if lights else None,
        radiance_rgb=np.stack([sum_of_lights(view) for view in apart]) if lights else apart,
        views=tuple(
            dataclasses.replace(view, parts=dict.fromkeys(names, FLOOR)) for view in made.views
        ),
    )


def faults(sample: Sample, *passes: str, **renders: Any) -> list[str]:
    """Return what is wrong with a sample of a dataset with these settings."""
    storage = {"storage": {"passes": list(passes)}} if passes else {}
    manifest = Manifest(
        build="x",
        settings={"renders": {"resolution": 16, **renders}, **storage},
        environment={},
        num_scenes=1,
        num_views=2,
        objects_lock_sha256="",
        shards=(),
    )
    return list(check_sample(sample, "train", manifest, {}))


def test_the_names_are_those_of_other_renderers_in_alphabetical_order() -> None:
    """A record is JSON with sorted keys: the order of the sum must survive it."""
    assert part_names(bounces=False, lobes=False) == ()
    assert set(KNOWN_PARTS) == set(RENDERS)
    for names in KNOWN_PARTS:
        assert names == tuple(sorted(names))


@for_each(
    ("names", "lights"),
    [*(((ALL_LIGHT,), count) for count in (1, 2, 12, MAX_LIGHTS)),
     *itertools.product(KNOWN_PARTS, [None, 1, 3])],
)  # fmt: skip
def test_lights_and_parts_come_back_exactly_and_in_order(
    names: tuple[str, ...], lights: int | None
) -> None:
    parts = _parts(names, SIZE if lights is None else (lights, *SIZE))
    data = encode_parts_exr(parts)
    back = decode_parts_exr(data, names, SIZE, lights)
    assert tuple(back) == names
    for name in names:
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], parts[name])
    assert encode_parts_exr(back) == data
    channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    assert len(channels) == 3 * len(names) * (lights or 1)
    prefix = "" if lights is None else f"light{lights - 1}."
    green = parts[names[-1]] if lights is None else parts[names[-1]][-1]
    layer = f"{prefix}{names[-1]}".strip(".")
    np.testing.assert_array_equal(channels[f"{layer}.G"].pixels, green[..., 1])


@for_each("names", KNOWN_PARTS)
def test_the_stored_sum_is_exact(names: tuple[str, ...]) -> None:
    """Parts or lights and picture, each through its own file: the sum of the one is the other."""
    for seed in range(5):
        parts, lights = _parts(names, SIZE, seed), _noise(7, *SIZE, seed=seed)
        parts_back = decode_parts_exr(encode_parts_exr(parts), names, SIZE, None)
        packed = encode_parts_exr({ALL_LIGHT: lights})
        lights_back = decode_parts_exr(packed, (ALL_LIGHT,), SIZE, 7)[ALL_LIGHT]
        for stored, back, each in (
            (sum_of_parts(parts), sum_of_parts(parts_back), list(parts.values())),
            (sum_of_lights(lights), sum_of_lights(lights_back), list(lights)),
        ):
            picture = decode_exr(encode_exr(stored))
            np.testing.assert_array_equal(back, picture)
            # one rounding to half floats of the exact sum, and one a picture to float32
            exact = np.sum(each, axis=0, dtype=np.float64)
            tolerance = 2**-11 + len(each) * 2**-24
            np.testing.assert_allclose(picture, exact, rtol=tolerance, atol=6e-8)


def test_other_parts_are_refused() -> None:
    data = encode_parts_exr(_parts(KNOWN_PARTS[0], SIZE))
    for names, size, lights, message in [
        (KNOWN_PARTS[1], SIZE, None, "channels are direct.B"),
        (KNOWN_PARTS[0], SIZE, 1, "channels are direct.B"),
        (KNOWN_PARTS[0], (8, 16), None, r"parts: \[16, 16\] pixels; expected \[8, 16\]"),
        (KNOWN_PARTS[0], SIZE, MAX_LIGHTS // 2 + 1, "parts: 66 pictures; expected at most 64"),
        ((ALL_LIGHT,), SIZE, MAX_LIGHTS + 1, "lights: 65 pictures; expected at most 64"),
        ((ALL_LIGHT,), (16, 24), 2, r"lights: \[16, 16\] pixels; expected \[16, 24\]"),
    ]:
        with case(names), pytest.raises(TrilightError, match=message):
            decode_parts_exr(data, names, size, lights)


@for_each("lights", [False, True])
@for_each("names", KNOWN_PARTS)
def test_samples_with_parts_come_back_and_are_verified(
    names: tuple[str, ...], lights: bool
) -> None:
    sample = _sample(names, lights=lights)
    members = encode_sample(sample, "compact")
    back = decode_sample(sample.key, members)
    back.check()
    assert back.parts_rgb is not None and sample.parts_rgb is not None
    assert tuple(back.parts_rgb) == names
    for name in names:
        np.testing.assert_array_equal(back.parts_rgb[name], sample.parts_rgb[name])
    assert [view.parts for view in back.views] == [dict.fromkeys(names, FLOOR)] * 2
    assert faults(back, per_light=lights, **RENDERS[names]) == []
    del members["1.parts.exr"]
    with pytest.raises(TrilightError, match="1.parts.exr.*missing"):
        decode_sample(sample.key, members)


def test_a_sample_without_parts_is_written_as_ever_and_a_record_of_no_parts_is_refused() -> None:
    members = encode_sample(tiny_sample())
    assert not any("parts" in suffix or "lights" in suffix for suffix in members)
    assert all("parts" not in view for view in json.loads(members["json"])["views"])
    back = decode_sample("000000000", members)
    assert back.lights_rgb is back.parts_rgb is None
    assert all(view.parts is None for view in back.views)
    members = encode_sample(_sample())
    record = json.loads(members["json"])
    no_parts: list[Any] = [
        {}, 3, {"direct": {}}, {"direct": vars(FLOOR), "glossy": vars(FLOOR)},
        {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "noise_floor_db": 1e9}},
        {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "more": 1.0}},
    ]  # fmt: skip
    for parts in no_parts:
        record["views"][1]["parts"] = parts
        with case(parts), pytest.raises(TrilightError, match=r"views\.1\.parts"):
            decode_scene("000000000", {**members, "json": json.dumps(record).encode()})


def test_light_that_is_not_finite_is_refused_and_a_sum_beyond_half_floats_is_seen() -> None:
    bright = np.full((2, 8, 8, 3), HALF_FLOAT_MAX * 0.6, np.float32)
    assert np.isinf(sum_of_lights(rounded_to_half(bright))).all()
    for lights in (False, True):
        sample = _sample(lights=lights)
        assert sample.parts_rgb is not None
        sample.parts_rgb["indirect"].flat[5] = np.nan
        with pytest.raises(TrilightError, match="view 0 .*indirect light has radiance nan"):
            sample.check()
