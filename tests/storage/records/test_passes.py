"""Passes: in closed form, by laws, beside a slow twin, and their averages beside plain loops.

Stored ones: a file gives the numbers that are computed, for every tool.
"""

import dataclasses
import io
from typing import Any

import numpy as np
import OpenEXR
import pytest

from storage.conventions import camera_rays, in_camera, look_at_c2w, pixel_places
from storage.dataset.settings import StorageSettings
from storage.errors import TrilightError
from storage.raycast import first_hits
from storage.records import passes
from storage.records.exr import decode_channels, encode_channels, read_header
from storage.records.lookup import texture_values
from storage.records.material import default_rows
from storage.records.passes import (
    MOTION,
    PASSES,
    declared_passes,
    decode_passes_exr,
    pass_names,
    passes_exr,
    passes_in_file,
    picture_passes,
    view_passes,
)
from storage.records.sample import Sample, decode_sample, encode_sample
from storage.records.scene import Scene
from tests.columns_kit import COAT, WAVES, declared
from tests.for_each import case, for_each
from tests.pipeline.renders.scene_kit import join, light, material, quad, sampled_like_scene
from tests.scenes_by_hand import FLOOR, from_above, mirrored, tiny_sample, tiny_scene
from tests.storage.records.test_sample import faults
from tests.textured_by_hand import sky, textured_scene


def room(seed: int = 0, num_views: int = 2) -> Scene:
    """Return shell, objects with curved and flat faces, and lights, in a view with empty pixels."""
    return sampled_like_scene(np.random.default_rng(seed), num_views=num_views)


EXACT = 1e-9
"""Double precision on corners within some metres, with grazing triangles costing some digits."""


@for_each("view", [0, 1])
def test_laws_of_the_centre_rays(view: int) -> None:
    scene, resolution = room(0), 48
    seen = view_passes(scene, view=view, resolution=resolution)
    hit, c2w = seen["hit"], scene.c2w[view]
    assert 0.2 < hit.mean() < 1
    origin, rays = camera_rays(c2w, float(scene.fov_deg[view]), resolution)
    along = origin + seen["depth_ray_m"][..., None] * rays
    np.testing.assert_allclose(seen["position_m"][hit], along[hit], atol=EXACT)
    corners = scene.vertex_positions[scene.faces[seen["triangle"]]].astype(np.float64)
    rebuilt = np.einsum("ijc,ijck->ijk", seen["barycentric"], corners)
    np.testing.assert_allclose(seen["position_m"][hit], rebuilt[hit], atol=EXACT)
    row, column = np.indices(hit.shape)
    centres = np.stack([column, row], axis=-1) + 0.5
    places = pixel_places(seen["position_m"], c2w, float(scene.fov_deg[view]), resolution)
    np.testing.assert_allclose(places[hit], centres[hit], atol=1e-7)
    axis = -in_camera(seen["position_m"], c2w)[..., 2]
    np.testing.assert_allclose(seen["depth_axis_m"][hit], axis[hit], rtol=1e-12)
    for name in ("geometric_normal", "shading_normal"):
        normal, local = seen[name][hit], seen[f"{name}_camera"][hit]
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-12)
        # the axes of a float32 pose are unit vectors to 1e-7
        np.testing.assert_allclose(local @ c2w[:3, :3].T, normal, atol=1e-6)
    np.testing.assert_array_equal(seen["object"][hit], scene.object_index[seen["triangle"][hit]])
    materials = scene.materials[scene.material_index[seen["triangle"][hit]]]
    np.testing.assert_array_equal(seen["material_specular"][hit], materials[:, 3:6])
    np.testing.assert_array_equal(seen["material_roughness"][hit], materials[:, 6])


def test_the_axes_of_the_camera() -> None:
    """A wall, seen squarely by a camera on its side: its +X is -Z of the world."""
    wall = quad([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], material(diffuse=0.5))
    slanted = dataclasses.replace(wall, normals=np.full((2, 3, 3), [0, -0.8, -0.6]))
    scene = join([slanted, light([[-1, -9, 3], [1, -9, 3], [0, -9, 4]], 1.0)])
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = np.transpose([[0, 0, -1], [1, 0, 0], [0, -1, 0]])
    seen = view_passes(scene.with_cameras(pose[None], scene.fov_deg), resolution=3)
    np.testing.assert_allclose(seen["shading_normal"][1, 1], [0, -0.8, -0.6], atol=1e-6)
    np.testing.assert_allclose(seen["shading_normal_camera"][1, 1], [0.6, 0, 0.8], atol=1e-6)
    np.testing.assert_allclose(seen["geometric_normal_camera"][1, 1], [0, 0, 1], atol=1e-6)
    assert seen["depth_axis_m"][0, 0] == pytest.approx(2, abs=1e-12)


