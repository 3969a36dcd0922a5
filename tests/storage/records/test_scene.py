"""Every law of a scene and its maps is stated, and its error names the field and the index.

Scene and asset files come back exactly; what is none is refused before it takes memory.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import decode_asset, encode_asset
from storage.records.lookup import FLAT
from storage.records.retextured import (
    NEW,
    chosen_maps,
    with_textures,
    without_constant_textures,
    without_maps,
    without_normal_maps,
)
from storage.records.sample import encode_sample
from storage.records.scene import ARRAY_FIELDS, Scene, SceneObject
from storage.records.scene_facts import textured_objects
from storage.records.scene_file import (
    MAX_FILE_BYTES,
    decode_arrays,
    decode_scene_file,
    encode_arrays,
    encode_scene,
    read_scene_file,
    scene_digest,
)
from storage.records.texture import MAX_MAPS_BYTES, MapSource, Texture
from tests.for_each import case, for_each
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE, small_pool
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_sample, tiny_scene
from tests.textured_by_hand import (
    bumps,
    bumpy_scene,
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


@for_each("field", ARRAY_FIELDS)
def test_another_dtype_or_shape_and_values_that_are_not_finite_are_named(field: str) -> None:
    array = getattr(tiny_scene(), field)
    with pytest.raises(TrilightError, match=f"{field} has dtype"):
        tiny_scene(**{field: array.astype(np.int8)}).check()
    with pytest.raises(TrilightError, match=f"{field} has shape"):
        tiny_scene(**{field: array[..., None]}).check()
    index = tuple(size - 1 for size in array.shape)
    for value in (np.nan, np.inf, -np.inf) if array.dtype == np.float32 else ():
        with pytest.raises(TrilightError, match=rf"{field}\[{index[0]}.*finite"):
            _changed(field, index, value).check()


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
    texels = number_texture().texels.copy()
    texels[1, 0, 0] = value
    rough = dataclasses.replace(number_texture(), texels=texels)
    return textured_scene(0, colour_texture(), rough)


def _normals(rows: list[int]) -> Scene:
    return bumpy_scene(normal_textures=np.array(rows, np.int32))


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
    (textured_scene(uv=_uv(0)[:-1]), r"uv has shape \(8, 2\)"),
    (textured_scene(uv=_uv(0).astype(np.float64)), "uv has dtype float64"),
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
    (_normals([3, -1]), r"normal_textures\[0\] is 3; expected rows below 3"),
    (_normals([-1, -1]), r"textures\[2\] is used by no"),
    (_normals([2, 1]), r"textures\[1\] has 1 channels; expected 3 linear channels, as a normal"),
    (_normals([0, 2]), r"textures\[0\] has 3 channels, sRGB-encoded"),
    (_normals([2, -1, -1]), r"normal_textures has shape \(3,\)"),
    (tiny_scene(normal_textures=np.array([-1, -1], np.int32)), "normal_textures is there without"),
    (_coloured(_even(0.9)), r"materials\[0\] with its textures: diffuse \+ specular\[0\] is 1.1"),
    (_below(radiance_rgb=_even(math.nan)), r"radiance_rgb\[0, 0, 0\] is nan"),
    (_below(radiance_rgb=_even(-1)), r"is -1\.; expected finite values from 0 to 1e\+09"),
    (_below(radiance_rgb=_even(math.inf)), "is inf"),
    (_below(radiance_rgb=_even(1e10)), r"is 1\.e\+10; expected finite values from 0 to 1e"),
    (_below(radiance_rgb=_even(1, height=2)), "twice the height"),
    (_below(radiance_rgb=_even(1, dtype=np.float16)), "dtype float16"),
    (_below(rotation=MIRROR[:3, :3]), "without mirroring"),
    (_below(rotation=np.full((3, 3), math.nan, np.float32)), "orthonormal"),
    (_below(rotation=np.eye(4, dtype=np.float32)), r"\(3, 3\)"),
]


def test_valid_scenes_pass_and_a_sky_is_light_enough_unless_it_is_black() -> None:
    """One of them has an albedo that sums to 1 in float32."""
    third = np.float32(1 / 3)
    whole = _changed("materials", (0, slice(6)), [np.float32(1) - third] * 3 + [third] * 3)
    lit = textured_scene(environment=sky())
    for scene in (tiny_scene(), whole, lit, _below(is_seen=True), bumpy_scene()):
        scene.check()
    # without an emitter, a scene is lit by its environment or not at all
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


def test_a_broken_law_names_field_value_and_index() -> None:
    for scene, message in BROKEN:
        with case(message), pytest.raises(TrilightError, match=message) as caught:
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


def test_albedos_are_compared_where_they_meet_and_between_texels_of_other_sizes() -> None:
    """What one texture reflects more where another reflects less is no more than all."""
    stripes = np.array([[0.9, 0.1]])
    _two(stripes, 1 - stripes).check()
    with pytest.raises(TrilightError, match="at every texture coordinate"):
        _two(stripes, stripes / 2).check()
    # Slow twin: the sum on a fine grid comes near the sum that the law finds, from below.
    from storage.records.lookup import texture_values
    from storage.records.scene import _greatest_sum

    rng = np.random.default_rng(3)
    for size, other in (((3, 4), (2, 5)), ((1, 7), (6, 1)), ((4, 4), (8, 8))):
        one, two = (Texture(texels=rng.random((*shape, 3), np.float32)) for shape in (size, other))
        side = (np.arange(500) + 0.5) / 500
        uv = np.stack(np.meshgrid(side, side), axis=-1)
        fine = (texture_values(one, uv) + texture_values(two, uv)).max(axis=(0, 1))
        found = _greatest_sum(one, two)
        # the grid's lines are 1/1000 from any place, and the slopes are below 2 * 8 a unit
        assert (fine <= found + 1e-12).all() and (found - fine <= 2 * 16 / 1000).all()


def test_constant_textures_leave_the_bytes_of_a_scene_without_and_go_alone() -> None:
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
    grey = Texture(texels=np.full((2, 2, 3), 51, np.uint8))
    scene = textured_scene(0, grey, number_texture())
    left = without_constant_textures(scene)
    left.check()
    assert [texture.sha256 for texture in left.textures] == [number_texture().sha256]
    assert left.material_textures is not None
    assert left.material_textures.tolist() == [[-1, -1, 0], [-1, -1, -1]]
    assert (left.materials[FLOOR, :3] == np.float32(0.2)).all()
    assert without_constant_textures(left) is left


def test_a_flat_normal_map_is_none_and_a_scene_keeps_the_others() -> None:
    flat = Texture(texels=np.full((3, 3, 3), FLAT, np.float32))
    plain = textured_scene()
    smooth = bumpy_scene(textures=(*plain.textures, flat))
    smooth.check()
    assert encode_arrays(smooth) == encode_arrays(plain)
    scene = bumpy_scene()
    assert scene_digest(scene) != scene_digest(plain)
    assert decode_scene_file(encode_scene(scene), "a").normal_textures.tolist() == [2, -1]  # type: ignore[union-attr]
    assert encode_scene(decode_scene_file(encode_scene(scene), "a")) == encode_scene(scene)
    assert encode_arrays(without_normal_maps(scene)) == encode_arrays(plain)
    assert without_maps(scene).normal_textures is None
    chosen = chosen_maps(scene, np.array([0, NEW]), np.array([NEW, FLOOR]))
    assert chosen["normal_textures"].tolist() == [-1, 2] and len(chosen["textures"]) == 3
    only = bumpy_scene(material_textures=np.full((2, 3), -1, np.int32), textures=(bumps(),))
    only = dataclasses.replace(only, normal_textures=np.array([0, -1], np.int32))
    only.check()
    assert textured_objects(only) == {0}


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


def test_a_digest_is_that_of_the_member_in_a_shard_and_covers_what_surfaces_look_like() -> None:
    sample = tiny_sample()
    member = encode_sample(sample)["scene.safetensors"]
    assert scene_digest(sample.scene) == sha256_hex(member)
    scenes = [
        tiny_scene(),
        tiny_scene(fov_deg=np.array([45, 41], np.float32)),
        textured_scene(),
        textured_scene(1),
        textured_scene(environment=sky()),
        textured_scene(environment=sky(1)),
        textured_scene(environment=sky(is_seen=True)),
        textured_scene(environment=sky(rotation=np.eye(3, dtype=np.float32))),
    ]
    assert len({scene_digest(scene) for scene in scenes}) == len(scenes)
    renamed = textured_scene(environment=dataclasses.replace(sky(), source=number_texture().source))
    assert scene_digest(renamed) == scene_digest(scenes[4])
    assert scene_digest(tiny_scene(provenance={})) == scene_digest(tiny_scene())


KEY = "trilight_scene"


def _metadata() -> dict[str, Any]:
    """Return what the file of the tiny scene says beside its arrays."""
    data = encode_scene(tiny_scene())
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    found: dict[str, Any] = json.loads(header["__metadata__"][KEY])
    return found


def test_round_trip_is_exact_also_of_names_without_utf8_and_fields_that_are_not_known() -> None:
    odd = SceneObject(
        name='floor "ü" \n', kind="shell", licence="MIT", attribution="Ö", source_url="x"
    )
    scene = tiny_scene(objects=(odd, SceneObject(name="light", kind="emitter")))
    back = decode_scene_file(encode_scene(scene), "a")
    for name, (dtype, _) in ARRAY_FIELDS.items():
        assert getattr(back, name).dtype == dtype
        assert np.array_equal(getattr(back, name), getattr(scene, name))
    assert back.objects == scene.objects
    assert back.provenance == scene.provenance
    assert encode_scene(back) == encode_scene(scene)
    # Names of files may hold lone surrogates: they neither meet in one name nor stop a reader.
    objects = (
        SceneObject(name="x\udcfe", kind="shell"),
        SceneObject(name="x\udcff", kind="emitter", uid="\udcff"),
    )
    dusk = dataclasses.replace(sky(), source=MapSource(name="dusk\udcff"))
    scene = tiny_scene(objects=objects, provenance={"file\udcff": ["\udcff"]}, environment=dusk)
    data = encode_scene(scene)
    found = decode_scene_file(data, "a")
    assert encode_scene(found) == data
    assert (found.objects, found.provenance) == (objects, scene.provenance)
    assert found.environment is not None and found.environment.source == dusk.source
    assert decode_scene_file(_stating(caption="x"), "a").objects == tiny_scene().objects


ARRAYS = {name: getattr(tiny_scene(), name) for name in ARRAY_FIELDS}


def _stating(**changes: Any) -> bytes:
    """Return the file of the tiny scene with other metadata."""
    return save(ARRAYS, {KEY: json.dumps(_metadata() | changes)})


def _with_object(**changes: Any) -> bytes:
    floor, light = _metadata()["objects"]
    return _stating(objects=[floor, light | changes])


def _with_arrays(**changes: Any) -> bytes:
    arrays = {name: each for name, each in (ARRAYS | changes).items() if each is not None}
    return save(arrays, {KEY: json.dumps(_metadata())})


def test_arrays_and_metadata_are_exactly_those_of_a_scene() -> None:
    for data, message in [
        (_with_arrays(faces=None), "missing or not expected: 'faces'"),
        (_with_arrays(extra=ARRAYS["fov_deg"]), "missing or not expected: 'extra'"),
        (_with_arrays(faces=ARRAYS["faces"].astype(np.int64)), "dtype int64; expected uint32"),
        (save(ARRAYS), f"metadata {KEY} are missing"),
        (save(ARRAYS, {KEY: "[" * 100_000}), "not JSON"),
        (_stating(schema_version=99), "schema version 99"),
        (_stating(schema_version=None), "schema version None"),
        (_stating(objects={}), "objects is {}"),
        (_stating(objects=[1, 2]), r"objects\.0 is 1"),
        (_stating(objects=[{"name": "x", "kind": "shell"}]), r"objects\.0\.uid is missing"),
        (_with_object(kind="lamp"), r"objects\.1\.kind is .* expected object, shell or emitter"),
        (_with_object(name=3), r"objects\.1\.name is "),
        (_with_object(uid=["x"]), r"objects\.1\.uid is "),
        (_stating(provenance=[]), r"provenance is \[\]"),
        (_stating(provenance={"template": [5]}), r"provenance.template is \[5\]; expected text"),
        (_stating(provenance={"excursion": {"axis": "x"}}), "excursion is .* expected an axis"),
        (_stating(provenance={"x": float("nan")}), "provenance is .*nan.*finite numbers"),
    ]:
        with case(data):
            with pytest.raises(TrilightError, match=f"^a.safetensors: .*{message}") as caught:
                decode_scene_file(data, "a.safetensors")
            assert "\n" not in str(caught.value)


def test_a_type_that_numpy_has_not_and_every_flipped_byte_are_one_clear_line() -> None:
    """In the file of a scene and in a sample, where the library raises a KeyError."""
    header = json.dumps({"x": {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}}).encode()
    data = len(header).to_bytes(8, "little") + header + bytes(2)
    with pytest.raises(TrilightError, match="^a: safetensors: unreadable"):
        decode_scene_file(data, "a")
    with pytest.raises(TrilightError, match="^safetensors: unreadable"):
        decode_arrays(data)
    # no damage ends in anything but a lawful scene or a TrilightError
    data, rng = encode_scene(tiny_scene()), np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(data), 400):
        damaged = bytearray(data)
        damaged[at] ^= int(rng.integers(1, 256))
        try:
            decode_scene_file(bytes(damaged), "a").check()
        except TrilightError:
            refused += 1
    assert refused > 100


def test_no_file_is_written_that_would_be_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    size = len(encode_scene(tiny_scene()))
    monkeypatch.setattr("storage.records.scene_file.MAX_FILE_BYTES", size)
    assert decode_scene_file(encode_scene(tiny_scene()), "a").objects == tiny_scene().objects
    monkeypatch.setattr("storage.records.scene_file.MAX_FILE_BYTES", size - 1)
    with pytest.raises(TrilightError, match=f"takes {size} bytes"):
        encode_scene(tiny_scene())
    with pytest.raises(TrilightError, match="fov_deg"):
        encode_scene(tiny_scene(fov_deg=np.array([45, 181], np.float32)))


def test_a_large_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.safetensors"
    with path.open("wb") as stream:
        stream.truncate(MAX_FILE_BYTES + 1)  # a hole: it takes no room
    with pytest.raises(TrilightError, match="large.safetensors: expected a file of at most"):
        read_scene_file(path)
    with pytest.raises(TrilightError, match="cannot be read"):
        read_scene_file(tmp_path / "absent.safetensors")
    path.write_bytes(encode_scene(tiny_scene()))
    assert read_scene_file(path).objects == tiny_scene().objects


def test_an_asset_survives_the_file_and_what_is_none_is_refused_in_one_line() -> None:
    ball = small_pool()[0].asset
    quality = dataclasses.replace(QUALITY, error_p99=1 / 3, open_edges=7)
    levels = []
    for each in ball.levels:
        record = dataclasses.replace(each.record, method="meshoptimizer", quality=quality)
        levels.append(dataclasses.replace(each, record=record))
    source = dataclasses.replace(SOURCE, num_faces_turned=3, front_share=0.1)
    asset = dataclasses.replace(ball, source=source, levels=tuple(levels))
    again = decode_asset(encode_asset(asset))
    for field in ("geometry_sha256", "source_sha256", "recipe", "source"):
        assert getattr(again, field) == getattr(asset, field)
    for here, there in zip(asset.levels, again.levels, strict=True):
        assert there.record == here.record
        assert (there.positions.dtype, there.faces.dtype) == (np.float32, np.uint32)
        assert np.array_equal(there.positions, here.positions)
        assert np.array_equal(there.faces, here.faces)
    assert encode_asset(again) == encode_asset(asset)
    weight = {"weight": np.zeros(3, np.float32)}
    headers = (
        "not JSON", "[]", '{"levels": [{}]}', '{"levels": [{"quality": {}}]}',
        '{"levels": [], "source": {}}', '{"levels": [], "source": 3}',
    )  # fmt: skip
    for metadata in (None, *({"asset": header} for header in headers)):
        with pytest.raises(TrilightError, match="asset: .*weight.* does not hold one") as refused:
            decode_asset(save(weight, metadata))
        assert "\n" not in str(refused.value)
    data = encode_asset(asset)
    part = len(data) // 5
    for bad in (b"", b"hello", bytes(100), b"\xff" * 100, data[:part], data[: 4 * part]):
        with case(bad[:9]), pytest.raises(TrilightError):
            decode_asset(bad)


def test_judgements_follow_from_the_facts() -> None:
    assert SOURCE.watertight and not SOURCE.repaired
    assert not dataclasses.replace(SOURCE, open_edges=1).watertight
    assert not dataclasses.replace(SOURCE, nonmanifold_edges=1).watertight
    assert dataclasses.replace(SOURCE, num_faces_turned=1).repaired
    assert dataclasses.replace(SOURCE, num_faces=SOURCE.num_faces_read - 1).repaired
