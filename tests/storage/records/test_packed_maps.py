"""Maps as bytes: the same again, held once each, and nothing that a hostile file claims.

Look-ups and facts of maps against obvious twins: loops over texels, and closed forms.
"""

import dataclasses
import gzip
import json
import math
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import pytest
from safetensors.numpy import load, save

from storage.conventions import MAPS_VERSION, SCHEMA_VERSION, latlong_direction, latlong_uv, srgb8
from storage.errors import TrilightError
from storage.records import packed_maps
from storage.records.lookup import environment_values, texture_values
from storage.records.packed_maps import (
    HeldMaps,
    map_member,
    pack_map,
    with_same_content,
)
from storage.records.profiles import PROFILES, Profile
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene_facts import SkyFacts, sky_facts, texture_families, textured_objects
from storage.records.scene_file import decode_scene_file, encode_scene
from storage.records.texture import MAX_MAPS_BYTES, Environment, MapSource, Texture
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, tiny_sample, tiny_scene
from tests.sky_maps import COLOURS, POLES, six_poles
from tests.textured_by_hand import (
    colour_texture,
    number_texture,
    sky,
    textured_sample,
    textured_scene,
)

KEY = "000000000"
Members = dict[str, bytes]

HALVES = Texture(texels=np.array([[[0.5]], [[0.25]]], np.float32))
SCENES = {
    "textured": textured_scene(),
    "sky": tiny_scene(environment=sky(is_seen=True)),
    "both": textured_scene(environment=sky()),
    "halves": textured_scene(0, colour_texture(), HALVES),
}


@for_each("profile", PROFILES)
@for_each("name", SCENES)
def test_a_sample_and_a_scene_file_come_back(name: str, profile: Profile) -> None:
    sample = dataclasses.replace(tiny_sample(), scene=SCENES[name])
    data = encode_scene(sample.scene)
    found = decode_scene_file(data, "a.safetensors")
    assert encode_scene(found) == data  # every bit of every map, and what it is called
    members = encode_sample(sample, profile)
    assert members == encode_sample(sample, profile)
    assert json.loads(members["json"])["schema_version"] == MAPS_VERSION == 4
    back = decode_sample(KEY, members)
    back.check()
    assert encode_scene(back.scene) == data
    assert encode_sample(back) == encode_sample(dataclasses.replace(back, scene=sample.scene))


def test_scenes_without_maps_are_what_they_were() -> None:
    """No member, array, or entry more than before there were maps."""
    members = encode_sample(tiny_sample())
    assert set(members) == {"scene.safetensors", "json", "0.exr", "1.exr"}
    assert set(json.loads(members["json"])) == {"schema_version", "objects", "provenance", "views"}
    assert json.loads(members["json"])["schema_version"] == SCHEMA_VERSION
    assert len(load(members["scene.safetensors"])) == 8
    assert len(load(encode_scene(tiny_scene()))) == 8


def test_bytes_go_by_content_alone_and_are_halves_only_where_nothing_is_lost() -> None:
    texture = colour_texture()
    other = dataclasses.replace(texture, source=number_texture().source)
    assert pack_map(texture) == pack_map(other) and texture.sha256 == other.sha256
    turned = sky(rotation=np.eye(3, dtype=np.float32), is_seen=True)
    assert pack_map(sky()) == pack_map(turned)
    assert sky().sha256 == turned.sha256
    read_as_linear = dataclasses.replace(texture, is_srgb=False)
    assert read_as_linear.sha256 != texture.sha256

    def dtype(data: bytes) -> str:
        return str(load(gzip.decompress(data))["values"].dtype)

    assert dtype(pack_map(HALVES)) == "float16"
    assert dtype(pack_map(number_texture())) == "float32"
    assert dtype(pack_map(sky())) == "float32"  # its sun of 1e6 is beyond half floats
    dim = sky(radiance_rgb=np.full((1, 2, 3), 7, np.float32))
    assert dtype(pack_map(dim)) == "float16"


def _record(change: Callable[[dict[str, Any]], object]) -> Callable[[Members], None]:
    def changed(members: Members) -> None:
        record = json.loads(members["json"])
        change(record)
        members["json"] = json.dumps(record).encode()

    return changed


def _entry(kind: str, **fields: Any) -> Callable[[Members], None]:
    """Change what the record says of the first texture, or of the environment."""
    if kind == "environment":
        return _record(lambda r: r["maps"]["environment"].update(fields))
    return _record(lambda r: r["maps"]["textures"][0].update(fields))


