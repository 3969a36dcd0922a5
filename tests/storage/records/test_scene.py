"""Every law of a scene and its maps is stated, and its error names the field and the index."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from storage.errors import TrilightError
from storage.records.retextured import (
    with_textures,
    without_constant_textures,
    without_maps,
)
from storage.records.sample import encode_sample
from storage.records.scene import ARRAY_FIELDS, Scene, SceneObject
from storage.records.scene_file import encode_arrays, encode_scene, scene_digest
from storage.records.texture import MAX_MAPS_BYTES, Texture
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_sample, tiny_scene
from tests.textured_by_hand import (
    colour_texture,
    corner_uv,
    number_texture,
    sky,
    textured_scene,
)


def _changed(field: str, index: Any, value: Any) -> Scene:
    array = getattr(tiny_scene(), field).copy()
    array[index] = value
    return tiny_scene(**{field: array})


@for_each("field", [n for n, (d, _) in ARRAY_FIELDS.items() if d is np.float32])
@for_each("value", [np.nan, np.inf, -np.inf])
def test_non_finite_values_are_named(field: str, value: float) -> None:
    array = getattr(tiny_scene(), field)
    index = tuple(size - 1 for size in array.shape)
    with pytest.raises(TrilightError, match=rf"{field}\[{index[0]}.*finite"):
        _changed(field, index, value).check()


@for_each("field", ARRAY_FIELDS)
def test_another_dtype_or_shape_is_named(field: str) -> None:
    array = getattr(tiny_scene(), field)
    with pytest.raises(TrilightError, match=f"{field} has dtype"):
        tiny_scene(**{field: array.astype(np.int8)}).check()
    with pytest.raises(TrilightError, match=f"{field} has shape"):
        tiny_scene(**{field: array[..., None]}).check()


def test_albedo_that_sums_to_one_in_float32_is_legal() -> None:
    materials = tiny_scene().materials.copy()
    specular = np.float32(1 / 3)
    materials[0, :6] = [np.float32(1) - specular] * 3 + [specular] * 3
    tiny_scene(materials=materials).check()


def test_a_sky_is_light_enough_unless_it_is_black() -> None:
    """Without an emitter, a scene is lit by its environment or not at all."""
    plain = tiny_scene()
    materials = plain.materials.copy()
    materials[LIGHT, 7:] = 0
    objects = (plain.objects[0], dataclasses.replace(plain.objects[0], name="other"))
    dark: dict[str, Any] = {"materials": materials, "objects": objects}
    tiny_scene(**dark, environment=sky()).check()
    black = sky(radiance_rgb=np.zeros((1, 2, 3), np.float32))
    with pytest.raises(TrilightError, match="expected at least one emitter"):
        tiny_scene(**dark, environment=black).check()
    tiny_scene(environment=black).check()


def _with_texel(texture: Texture, value: float) -> Texture:
    texels = texture.texels.copy()
    texels[1, 0, 0] = value
    return dataclasses.replace(texture, texels=texels)


def _index(row: int, place: int, value: int) -> Scene:
    index = textured_scene().material_textures
    assert index is not None
    changed = index.copy()
    changed[row, place] = value
    return textured_scene(material_textures=changed)


def _uv(change: Any) -> np.ndarray:
    uv = corner_uv(tiny_scene())
    uv[4, 1] = change
    return uv


def _rough(value: float) -> Scene:
    return textured_scene(0, colour_texture(), _with_texel(number_texture(), value))


def _coloured(texels: np.ndarray, *, is_srgb: bool = False) -> Scene:
    return textured_scene(0, Texture(texels=texels, is_srgb=is_srgb), number_texture())


def _below(**changes: Any) -> Scene:
    return tiny_scene(environment=sky(**changes))


def _even(value: float, height: int = 1, dtype: Any = np.float32) -> np.ndarray:
    return np.full((height, 2, 3), value, dtype)


NO_CAMERA = {"c2w": np.zeros((0, 4, 4), np.float32), "fov_deg": np.zeros(0, np.float32)}
MIRROR = np.diag([-1, 1, 1, 1]).astype(np.float32)
BROKEN: list[tuple[Scene, str]] = [
    (_changed("faces", (1, 2), 7), r"faces\[1, 2\] is 7"),
    (_changed("material_index", 2, 2), r"material_index\[2\] is 2"),
    (_changed("object_index", 0, 9), r"object_index\[0\] is 9"),
    (_changed("vertex_normals", 3, [0, 0, 0.5]), r"vertex_normals\[3\] is 0.5"),
    (_changed("materials", (0, 6), 1.5), r"materials\[0, 6\] is 1.5.*roughness from 0 to 1"),
    (_changed("materials", (0, 0), -0.1), r"materials\[0, 0\] is -0.1.*diffuse from 0 to 1"),
    (_changed("materials", (0, 0), 0.9), r"materials\[0, 0\] is 1.1.*at most 1"),
    (_changed("materials", (1, 8), -1), r"materials\[1, 8\] is -1.*emission from 0"),
    (_changed("materials", (1, slice(7, 10)), 0), "no emission"),
    (_changed("fov_deg", 1, 180), r"fov_deg\[1\] is 180.*above 0 and below 180 degrees"),
    (_changed("c2w", (0, slice(0, 3), 0), 0), r"c2w\[0\].*orthonormal"),
    (_changed("c2w", (1, 3, 3), 2), r"c2w\[1\].*last row"),
    (_changed("object_index", 2, 0), r"objects\[2\] .*emitter exactly"),
    (tiny_scene(**NO_CAMERA), "one camera"),
    (tiny_scene(c2w=tiny_scene().c2w @ MIRROR), "without mirroring"),
    (tiny_scene(objects=(SceneObject(name="a", kind="shell"),) * 2), "'a' twice"),
    (tiny_scene(fov_deg=np.array([40], np.float32)), "fov_deg has 1 rows; expected 2"),
    (textured_scene(uv=None), "uv is missing"),
    (tiny_scene(uv=_uv(0)), "material_textures is missing"),
    (tiny_scene(textures=(colour_texture(),)), "uv is missing"),
    (textured_scene(uv=_uv(math.nan)), r"uv\[4, 1\] is nan"),
    (textured_scene(uv=_uv(1e6)), r"uv\[4, 1\] is 1.*-1024 to 1024"),
    (textured_scene(uv=_uv(0)[:-1]), r"uv is float32 of shape \(8, 2\)"),
    (textured_scene(uv=_uv(0).astype(np.float64)), "uv is float64"),
    (_index(LIGHT, 1, 2), r"material_textures\[1, 1\] is 2; expected rows below 2"),
    (_index(FLOOR, 0, -1), r"textures\[0\] is used by no"),
    (_index(LIGHT, 2, 0), r"textures\[0\] has 3 channels"),
    (textured_scene(0, colour_texture(), colour_texture()), "the content of another"),
    (_rough(math.nan), r"textures\[1\]\[1, 0, 0\] is nan"),
    (_rough(-1e-7), "from 0 to 1"),
    (_rough(1.001), "from 0 to 1"),
    (_coloured(_even(0.2), is_srgb=True), "sRGB-encoded in float32"),
    (_coloured(np.zeros((0, 4, 3), np.uint8)), "sides of 1 to 16384"),
    (_coloured(np.zeros((16385, 1, 3), np.uint8)), "sides of 1 to 16384"),
    (_coloured(np.zeros((2, 2, 2), np.uint8)), "1 or 3"),
    (_coloured(_even(0.9)), r"materials\[0\] with its textures: diffuse \+ specular\[0\] is 1.1"),
    (_below(radiance_rgb=_even(math.nan)), r"radiance_rgb\[0, 0, 0\] is nan"),
    (_below(radiance_rgb=_even(-1)), r"is -1\.; expected finite values from 0 to 1e\+09"),
    (_below(radiance_rgb=_even(math.inf)), "is inf"),
    (_below(radiance_rgb=_even(1, height=2)), "twice the height"),
    (_below(radiance_rgb=_even(1, dtype=np.float16)), "dtype float16"),
    (_below(rotation=MIRROR[:3, :3]), "without mirroring"),
    (_below(rotation=np.full((3, 3), math.nan, np.float32)), "orthonormal"),
    (_below(rotation=np.eye(4, dtype=np.float32)), r"\(3, 3\)"),
]


def test_valid_scenes_pass() -> None:
    for scene in (tiny_scene(), textured_scene(environment=sky()), _below(is_seen=True)):
        scene.check()


@for_each(("scene", "message"), BROKEN)
def test_a_broken_law_names_field_value_and_index(scene: Scene, message: str) -> None:
    with pytest.raises(TrilightError, match=message) as caught:
        scene.check()
    assert str(caught.value).startswith("scene: ") and "expected" in str(caught.value)


def test_all_maps_together_have_a_bound() -> None:
    """A view of one number takes no memory, and counts as what a copy of it would take."""
    wide = np.broadcast_to(np.uint8(0), (16384, 16384, 3))
    assert wide.nbytes > MAX_MAPS_BYTES
    with pytest.raises(TrilightError, match=f"expected at most {MAX_MAPS_BYTES}"):
        textured_scene(0, Texture(texels=wide), number_texture()).check()


def _two(diffuse: np.ndarray, specular: np.ndarray) -> Scene:
    index = np.array([[0, 1, -1], [-1, -1, -1]], np.int32)
    grey = [
        np.repeat(each[..., None], 3, axis=2).astype(np.float32) for each in (diffuse, specular)
    ]
    textures = tuple(Texture(texels=each) for each in grey)
    return textured_scene(0, *textures, material_textures=index)


def test_albedos_are_compared_where_they_meet() -> None:
    """What one texture reflects more where another reflects less is no more than all."""
    stripes = np.array([[0.9, 0.1]])
    _two(stripes, 1 - stripes).check()
    with pytest.raises(TrilightError, match="at every texture coordinate"):
        _two(stripes, stripes / 2).check()


def test_albedos_of_other_sizes_are_compared_between_their_texels() -> None:
    """Slow twin: the sum on a fine grid comes near the sum that the law finds, from below."""
    from storage.records.lookup import texture_values
    from storage.records.scene_maps import _greatest_sum

    rng = np.random.default_rng(3)
    for size, other in (((3, 4), (2, 5)), ((1, 7), (6, 1)), ((4, 4), (8, 8))):
        one, two = (Texture(texels=rng.random((*shape, 3), np.float32)) for shape in (size, other))
        side = (np.arange(500) + 0.5) / 500
        uv = np.stack(np.meshgrid(side, side), axis=-1)
        fine = (texture_values(one, uv) + texture_values(two, uv)).max(axis=(0, 1))
        found = _greatest_sum(one, two)
        # the grid's lines are 1/1000 from any place, and the slopes are below 2 * 8 a unit
        assert (fine <= found + 1e-12).all() and (found - fine <= 2 * 16 / 1000).all()


def test_a_scene_of_constant_textures_has_the_bytes_of_the_scene_without() -> None:
    plain = tiny_scene()
    colour = Texture(texels=np.full((5, 3, 3), plain.materials[FLOOR, :3], np.float32))
    rough = Texture(texels=np.full((1, 1, 1), plain.materials[FLOOR, 6], np.float32))
    constant = textured_scene(0, colour, rough)
    constant.materials[FLOOR, :3] = 0.125  # what untextured readers see says nothing here
    constant.check()
    assert encode_arrays(constant) == encode_arrays(plain)
    assert scene_digest(constant) == scene_digest(plain)
    assert encode_scene(constant) == encode_scene(plain)
    sample = tiny_sample()
    same = dataclasses.replace(sample, scene=constant)
    assert encode_sample(same) == encode_sample(sample)


def test_one_constant_texture_among_others_goes_alone() -> None:
    grey = Texture(texels=np.full((2, 2, 3), 51, np.uint8))
    scene = textured_scene(0, grey, number_texture())
    left = without_constant_textures(scene)
    left.check()
    assert [texture.sha256 for texture in left.textures] == [number_texture().sha256]
    assert left.material_textures is not None
    assert left.material_textures.tolist() == [[-1, -1, 0], [-1, -1, -1]]
    assert (left.materials[FLOOR, :3] == np.float32(0.2)).all()
    assert without_constant_textures(left) is left


def test_what_lies_beyond_a_reader_is_left_out() -> None:
    scene = textured_scene(environment=sky())
    plain = without_maps(scene)
    assert (plain.materials[FLOOR, :3] == colour_texture().mean).all()
    assert encode_arrays(plain) == encode_arrays(tiny_scene(materials=plain.materials))
    again = with_textures(plain, scene.uv, scene.textures, scene.material_textures)  # type: ignore[arg-type]
    assert (again.materials == plain.materials).all()
    assert encode_arrays(without_maps(again)) == encode_arrays(plain)
    kept = without_maps(scene, environment=False)
    assert kept.environment is scene.environment and not kept.textures


def test_a_digest_covers_what_surfaces_look_like() -> None:
    scenes = [
        tiny_scene(),
        textured_scene(),
        textured_scene(1),
        textured_scene(environment=sky()),
        textured_scene(environment=sky(1)),
        textured_scene(environment=sky(is_seen=True)),
        textured_scene(environment=sky(rotation=np.eye(3, dtype=np.float32))),
    ]
    assert len({scene_digest(scene) for scene in scenes}) == len(scenes)
    renamed = textured_scene(environment=dataclasses.replace(sky(), source=number_texture().source))
    assert scene_digest(renamed) == scene_digest(scenes[3])
