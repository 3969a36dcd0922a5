"""Passes of textured scenes: coordinates and material columns in closed form, on a flat floor."""

import numpy as np

from storage.records.exr import channel_names, decode_channels
from storage.records.first_hits import first_hits
from storage.records.lookup import texture_values
from storage.records.passes.pictures import view_passes
from storage.records.passes.stored import decode_passes_exr, passes_exr, picture_passes
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.textured_by_hand import sky, textured_scene

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


def test_a_scene_without_textures_has_no_coordinates() -> None:
    for scene in (tiny_scene(), tiny_scene(environment=sky())):
        assert "uv" not in view_passes(scene, resolution=RESOLUTION)
        assert np.isnan(view_passes(scene, ["uv"], resolution=RESOLUTION)["uv"]).all()


def test_a_sky_changes_no_pass() -> None:
    plain = view_passes(tiny_scene(), resolution=RESOLUTION)
    lit = view_passes(tiny_scene(environment=sky(is_seen=True)), resolution=RESOLUTION)
    for name, values in plain.items():
        np.testing.assert_array_equal(lit[name], values)


def test_coordinates_go_through_a_file() -> None:
    scene = textured_scene()
    names = ["uv", "material_diffuse"]
    found = decode_passes_exr(passes_exr(scene, names, view=0, resolution=RESOLUTION), RESOLUTION)
    for name, values in view_passes(scene, names, resolution=RESOLUTION).items():
        np.testing.assert_array_equal(found[name], values.astype(np.float32))


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