def _texture_bytes(change: Callable[[bytes], bytes]) -> Callable[[Members], None]:
    name = map_member(colour_texture().sha256)
    return lambda members: members.update({name: change(members[name])})


def _other_values(data: bytes) -> bytes:
    arrays = load(gzip.decompress(data))
    return gzip.compress(save({"values": arrays["values"] ^ 1}, {"form": "srgb"}))


def _claiming(shape: Any, dtype: str = "U8") -> Callable[[bytes], bytes]:
    header = {
        "__metadata__": {"form": "srgb"},
        "values": {"dtype": dtype, "shape": shape, "data_offsets": [0, 1]},
    }
    text = json.dumps(header).encode()
    packed = gzip.compress(len(text).to_bytes(8, "little") + text + b"\0")
    return lambda _: packed


HOSTILE: list[tuple[Callable[[Members], object], str]] = [
    (lambda m: m.pop(map_member(sky().sha256)), "is missing; expected a member __map-"),
    (_texture_bytes(_other_values), "has the content"),
    (_texture_bytes(lambda _: b"noise"), "damaged"),
    (_texture_bytes(lambda _: b""), "no safetensors file"),
    (_texture_bytes(lambda data: data[:-9]), "cut short"),
    (_texture_bytes(lambda data: data[:60] + b"\xff" + data[61:]), "damaged"),
    (_texture_bytes(lambda data: data + b"x"), "goes on"),
    (_texture_bytes(_claiming([16384, 16384, 3])), f"at most {MAX_MAPS_BYTES}"),
    (_texture_bytes(_claiming([2**40, 2**40, 3])), "a picture of 8 bits or floats"),
    (_texture_bytes(_claiming([-1, -1, 3])), "a picture"),
    (_texture_bytes(_claiming([4, 6])), "a picture"),
    (_texture_bytes(_claiming([4, 6, 3])), "unreadable"),
    (_texture_bytes(_claiming([4, 6, 3], "F64")), "a picture"),
    (_entry("environment", sha256=colour_texture().sha256), "expected an environment map"),
    (_entry("texture", sha256=sky().sha256), "expected a texture"),
    (_entry("texture", sha256="../" * 20), "64 hexadecimal"),
    (
        _record(lambda r: r["maps"]["textures"][0].pop("sha256")),
        "sha256 is missing; expected 64",
    ),
    (_entry("texture", name=3), "name is 3; expected a text"),
    (_record(lambda r: r["maps"].update(textures=3)), "a list"),
    (_record(lambda r: r["maps"].update(more=1)), "maps.more does not exist; .* environment"),
    (_entry("environment", rotation=[["a"] * 3] * 3), "rotation.0.0 is 'a'; expected"),
    (_entry("environment", rotation=[[1, 0, 0]]), "rotation.1 is missing"),
    (_entry("environment", is_seen=1), "true or false"),
    (_entry("environment", rotation=np.eye(3).tolist()), "do not speak of the same"),
    (_record(lambda r: (r.pop("maps"), r.update(schema_version=3))), "do not speak of the same"),
    (_record(lambda r: r.update(schema_version=3)), "expected 4 exactly where there are any"),
]


