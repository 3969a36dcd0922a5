"""Columns of a material: what may be declared, and what files say of them."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from storage.errors import TrilightError
from storage.records.material import (
    DIFFUSE,
    EMISSION,
    PUBLISHED_COLUMNS,
    REFLECTING,
    ROUGHNESS,
    SPECULAR,
    completed_rows,
    default_rows,
    laid_out,
    material_width,
)
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene_file import decode_arrays, encode_arrays, scene_digest
from storage.settings.ranges import Within
from tests.columns_kit import COAT, TINT, WAVES, declared
from tests.for_each import case
from tests.scenes_by_hand import FLOOR, tiny_sample, tiny_scene


def test_the_published_columns_stand_where_files_and_kernels_expect_them() -> None:
    assert (DIFFUSE, SPECULAR, ROUGHNESS, EMISSION) == (slice(0, 3), slice(3, 6), 6, slice(7, 10))
    assert slice(0, 7) == REFLECTING
    assert material_width() == 10


def test_a_declaration_that_means_nothing_is_refused() -> None:
    meaningless: list[tuple[dict[str, Any], str]] = [
        ({"name": "Clear coat"}, "has the name; expected lower case letters"),
        ({"width": 0}, "a width of 0; expected a whole number from 1 to 64"),
        ({"width": 2, "is_colour": True}, "a width of 2; expected 3, since it is a color"),
        ({"within": Within(0, np.inf)}, "expected one within the finite float32 numbers"),
        ({"default": 2.0}, "the default 2.0; expected a number from 0 to 1"),
        ({"within": Within(-1, 1), "is_log_encoded": True}, "since networks read its log"),
    ]
    for changes, message in meaningless:
        with case(changes), pytest.raises(TrilightError, match=message):
            dataclasses.replace(COAT, **changes)


def test_scenes_have_every_declared_column_within_its_range() -> None:
    four = tiny_scene()
    with declared(WAVES):
        with pytest.raises(TrilightError, match=r"shape \(2, 10\); expected \(None, 15\).*, waves"):
            four.check()
        scene = tiny_scene()
        scene.check()
        assert (scene.materials[:, 10:] == 0.5).all()
        scene.materials[FLOOR, 12] = 1.5
        with pytest.raises(
            TrilightError, match=r"materials\[0, 12\] is 1.5; expected waves from -1"
        ):
            scene.check()


def test_the_order_of_declarations_is_each_process_s_own() -> None:
    rng = np.random.default_rng(0)
    with declared(COAT, TINT, WAVES):
        scene = tiny_scene()
        for column, part in laid_out():
            if column.name not in PUBLISHED_COLUMNS:
                scene.materials[FLOOR, part] = rng.random(column.width)
        stored = encode_arrays(scene)
        places = {column.name: part for column, part in laid_out()}
    with declared(WAVES, COAT, TINT):
        back = decode_arrays(stored)["materials"]
        for column, part in laid_out():
            assert np.array_equal(back[:, part], scene.materials[:, places[column.name]])


def test_only_columns_in_use_are_stored_and_digests_know_their_names() -> None:
    plain = encode_arrays(tiny_scene())
    sheen = dataclasses.replace(COAT, name="sheen")
    digests = {scene_digest(tiny_scene())}
    for column in (COAT, sheen):
        with declared(WAVES, column):
            scene = tiny_scene()
            assert encode_arrays(scene) == plain
            scene.materials[FLOOR, -1] = 0.25
            assert load(encode_arrays(scene))["materials"].shape == (2, 11)
            digests.add(scene_digest(scene))
    assert len(digests) == 3


def test_a_sample_carries_its_columns_and_an_older_one_is_completed() -> None:
    older = encode_sample(tiny_sample())
    with declared(COAT):
        assert decode_sample("0", older).scene.materials.shape == (2, 11)
        sample = tiny_sample()
        sample.scene.materials[FLOOR, -1] = 0.25
        members = encode_sample(sample)
        back = decode_sample("0", members)
        assert np.array_equal(back.scene.materials, sample.scene.materials)
    with pytest.raises(TrilightError, match="sample 0: .*'coat' is not declared here"):
        decode_sample("0", members)
    with (
        declared(dataclasses.replace(COAT, width=2, draw=None)),
        pytest.raises(TrilightError, match="'coat' has a width of 1 in the file; expected 2"),
    ):
        decode_sample("0", members)


def test_columns_that_a_file_states_badly_and_other_numbers_than_they_are_refused() -> None:
    rows = np.zeros((2, 2), np.float32)
    for stated in ("", '["coat"]', '[["coat", "wide"]]', '[["coat", 1], ["coat", 1]]', "[" * 9999):
        with case(stated), declared(COAT):
            with pytest.raises(TrilightError, match="scene: its material columns"):
                completed_rows(rows, stated)
    arrays = load(encode_arrays(tiny_scene()))
    arrays["materials"] = default_rows(2)[:, :9].copy()
    with pytest.raises(TrilightError, match=r"shape \(2, 9\); expected \(None, 10\)"):
        decode_arrays(save(arrays))
    stated = json.dumps([["roughness", 1], ["diffuse", 3]])
    rows = completed_rows(np.array([[1, 2, 3, 4]], np.float32), stated)
    assert rows.tolist() == [[2, 3, 4, 0, 0, 0, 1, 0, 0, 0]]
