"""Pictures by light and by part: they come back exactly, and their sum is the picture."""

import dataclasses
import io
import itertools
import json
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.dataset.manifest import Manifest
from storage.dataset.verify import check_sample
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import (
    ALL_LIGHT,
    KNOWN_PARTS,
    MAX_LIGHTS,
    decode_parts_exr,
    encode_parts_exr,
    num_light_pictures,
    num_lights,
    part_names,
    rounded_to_half,
    sum_of_lights,
    sum_of_parts,
)
from storage.records.sample import PartFloor, Sample, decode_sample, decode_scene, encode_sample
from storage.records.scene import SceneObject
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_sample, tiny_scene
from tests.sky_maps import constant

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


def test_a_sum_beyond_half_floats_is_seen() -> None:
    lights = np.full((2, 8, 8, 3), HALF_FLOAT_MAX * 0.6, np.float32)
    assert np.isinf(sum_of_lights(rounded_to_half(lights))).all()


def test_a_sky_is_one_more_light_of_a_sample() -> None:
    scene = dataclasses.replace(_lit_sample().scene, environment=constant(0.5))
    assert num_light_pictures(scene) == 3 and num_lights(scene) == 2
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


def test_verify_demands_the_sum_of_lights() -> None:
    sample = _lit_sample()
    assert faults(sample, per_light=True) == []
    assert faults(tiny_sample()) == []  # a manifest from before there was the setting
    assert "has pictures by light" in faults(sample, per_light=False)[0]
    without = _lit_sample(lights_rgb=None)
    assert "lacks pictures by light" in faults(without, per_light=True)[0]
    (fault,) = faults(_one_bit_off(sample), per_light=True)
    assert "view 1 is not the sum of its lights in 1 pixels, first in (3, 5)" in fault


FLOOR = PartFloor(noise_floor_db=40.5, noise_floor_linear_db=30.25, object_noise_floor_db=39.0)
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


LIGHTS = [((ALL_LIGHT,), count) for count in (1, 2, 12, MAX_LIGHTS)]


@for_each(("names", "lights"), [*LIGHTS, *itertools.product(KNOWN_PARTS, [None, 1, 3])])
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


@for_each(
    ("names", "size", "lights", "message"),
    [
        (KNOWN_PARTS[1], SIZE, None, "channels are direct.B"),
        (KNOWN_PARTS[0], SIZE, 1, "channels are direct.B"),
        (KNOWN_PARTS[0], (8, 16), None, r"parts: \[16, 16\] pixels; expected \[8, 16\]"),
        (KNOWN_PARTS[0], SIZE, MAX_LIGHTS // 2 + 1, "parts: 66 pictures; expected at most 64"),
        ((ALL_LIGHT,), SIZE, MAX_LIGHTS + 1, "lights: 65 pictures; expected at most 64"),
        ((ALL_LIGHT,), (16, 24), 2, r"lights: \[16, 16\] pixels; expected \[16, 24\]"),
    ],
)
def test_other_parts_are_refused(
    names: tuple[str, ...], size: tuple[int, int], lights: int | None, message: str
) -> None:
    data = encode_parts_exr(_parts(KNOWN_PARTS[0], SIZE))
    with pytest.raises(TrilightError, match=message):
        decode_parts_exr(data, names, size, lights)


@for_each("lights", [False, True])
@for_each("names", KNOWN_PARTS)
def test_a_sample_with_parts_comes_back_and_verify_accepts_it(
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


def test_a_sample_without_parts_and_lights_is_written_as_ever() -> None:
    members = encode_sample(tiny_sample())
    assert not any("parts" in suffix or "lights" in suffix for suffix in members)
    assert all("parts" not in view for view in json.loads(members["json"])["views"])
    back = decode_sample("000000000", members)
    assert back.lights_rgb is back.parts_rgb is None
    assert all(view.parts is None for view in back.views)


@for_each(
    "parts",
    [{}, 3, {"direct": {}}, {"direct": vars(FLOOR), "glossy": vars(FLOOR)},
     {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "noise_floor_db": 1e9}},
     {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "more": 1.0}}],
)  # fmt: skip
def test_a_record_of_no_parts_is_refused(parts: Any) -> None:
    members = encode_sample(_sample())
    record = json.loads(members["json"])
    record["views"][1]["parts"] = parts
    with pytest.raises(TrilightError, match=r"views\.1\.parts"):
        decode_scene("000000000", {**members, "json": json.dumps(record).encode()})


def test_verify_demands_the_sum_of_parts() -> None:
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


def test_light_that_is_not_finite_is_refused() -> None:
    for lights in (False, True):
        sample = _sample(lights=lights)
        assert sample.parts_rgb is not None
        sample.parts_rgb["indirect"].flat[5] = np.nan
        with pytest.raises(TrilightError, match="view 0 .*indirect light has radiance nan"):
            sample.check()