@contextmanager
def little_memory() -> Iterator[None]:
    """A few buffers; the textures here are of 72 bytes."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@for_each(("change", "message"), HOSTILE)
def test_a_hostile_sample_is_one_line(change: Callable[[Members], object], message: str) -> None:
    members = encode_sample(textured_sample())
    change(members)
    with little_memory(), pytest.raises(TrilightError, match=message) as caught:
        decode_sample(KEY, members)
    assert str(caught.value).startswith("sample 000000000: ") and "\n" not in str(caught.value)


def test_maps_are_counted_before_they_are_unpacked() -> None:
    """Two maps of 432 MB each, which one alone may take: refused by what their headers say."""
    assert MAX_MAPS_BYTES / 2 < 12000 * 12000 * 3 < MAX_MAPS_BYTES
    members = encode_sample(tiny_sample())
    rights = {"name": "", "licence": "", "attribution": "", "source_url": ""}
    packed = _claiming([12000, 12000, 3])(b"")
    maps = {"textures": [{"sha256": digit * 64, **rights} for digit in "01"]}
    _record(lambda r: r.update(schema_version=MAPS_VERSION, maps=maps))(members)
    members |= {map_member(digit * 64): packed for digit in "01"}
    expected = f"expected at most {MAX_MAPS_BYTES}"
    with little_memory(), pytest.raises(TrilightError, match=expected):
        decode_sample(KEY, members)


def _arrays(**changed: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda arrays, _: arrays.update(changed)


SCENE_FILES: list[tuple[Callable[[dict[str, Any], dict[str, Any]], object], str]] = [
    (lambda arrays, _: arrays.pop("texture.1"), "texture.1 is missing"),
    (_arrays(texture=np.zeros(1, np.uint8)), "expected: 'texture'"),
    (_arrays(**{"texture.0": np.zeros((1, 1, 3))}), "has dtype float64; expected uint8"),
    (_arrays(**{"texture.0": colour_texture(1).texels}), "has the content"),
    (_arrays(environment=np.full((1, 2, 3), np.nan, np.float32)), "is nan"),
    (lambda _, record: record.update(is_srgb=[True]), "for each texture"),
    (lambda _, record: record.pop("maps"), "exactly where there are any"),
    (
        lambda _, record: (record.pop("maps"), record.update(schema_version=3)),
        "textures is missing",
    ),
]


@for_each(("change", "message"), SCENE_FILES)
def test_a_hostile_scene_file_is_one_line(
    change: Callable[[dict[str, Any], dict[str, Any]], object], message: str
) -> None:
    data = encode_scene(textured_scene(environment=sky()))
    length = int.from_bytes(data[:8], "little")
    record = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["trilight_scene"])
    arrays = dict(load(data))
    change(arrays, record)
    changed = save(arrays, {"trilight_scene": json.dumps(record)})
    with pytest.raises(TrilightError, match=message) as caught:
        decode_scene_file(changed, "a.safetensors")
    assert str(caught.value).startswith("a.safetensors: ") and "\n" not in str(caught.value)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> HeldMaps:
    """Return what the process holds: nothing yet."""
    held = HeldMaps()
    monkeypatch.setattr(packed_maps, "_HELD", held)
    return held


def test_equal_members_give_equal_samples_with_and_without_what_is_held(
    held: HeldMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another name and another turn of the same maps: both are the entry's, not the held one's."""
    turned = sky(rotation=np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32), is_seen=True)
    renamed = dataclasses.replace(turned, source=MapSource(name="dusk", licence="CC-BY-4.0"))
    first = encode_sample(textured_sample(KEY))
    scene = textured_scene(environment=renamed)
    second = encode_sample(dataclasses.replace(textured_sample(KEY), scene=scene))
    for members in (first, second, first):
        found = decode_sample(KEY, members)
        with monkeypatch.context() as patch:
            patch.setattr(packed_maps, "_HELD", HeldMaps())
            plain = decode_sample(KEY, members)
        found.check()
        assert encode_sample(found) == encode_sample(plain) == members
        assert found.scene.environment is not None and plain.scene.environment is not None
        assert found.scene.environment.source == plain.scene.environment.source
        assert found.scene.environment.is_seen == plain.scene.environment.is_seen


@pytest.mark.usefixtures("held")
def test_a_map_is_unpacked_once_and_what_is_refused_stays_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    members, values = encode_sample(textured_sample(KEY)), packed_maps._PackedMap.values
    unpack: Any = mock.create_autospec(values, side_effect=values)
    monkeypatch.setattr(packed_maps._PackedMap, "values", unpack)
    scenes = [decode_sample(KEY, members).scene for _ in range(3)]
    unpacked = [each.args[0].name for each in unpack.call_args_list]
    assert len(unpacked) == len(set(unpacked)) == 3
    one, other = scenes[0].textures[0], scenes[2].textures[0]
    assert one.texels is other.texels
    with pytest.raises(ValueError, match="read-only"):
        one.texels[0] = 0
    # neither a damaged copy of a held map, nor one under another name, nor one of another kind
    name, of_sky = map_member(colour_texture().sha256), map_member(sky().sha256)
    for wrong in (members[name][:-9], members[of_sky], encode_sample(textured_sample(KEY, 1))):
        swapped = wrong if isinstance(wrong, bytes) else wrong[map_member(colour_texture(1).sha256)]
        for _ in range(2):
            with pytest.raises(TrilightError):
                decode_sample(KEY, {**members, name: swapped})
    decode_sample(KEY, members)


def test_memory_is_bounded_and_the_oldest_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage.records.packed_maps.HELD_BYTES", 1000)
    held, made = HeldMaps(), list[int]()

    def asked(number: int, side: int = 10) -> Texture:
        def unpack() -> Texture:
            made.append(number)
            return Texture(texels=np.full((side, side, 3), number, np.uint8))

        return held.get_or_unpack(Texture, f"{number:064x}", b"%d" % number, unpack)

    for number in (1, 2, 3, 1, 4, 1, 2):  # 300 bytes each: 4 takes the place of 2
        assert asked(number).texels[0, 0, 0] == number
        assert held.num_bytes <= 1000
    assert made == [1, 2, 3, 4, 2]
    asked(9, side=20)
    asked(9, side=20)  # larger than all that may be held
    assert made[-2:] == [9, 9] and held.num_bytes <= 1000


