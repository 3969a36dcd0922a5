"""Stored and textured passes: a file gives the numbers that are computed, for every tool."""

import dataclasses
import io

import numpy as np
import OpenEXR
import pytest

from storage.dataset.settings import StorageSettings
from storage.errors import TrilightError
from storage.raycast.first_hits import first_hits
from storage.records.exr import channel_names, decode_channels, encode_channels
from storage.records.lookup import texture_values
from storage.records.passes import stored
from storage.records.passes.declared import MOTION, declared_passes, pass_names
from storage.records.passes.pictures import view_passes
from storage.records.passes.stored import (
    decode_passes_exr,
    passes_exr,
    passes_in_file,
    picture_passes,
)
from storage.records.sample import Sample, decode_sample, encode_sample
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, tiny_sample, tiny_scene
from tests.storage.records.passes.test_pictures import room
from tests.storage.records.test_parts import faults
from tests.textured_by_hand import sky, textured_scene

ALL = tuple(each.name for each in declared_passes() if each.name != MOTION)


def with_passes(names: tuple[str, ...]) -> Sample:
    sample = tiny_sample()
    packed = tuple(passes_exr(sample.scene, names, view=view, resolution=16) for view in range(2))
    return dataclasses.replace(sample, passes_exr=packed)


@for_each("rays_a_side", [1, 2])
def test_every_pass_comes_back_from_a_file(rays_a_side: int) -> None:
    scene = room(0)
    data = passes_exr(scene, ALL, view=1, resolution=32, rays_a_side=rays_a_side)
    found = decode_passes_exr(data, 32)
    names = passes_in_file(scene, ALL)
    assert set(ALL) - set(names) == {"uv"}, "which a scene without textures has not"
    asked = view_passes(scene, names, view=1, resolution=32, rays_a_side=rays_a_side)
    assert 0 < asked["hit"].mean() < 1
    assert list(found) == list(asked)
    for name, picture in asked.items():
        kept = picture.astype(np.float32) if picture.dtype == np.float64 else picture
        assert found[name].dtype == kept.dtype, name
        np.testing.assert_array_equal(found[name], kept, err_msg=name)


def test_a_sample_gives_the_same_numbers_stored_or_not() -> None:
    names = ("object", "depth_axis_m", "shading_normal")
    sample = with_passes(names[:2])
    read = decode_sample(sample.key, encode_sample(sample, "compact"))
    assert read.passes_exr == sample.passes_exr
    plain = decode_sample(sample.key, encode_sample(tiny_sample(), "compact"))
    for view in range(2):
        there, computed = read.view_passes(names, view=view), plain.view_passes(names, view=view)
        assert list(there) == list(computed) == list(names)
        for name in names:
            assert there[name].dtype == computed[name].dtype
            np.testing.assert_array_equal(there[name], computed[name])
    members = encode_sample(sample)
    del members["1.passes.exr"]
    with pytest.raises(TrilightError, match="1.passes.exr.*missing"):
        decode_sample(sample.key, members)


def test_stored_passes_are_not_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    sample = with_passes(("triangle",))
    monkeypatch.setattr(stored, "view_passes", None)
    assert sample.view_passes(["triangle"])["triangle"].shape == (16, 16)


def test_the_names_and_values_that_other_programs_read() -> None:
    """The declared names, and 0 in place of NaN; A tells where nothing is met."""
    names = ("triangle", "depth_axis_m", "shading_normal", "material_diffuse")
    data = passes_exr(room(0), names, view=1, resolution=32)
    file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
    channels = {name: channel.pixels for name, channel in file.channels().items()}
    colours = [f"material_diffuse.{letter}" for letter in "BGR"]
    assert sorted(channels) == ["A", "N.X", "N.Y", "N.Z", "Z", *colours, "triangle.V"]
    assert {channel.dtype for channel in channels.values()} == {np.dtype(np.float32)}
    missed = channels["A"] == 0
    assert missed.any()
    assert (channels["triangle.V"][missed] == -1).all()
    assert np.isinf(channels["Z"][missed]).all()
    for name in ("N.X", "N.Y", "N.Z", "material_diffuse.R"):
        assert (channels[name][missed] == 0).all()


def test_no_two_passes_share_a_channel() -> None:
    channels = [channel for each in declared_passes() for channel in each.exr_channels]
    assert len(channels) == len(set(channels))
    for channel in channels:  # Blender and Nuke skip channels with longer names
        assert len(channel.rpartition(".")[2]) == 1, channel


def test_words_mean_passes() -> None:
    assert pass_names(["normal", "depth", "depth_axis_m"]) == ("depth_axis_m", "shading_normal")
    assert pass_names(["roughness"]) == ("material_roughness",)
    assert StorageSettings(passes=("normal", "object")).passes == ("object", "shading_normal")
    with pytest.raises(TrilightError, match=r"no pass 'dept'; did you mean depth\?"):
        StorageSettings(passes=("dept",))
    with pytest.raises(TrilightError, match="motion_px needs another moment"):
        pass_names([MOTION])


def test_more_triangles_than_float32_counts_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored, "MOST_IDS", 2)
    with pytest.raises(TrilightError, match="3 triangles; expected at most 2"):
        with_passes(("triangle",))


