"""Pictures by part: they come back exactly, and their sum is the picture, as verify demands."""

import dataclasses
import io
import json
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from storage.dataset.manifest import Manifest
from storage.dataset.verify import check_sample
from storage.errors import TrilightError
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import MAX_LIGHTS, rounded_to_half, sum_of_lights
from storage.records.parts import (
    KNOWN_PARTS,
    decode_parts_exr,
    encode_parts_exr,
    part_names,
    sum_of_parts,
)
from storage.records.sample import PartFloor, Sample, decode_sample, decode_scene, encode_sample
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_sample

SIZE = (16, 16)
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
    rng = np.random.default_rng(seed)
    return {
        name: rounded_to_half(
            (rng.exponential(size=(*shape, 3)) * 10.0 ** rng.uniform(-4, 3)).astype(np.float32)
        )
        for name in names
    }


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


def _faults(sample: Sample, **renders: Any) -> list[str]:
    manifest = Manifest(
        build="x",
        settings={"renders": {"resolution": 16, **renders}},
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


@for_each("lights", [None, 1, 3])
@for_each("names", KNOWN_PARTS)
def test_parts_come_back_exactly(names: tuple[str, ...], lights: int | None) -> None:
    parts = _parts(names, SIZE if lights is None else (lights, *SIZE))
    data = encode_parts_exr(parts)
    back = decode_parts_exr(data, names, SIZE, lights)
    assert tuple(back) == names
    for name in names:
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], parts[name])
    channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    prefix = "" if lights is None else f"light{lights - 1}."
    green = parts[names[1]] if lights is None else parts[names[1]][-1]
    np.testing.assert_array_equal(channels[f"{prefix}{names[1]}.G"].pixels, green[..., 1])


@for_each("names", KNOWN_PARTS)
def test_the_stored_sum_is_exact(names: tuple[str, ...]) -> None:
    """Parts and picture, each through its own file: the sum of the one is the other, bitwise."""
    for seed in range(5):
        parts = _parts(names, SIZE, seed)
        picture = decode_exr(encode_exr(sum_of_parts(parts)))
        back = decode_parts_exr(encode_parts_exr(parts), names, SIZE, None)
        np.testing.assert_array_equal(sum_of_parts(back), picture)
        # one rounding to half floats of the exact sum, and four to float32
        exact = np.sum([part.astype(np.float64) for part in parts.values()], axis=0)
        np.testing.assert_allclose(picture, exact, rtol=2**-11 + 4 * 2**-24, atol=6e-8)


@for_each(
    ("names", "size", "lights", "message"),
    [
        (KNOWN_PARTS[1], SIZE, None, "channels are direct.B"),
        (KNOWN_PARTS[0], SIZE, 1, "channels are direct.B"),
        (KNOWN_PARTS[0], (8, 16), None, r"parts: \[16, 16\] pixels; expected \[8, 16\]"),
        (KNOWN_PARTS[0], SIZE, MAX_LIGHTS // 2 + 1, "66 pictures; expected at most 64"),
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
    assert _faults(back, per_light=lights, **RENDERS[names]) == []
    del members["1.parts.exr"]
    with pytest.raises(TrilightError, match="1.parts.exr.*missing"):
        decode_sample(sample.key, members)


def test_a_sample_without_parts_is_written_as_ever() -> None:
    members = encode_sample(tiny_sample())
    assert not any("parts" in suffix for suffix in members)
    assert all("parts" not in view for view in json.loads(members["json"])["views"])
    back = decode_sample("000000000", members)
    assert back.parts_rgb is None and all(view.parts is None for view in back.views)


@for_each(
    "parts",
    [{}, 3, {"direct": {}}, {"direct": vars(FLOOR), "glossy": vars(FLOOR)},
     {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "noise_floor_db": True}},
     {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "noise_floor_db": 1e9}},
     {"direct": vars(FLOOR), "indirect": {**vars(FLOOR), "more": 1.0}}],
)  # fmt: skip
def test_a_record_of_no_parts_is_refused(parts: Any) -> None:
    members = encode_sample(_sample())
    record = json.loads(members["json"])
    record["views"][1]["parts"] = parts
    with pytest.raises(TrilightError, match=r"parts|unexpected keyword argument 'more'"):
        decode_scene("000000000", {**members, "json": json.dumps(record).encode()})


def test_verify_demands_the_sum() -> None:
    sample = _sample()
    assert "parts are direct, indirect; the settings" in _faults(sample)[0]
    assert "every view expect diffuse, specular" in _faults(sample, split_lobes=True)[0]
    assert "parts are none" in _faults(tiny_sample(), split=True)[0]
    views = (sample.views[0], dataclasses.replace(sample.views[1], parts=None))
    assert _faults(dataclasses.replace(sample, views=views), split=True)
    pictures = sample.radiance_rgb.copy()
    pictures[1, 3, 5, 2] = np.nextafter(np.float16(pictures[1, 3, 5, 2]), np.float16(np.inf))
    (fault,) = _faults(dataclasses.replace(sample, radiance_rgb=pictures), split=True)
    assert "view 1 has a picture that is not the sum of its parts in 1 pixels" in fault
    assert fault.endswith("first in (3, 5)")
    both = _sample(lights=True)
    assert both.parts_rgb is not None
    wrong = {name: 2 * part for name, part in both.parts_rgb.items()}
    faults = _faults(dataclasses.replace(both, parts_rgb=wrong), split=True, per_light=True)
    assert len(faults) == 2 and "a light that is not the sum" in faults[0]


def test_light_that_is_not_finite_is_refused() -> None:
    for lights in (False, True):
        sample = _sample(lights=lights)
        assert sample.parts_rgb is not None
        sample.parts_rgb["indirect"].flat[5] = np.nan
        with pytest.raises(TrilightError, match="view 0 indirect light has radiance nan"):
            sample.check()