def test_threads_share_it(held: HeldMaps) -> None:
    members = encode_sample(textured_sample(KEY))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: decode_sample(KEY, members), range(16)))
    assert all(encode_sample(each) == members for each in found)
    assert held.num_bytes == sum(
        each.nbytes for each in (*(t.texels for t in found[0].scene.textures), sky().radiance_rgb)
    )


def test_mean_greatest_and_constant_are_those_of_the_texels_and_stay_known() -> None:
    one = colour_texture()
    digest, mean = one.sha256, one.mean
    other = with_same_content(one, source=MapSource(name="another"))
    assert vars(other)["sha256"] == digest and vars(other)["mean"] is mean
    assert other.source.name == "another" and one.source.name != "another"
    turned = with_same_content(sky(), is_seen=True)
    assert isinstance(turned, Environment) and turned.is_seen
    for texture in (colour_texture(), number_texture()):
        linear = texture.linear(texture.texels).astype(np.float64)
        assert texture.mean == pytest.approx(linear.mean(axis=(0, 1)), rel=1e-6)  # of float32
        assert (texture.greatest == linear.max(axis=(0, 1))).all()
        assert texture.constant is None
    assert Texture(texels=np.full((3, 2, 1), 255, np.uint8)).constant == np.ones(1)


def test_directions_and_coloured_poles_stand_where_the_conventions_say_and_back() -> None:
    """The table of Blender: centre +X, a quarter +Y, three quarters -Y, the border -X, top +Z."""
    expected = {"+X": (0.5, 0.5), "+Y": (0.25, 0.5), "-Y": (0.75, 0.5)}
    for name, place in expected.items():
        assert latlong_uv(POLES[name]) == pytest.approx(place, abs=1e-15)
    assert latlong_uv(POLES["-X"])[0] % 1 == pytest.approx(0, abs=1e-15)
    assert latlong_uv(POLES["+Z"])[1] == 1 and latlong_uv(POLES["-Z"])[1] == 0
    # turning by 90 degrees or a mirror fails; `latlong_direction` draws the map by the table
    for rotation in (np.eye(3, dtype=np.float32), sky().rotation):
        environment = six_poles(rotation=rotation)
        for name, direction in POLES.items():
            found = environment_values(environment, rotation @ direction)
            assert found == pytest.approx(COLOURS[name])
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near_poles = [(1e-9, 2e-9, 1), (-3e-12, 1e-12, -1)]
    for each in (directions, np.array(near_poles)):
        back = latlong_direction(latlong_uv(each))
        assert np.abs(back - each).max() < 1e-14  # a few roundings of double precision
    relative = latlong_direction(latlong_uv(near_poles))[:, :2] / np.array(near_poles)[:, :2]
    # v itself is known to 1e-16 near 1, which is 3e-16 radians of the 2e-9 between these and +Z
    assert relative[0] == pytest.approx(1, abs=1e-6)


def _slow(texture: Texture, u: float, v: float) -> np.ndarray:
    """Return the sum over all texels, each weighted by its tents in u and v."""
    height, width, channels = texture.texels.shape
    total = np.zeros(channels)
    for row in range(-height, 3 * height):
        for column in range(-width, 3 * width):
            across = max(0.0, 1 - abs((v % 1) * height - (row + 0.5)))
            along = max(0.0, 1 - abs((u % 1) * width - (column + 0.5)))
            texel = texture.linear(texture.texels[row % height, column % width])
            total += across * along * texel.astype(np.float64)
    return total


@for_each("texture", [colour_texture(), number_texture()])
def test_a_texture_is_the_sum_of_its_tents(texture: Texture) -> None:
    places = [(0, 0), (0.5, 0.5), (1, 1), (-0.25, 1.25), (0.999, 0.001), (7.3, -12.8)]
    for u, v in places:
        # a few roundings of numbers below 10
        assert texture_values(texture, (u, v)) == pytest.approx(_slow(texture, u, v), abs=1e-13)