def test_a_mirrored_scene_has_mirrored_passes() -> None:
    scene, resolution = room(0), 40
    before, after = (view_passes(each, resolution=resolution) for each in (scene, mirrored(scene)))
    back = {name: picture[:, ::-1] for name, picture in after.items()}
    # rays along a rim may fall to either triangle
    same = (before["triangle"] == back["triangle"]) & (before["hit"] == back["hit"])
    assert same.mean() > 0.99
    turned = {"position_m": [-1, 1, 1], "shading_normal": [-1, 1, 1], "barycentric": [1, 1, 1]}
    # corners run the other way round in the mirror, and (a, b, c) became (a, c, b)
    back["barycentric"] = back["barycentric"][..., [0, 2, 1]]
    turned |= {"geometric_normal": [-1, 1, 1], "shading_normal_camera": [-1, 1, 1]}
    for name in ("depth_axis_m", "depth_ray_m", "material_diffuse", "material_roughness"):
        np.testing.assert_allclose(before[name][same], back[name][same], rtol=1e-6, err_msg=name)
    for name, signs in turned.items():
        np.testing.assert_allclose(
            before[name][same], (back[name] * signs)[same], atol=1e-4, err_msg=name
        )


@for_each("a_side", [2, 3])
def test_blocks_of_rows_join_to_the_same_picture(
    a_side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Means are those of Mitsuba's samples (tests/pipeline/renders/test_passes.py)."""
    for scene in (room(0), textured_scene()):
        resolution = 12
        monkeypatch.setattr(passes, "BLOCK_RAYS", 2**14)
        whole = view_passes(scene, resolution=resolution, rays_a_side=a_side)
        monkeypatch.setattr(passes, "BLOCK_RAYS", 5 * resolution * a_side**2)
        joined = view_passes(scene, resolution=resolution, rays_a_side=a_side)
        centre = view_passes(scene, resolution=resolution)
        hit = view_passes(scene, ["hit"], resolution=resolution * a_side)["hit"]
        shares = hit.reshape(resolution, a_side, resolution, a_side).mean(axis=(1, 3))
        np.testing.assert_allclose(whole["coverage"], shares, atol=1e-12)
        assert 0 < ((whole["coverage"] > 0) & (whole["coverage"] < 1)).sum()
        # one needs another camera, the other textures
        absent = {"motion_px"} if scene.textures else {"motion_px", "uv"}
        assert {each.name for each in declared_passes()} - set(whole) == absent
        for each in declared_passes():
            if each.name not in absent:
                np.testing.assert_allclose(joined[each.name], whole[each.name], rtol=1e-12)
                if each.averaging == "centre ray":
                    np.testing.assert_array_equal(whole[each.name], centre[each.name])


def test_what_is_asked_for_comes_as_it_is_declared_and_no_two_share_a_channel() -> None:
    seen = view_passes(textured_scene(), resolution=6, then_view=1)
    assert list(seen) == [each.name for each in declared_passes()]
    for each in declared_passes():
        tail = (len(each.channels),) if each.channels else ()
        assert seen[each.name].shape == (6, 6, *tail), each.name
        assert seen[each.name].dtype == each.dtype, each.name
        assert each.means.endswith(".")
    assert "motion_px" not in view_passes(room(0), resolution=6)
    assert list(view_passes(room(0), ["hit", "object"], resolution=6)) == ["hit", "object"]
    assert len({each.name for each in PASSES}) == len(PASSES)
    channels = [channel for each in declared_passes() for channel in each.exr_channels]
    assert len(channels) == len(set(channels))
    for channel in channels:  # Blender and Nuke skip channels with longer names
        assert len(channel.rpartition(".")[2]) == 1, channel


def test_nothing_is_seen() -> None:
    away = textured_scene()
    poses = away.c2w.copy()
    poses[:, :3, [0, 2]] *= -1  # turned about
    for a_side in (1, 2):
        seen = view_passes(
            away.with_cameras(poses, away.fov_deg), resolution=5, rays_a_side=a_side, then_view=1
        )
        for each in declared_passes():
            filled = np.full(seen[each.name].shape, each.nothing)
            np.testing.assert_array_equal(seen[each.name], filled, err_msg=each.name)
        assert np.isinf(seen["depth_ray_m"]).all() and (seen["triangle"] == -1).all()


def test_a_camera_inside_an_object_sees_its_back() -> None:
    walls = [
        quad(
            np.roll([[s, -1, -1], [s, 1, -1], [s, 1, 1], [s, -1, 1]], axis, 1), material(diffuse=1)
        )
        for axis in range(3)
        for s in (-1.0, 1.0)
    ]
    lamp = light([[0.1, 0, 0.5], [0, 0.1, 0.5], [0, 0, 0.5]], 1.0)
    scene = join([*walls, lamp], eye=(0.1, -0.2, 0.3), target=(1, 0.1, 0.2), fov_deg=100)
    seen = view_passes(scene, resolution=16, rays_a_side=2)
    assert seen["coverage"].min() == 1
    assert seen["depth_ray_m"].min() > 0.5
    _, rays = camera_rays(scene.c2w[0], 100.0, 16)
    behind = np.sum(seen["geometric_normal"] * rays, axis=-1) > 0
    assert 0 < behind.sum() < behind.size, "normals are those of the triangles, not turned"


def test_a_single_pixel_and_a_place_far_away() -> None:
    near = view_passes(from_above(), resolution=1)
    assert near["depth_ray_m"].shape == (1, 1) and near["position_m"].shape == (1, 1, 3)
    assert near["depth_ray_m"][0, 0] == pytest.approx(1)
    scene, away = from_above(), np.array([960, -960, 960], np.float32)
    poses = scene.c2w.copy()
    poses[:, :3, 3] += away
    there = dataclasses.replace(scene, vertex_positions=scene.vertex_positions + away, c2w=poses)
    here, far = (view_passes(each, resolution=8, rays_a_side=2) for each in (scene, there))
    np.testing.assert_array_equal(here["coverage"], far["coverage"])
    # the lattice of float32 is 6e-5 m wide there
    np.testing.assert_allclose(here["depth_ray_m"], far["depth_ray_m"], atol=1e-4)
    np.testing.assert_allclose(here["position_m"] + away, far["position_m"], atol=2e-4)


def test_mistakes_and_other_triangles_are_named() -> None:
    mistakes: list[tuple[dict[str, Any], str]] = [
        ({"view": 2}, "view is 2; expected 0 to 1"),
        ({"resolution": 0}, "resolution is 0; expected a whole number from 1 to 65536"),
        ({"rays_a_side": 65}, "rays_a_side is 65; expected a whole number from 1 to 64"),
        ({"names": ["depth"]}, "there is no pass 'depth'; expected of triangle, object"),
        ({"names": ["motion_px"]}, "motion_px: no other moment is given; expected `then`"),
    ]
    for arguments, complaint in mistakes:
        with case(arguments), pytest.raises(TrilightError, match=complaint):
            view_passes(tiny_scene(), **{"resolution": 4, **arguments})
    scene = tiny_scene()
    fewer = dataclasses.replace(
        scene,
        faces=scene.faces[:2],
        material_index=scene.material_index[:2],
        object_index=scene.object_index[:2],
    )
    with pytest.raises(TrilightError, match=r"2 triangles; expected the 3 of this one"):
        view_passes(scene, then=fewer)
    turned = dataclasses.replace(scene, faces=scene.faces[:, [1, 2, 0]])
    with pytest.raises(TrilightError, match=r"faces\[0\] .* \[1, 2, 0\]; expected \[0, 1, 2\]"):
        view_passes(scene, then=turned)


def test_a_column_of_ones_own_is_a_pass() -> None:
    with declared(COAT, WAVES):
        scene = from_above()
        rows = default_rows(2)
        rows[:, 10] = [0.25, 0.75]
        seen = view_passes(
            dataclasses.replace(scene, materials=rows), ["material_coat", "material_waves"],
            resolution=4, rays_a_side=2,
        )  # fmt: skip
        assert next(each for each in declared_passes() if each.name == "material_waves").channels
    np.testing.assert_array_equal(seen["material_coat"], np.full((4, 4), 0.25))
    np.testing.assert_array_equal(seen["material_waves"], np.full((4, 4, 5), 0.5))


def test_motion_is_the_difference_of_projections_and_has_its_closed_form() -> None:
    """At fov 90 and 1 m, 16 pixels are 2 m: a step of 0.25 m to the right moves all left by 2.

    Points are followed by their triangles: a floor that slides by 0.5 m moves by 4.
    """
    scene = from_above()
    poses = np.concatenate([scene.c2w, scene.c2w])
    poses[1, :3, 3] += [0.25, 0.125, 0]  # right and up in the picture
    both = scene.with_cameras(poses, np.array([90, 90], np.float32))
    for a_side in (1, 2):
        motion = view_passes(both, ["motion_px"], resolution=16, rays_a_side=a_side, then_view=1)
        expected = np.broadcast_to([-2.0, 1.0], (16, 16, 2))
        np.testing.assert_allclose(motion["motion_px"], expected, atol=1e-6)
    moved = scene.vertex_positions.copy()
    moved[:4, 0] += 0.5
    later = dataclasses.replace(scene, vertex_positions=moved)
    slid = view_passes(scene, ["motion_px"], resolution=16, then=later)["motion_px"]
    np.testing.assert_allclose(slid, np.broadcast_to([4.0, 0.0], (16, 16, 2)), atol=1e-6)
    # what is behind the other camera does not move
    up = look_at_c2w(eye=[0, 0, 1], target=[0, 0, 2], up=[0, 1, 0])[None].astype(np.float32)
    later = scene.with_cameras(up, scene.fov_deg)
    seen = view_passes(scene, resolution=4, rays_a_side=2, then=later)
    assert seen["hit"].all() and np.isnan(seen["motion_px"]).all()
    scene = room(1)
    seen = view_passes(scene, resolution=24, view=0, then_view=1)
    now, then = (
        pixel_places(seen["position_m"], scene.c2w[view], float(scene.fov_deg[view]), 24)
        for view in (0, 1)
    )
    np.testing.assert_allclose(seen["motion_px"], then - now, atol=1e-6)


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


def test_stored_passes_are_those_computed_and_none_twice(monkeypatch: pytest.MonkeyPatch) -> None:
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
    sample = with_passes(("triangle",))
    monkeypatch.setattr(passes, "MOST_IDS", 2)
    with pytest.raises(TrilightError, match="3 triangles; expected at most 2"):
        with_passes(("triangle",))
    monkeypatch.setattr(passes, "view_passes", None)
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


def test_words_mean_passes() -> None:
    assert pass_names(["normal", "depth", "depth_axis_m"]) == ("depth_axis_m", "shading_normal")
    assert pass_names(["roughness"]) == ("material_roughness",)
    assert StorageSettings(passes=("normal", "object")).passes == ("object", "shading_normal")
    with pytest.raises(TrilightError, match=r"no pass 'dept'; did you mean depth\?"):
        StorageSettings(passes=("dept",))
    with pytest.raises(TrilightError, match="motion_px needs another moment"):
        pass_names([MOTION])


def test_other_files_are_refused() -> None:
    for channels, resolution, message in [
        ({"A": 16, "Q.V": 16}, 16, "channels are A, Q.V; expected A"),
        ({"A": 16, "N.X": 16}, 16, "channels are A, N.X; expected A"),
        ({"Z": 16}, 16, r"channel A \(coverage\) is missing"),
        ({"A": 8}, 16, r"\[8, 8\] pixels; expected \[16, 16\]"),
    ]:
        with case(channels):
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
    for column in ("diffuse", "specular", "roughness", "emission"):
        assert np.isnan(seen[f"material_{column}"][~met]).all()
    assert np.ptp(diffuse, axis=0).min() > 0.1  # it is a texture that was looked up


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
    bare, lit = (
        view_passes(scene, resolution=RESOLUTION)
        for scene in (tiny_scene(), tiny_scene(environment=sky(is_seen=True)))
    )
    assert "uv" not in bare and bare.keys() == lit.keys()
    for name, values in bare.items():
        np.testing.assert_array_equal(lit[name], values)
    assert np.isnan(view_passes(tiny_scene(), ["uv"], resolution=RESOLUTION)["uv"]).all()
    # not even at hits, where other programs would spread it; asked for, they are NaN as ever
    names = ["uv", "shading_normal"]
    for scene, there in ((tiny_scene(), set()), (textured_scene(), {"uv"})):
        packed = passes_exr(scene, names, view=0, resolution=RESOLUTION)
        channels = {channel.name for channel in read_header(packed)["channels"]}
        assert {name for name in channels if name.startswith("uv")} == (
            {"uv.U", "uv.V"} if there else set()
        )
        found = decode_passes_exr(packed, RESOLUTION)
        assert set(found) == {"coverage", "shading_normal"} | there
        raw = decode_channels(packed, sorted(channels), separate=True)
        assert not any(np.isnan(plane).any() for plane in raw.values())
        again = picture_passes(scene, names, view=0, resolution=RESOLUTION, stored=packed)
        plain = picture_passes(scene, names, view=0, resolution=RESOLUTION)
        for name in names:
            np.testing.assert_array_equal(again[name], plain[name])