@for_each(
    ("channels", "resolution", "message"),
    [
        ({"A": 16, "Q.V": 16}, 16, "channels are A, Q.V; expected A"),
        ({"A": 16, "N.X": 16}, 16, "channels are A, N.X; expected A"),
        ({"Z": 16}, 16, r"channel A \(coverage\) is missing"),
        ({"A": 8}, 16, r"\[8, 8\] pixels; expected \[16, 16\]"),
    ],
)
def test_other_files_are_refused(channels: dict[str, int], resolution: int, message: str) -> None:
    planes = {name: np.zeros((side, side), np.float32) for name, side in channels.items()}
    with pytest.raises(TrilightError, match=message):
        decode_passes_exr(encode_channels(planes), resolution)
    with pytest.raises(TrilightError):
        decode_passes_exr(encode_channels(planes)[:100], resolution)


def test_verify_compares_with_the_scene() -> None:
    sample = with_passes(("object", "depth_axis_m"))
    assert faults(sample, "object", "depth_axis_m") == []
    assert "has passes" in faults(sample)[0]
    assert "lacks passes" in faults(tiny_sample(), "object")[0]
    assert "expected coverage, object" in faults(sample, "object")[0]
    assert sample.passes_exr is not None
    first, second = sample.passes_exr
    swapped = dataclasses.replace(sample, passes_exr=(second, first))
    said = " ".join(faults(swapped, "object", "depth_axis_m"))
    assert "pass depth_axis_m is not what the scene says" in said
    cut = dataclasses.replace(sample, passes_exr=(first[:-200], second))
    assert "not a readable OpenEXR" in faults(cut, "object", "depth_axis_m")[0]


RESOLUTION = 24
COLUMNS = ("material_diffuse", "material_specular", "material_roughness", "material_emission")


@for_each("view", [0, 1])
def test_coordinates_and_columns_are_those_of_the_point(view: int) -> None:
    """The floor's coordinates are 0.7 times x and y; its columns are what the textures say."""
    scene = textured_scene()
    seen = view_passes(scene, view=view, resolution=RESOLUTION)
    met = seen["hit"]
    assert 0.2 < met.mean() < 1
    place = 0.7 * seen["position_m"][met][:, :2]
    # the corners' coordinates are float32 numbers below 1
    np.testing.assert_allclose(seen["uv"][met], place, atol=1e-7)
    assert np.isnan(seen["uv"][~met]).all()
    found = seen["uv"][met]
    diffuse, roughness = (texture_values(texture, found) for texture in scene.textures)
    np.testing.assert_array_equal(seen["material_diffuse"][met], diffuse.astype(np.float32))
    np.testing.assert_array_equal(seen["material_roughness"][met], roughness[:, 0].astype("f4"))
    specular = np.broadcast_to(scene.materials[FLOOR, 3:6], diffuse.shape)
    np.testing.assert_array_equal(seen["material_specular"][met], specular)
    assert all(np.isnan(seen[name][~met]).all() for name in COLUMNS)
    assert np.ptp(diffuse, axis=0).min() > 0.1  # it is a texture that was looked up


def test_columns_are_averaged_after_they_are_looked_up() -> None:
    scene = textured_scene()
    names = ["material_diffuse", "hit"]
    fine = view_passes(scene, names, resolution=RESOLUTION * 2)
    coarse = view_passes(scene, names, resolution=RESOLUTION, rays_a_side=2)["material_diffuse"]
    blocks = fine["material_diffuse"].reshape(RESOLUTION, 2, RESOLUTION, 2, 3)
    whole = fine["hit"].reshape(RESOLUTION, 2, RESOLUTION, 2).all(axis=(1, 3))
    np.testing.assert_allclose(coarse[whole], blocks.mean(axis=(1, 3))[whole], rtol=1e-12)


def test_one_pixel_is_that_of_the_picture_and_changes_no_table() -> None:
    scene = textured_scene()
    before = scene.materials.copy()
    whole = first_hits(scene, resolution=RESOLUTION)
    row, column = (int(at) for at in np.argwhere(whole.met)[10])
    one = first_hits(scene, resolution=RESOLUTION, pixel=(row, column))
    np.testing.assert_array_equal(one.material, whole.material[row, column])
    np.testing.assert_array_equal(one.uv, whole.uv[row, column])
    np.testing.assert_array_equal(one.seen.materials[one.triangle], before[FLOOR])
    assert (scene.materials == before).all()


def test_a_scene_without_textures_has_no_coordinates_and_a_sky_changes_no_pass() -> None:
    plain, lit = (
        view_passes(scene, resolution=RESOLUTION)
        for scene in (tiny_scene(), tiny_scene(environment=sky(is_seen=True)))
    )
    assert "uv" not in plain and plain.keys() == lit.keys()
    for name, values in plain.items():
        np.testing.assert_array_equal(lit[name], values)
    assert np.isnan(view_passes(tiny_scene(), ["uv"], resolution=RESOLUTION)["uv"]).all()


def test_files_of_plain_scenes_have_no_coordinates_and_no_nan() -> None:
    """Not even at hits, where other programs would spread it; asked for, they are NaN as ever."""
    names = ["uv", "shading_normal"]
    for scene, there in ((tiny_scene(), set()), (textured_scene(), {"uv"})):
        packed = passes_exr(scene, names, view=0, resolution=RESOLUTION)
        channels = set(channel_names(packed))
        assert {name for name in channels if name.startswith("uv")} == (
            {"uv.U", "uv.V"} if there else set()
        )
        found = decode_passes_exr(packed, RESOLUTION)
        assert set(found) == {"coverage", "shading_normal"} | there
        raw = decode_channels(packed, sorted(channels), lambda header: None, separate=True)
        assert not any(np.isnan(plane).any() for plane in raw.values())
        again = picture_passes(scene, names, view=0, resolution=RESOLUTION, stored=packed)
        plain = picture_passes(scene, names, view=0, resolution=RESOLUTION)
        for name in names:
            np.testing.assert_array_equal(again[name], plain[name])