def test_row_0_is_the_bottom_far_places_lose_no_digits_and_bytes_are_decoded_first() -> None:
    texture = Texture(texels=np.array([[[0], [0.25]], [[0.5], [0.75]]], np.float32))
    corners = {(0.25, 0.25): 0, (0.75, 0.25): 1, (0.25, 0.75): 2, (0.75, 0.75): 3}
    for place, value in corners.items():
        assert texture_values(texture, place) == value / 4
        further = np.add(place, (5, -3))
        assert texture_values(texture, further) == value / 4
    # 1023 + 1/8 is exact in float32, and means 1/8
    far = texture_values(colour_texture(), np.array([1023.125, -1023.875], np.float32))
    assert (far == texture_values(colour_texture(), (0.125, 0.125))).all()
    assert math.isfinite(far.sum())
    # halfway between black and white sRGB is 0.5, and not what the code 127 stands for
    texels = np.array([[[0], [255]]], np.uint8)
    for is_srgb in (True, False):
        assert texture_values(Texture(texels=texels, is_srgb=is_srgb), (0.5, 0)) == 0.5
    every = np.arange(256, dtype=np.uint8).reshape(1, 256, 1)
    linear = Texture(texels=every, is_srgb=True).linear(every)
    assert (srgb8(linear) == every).all()
    assert linear[0, 188, 0] == pytest.approx(0.502886, abs=1e-6)  # IEC 61966-2-1
    assert Texture(texels=every).linear(every)[0, 51, 0] == np.float32(0.2)


def test_a_map_goes_round_and_ends_at_the_poles() -> None:
    environment = sky(rotation=np.eye(3, dtype=np.float32))
    radiance = environment.radiance_rgb.astype(np.float64)
    height, width = radiance.shape[:2]
    border = latlong_direction((0, 0.5))
    expected = (radiance[1, 0] + radiance[1, -1]) / 2
    assert environment_values(environment, border) == pytest.approx(expected, abs=1e-12)
    for row in range(height):
        for column in range(width):
            place = (column + 0.5) / width, 1 - (row + 0.5) / height
            found = environment_values(environment, 3 * latlong_direction(place))
            # a sun of 1e6 beside it counts by the rounding of its place, a few 1e-16
            assert found == pytest.approx(radiance[row, column], abs=1e-8)
    assert environment_values(environment, (0, 0, 1)) == pytest.approx(
        (radiance[0, 2] + radiance[0, 3]) / 2, abs=1e-8
    )


HEIGHT = 90


def facts(radiance: np.ndarray) -> SkyFacts:
    return sky_facts(Environment(radiance_rgb=radiance.astype(np.float32)))


def test_skies_have_half_of_their_light_where_closed_forms_say() -> None:
    found = facts(np.full((HEIGHT, 2 * HEIGHT, 3), 0.7))
    assert found.mean_radiance == pytest.approx(0.7, rel=1e-6)
    assert found.peak == pytest.approx(1, rel=1e-6)
    # half of the sphere is the cone of 180 degrees across; 1e-4 is the rounding of float32 radiance
    assert found.half_light_deg == pytest.approx(180, abs=1e-3)
    # a lit upper half has half of its light in 2 pi / 2 steradians: 120 degrees across
    half = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    half[: HEIGHT // 2] = [3, 2, 1]
    found = facts(half)
    assert (found.mean_radiance, found.peak) == (pytest.approx(1), pytest.approx(2))
    assert found.half_light_deg == pytest.approx(120, abs=1e-3)
    sun = np.zeros((HEIGHT, 2 * HEIGHT, 3))
    sun[HEIGHT // 2, 17] = 1e6
    texel = np.sin(np.pi / HEIGHT) * np.pi / HEIGHT  # steradians, from the equator down
    found = facts(sun)
    assert found.mean_radiance == pytest.approx(1e6 * texel / (4 * np.pi), rel=1e-6)
    across = np.degrees(2 * np.arccos(1 - texel / 2 / (2 * np.pi)))
    assert found.half_light_deg == pytest.approx(across, rel=1e-6)
    assert facts(np.zeros((2, 4, 3))) == SkyFacts(mean_radiance=0, peak=0, half_light_deg=0)


def test_what_textures_are_called_and_where_they_are() -> None:
    named = Texture(texels=colour_texture().texels, source=MapSource(name="fine planks diffuse"))
    other = Texture(texels=np.zeros((1, 2, 1), np.uint8), source=MapSource(name="worn by hand"))
    scene = textured_scene(0, named, other)
    assert texture_families(scene) == {"fine planks", "worn by hand"}
    assert textured_objects(scene) == set(
        np.unique(scene.object_index[scene.material_index == FLOOR])
    )
    plain = tiny_scene(environment=sky())
    assert texture_families(plain) == textured_objects(plain) == set()
