"""Every dataset preset is complete, and is stored as it is; its numbers stand by their digests."""

import json
import types
from typing import Any, cast

import pytest

from pipeline.presets.registry import DATASET_PRESETS, frozen_note, object_source, preset_settings
from pipeline.presets.settings import DatasetSettings, differences
from pipeline.renders.settings import NoiseTargets
from storage.dataset.splits import split_of_object, split_of_shard
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError
from storage.settings.described import from_record
from tests.for_each import for_each

JUDGED = ["out-of-range", "out-of-range-2", "benchmark-v1", "benchmark-v1-mini"]


@for_each("name", DATASET_PRESETS)
def test_settings_survive_the_manifest(name: str) -> None:
    build = preset_settings(name)
    stored = json.loads(json.dumps(build.as_json()))
    assert stored == build.as_json()
    again = from_record(DatasetSettings, stored)
    assert again.as_json() == stored and again.digest == build.digest
    assert build.build == ("benchmark-v1" if name == "benchmark-v1-mini" else name)


@for_each("name", DATASET_PRESETS)
def test_what_is_named_changes_and_nothing_else(name: str) -> None:
    before = preset_settings(name)
    after = preset_settings(
        name,
        seed=7,
        resolution=64,
        noise_targets=NoiseTargets(log_db=33.0),
        changes={"scenes.num_views": 3},
    )
    found = {path: value for path, _, value in differences(before.as_json(), after.as_json())}
    expected: dict[str, Any] = {"seed": 7, "renders.resolution": 64}
    expected |= {"renders.noise_floor_db": 33.0, "scenes.num_views": 3}
    if before.renders.noise_floor_objects_db is not None:
        expected["renders.noise_floor_objects_db"] = None  # a target replaces all
    assert found == expected
    assert after.digest != before.digest


def test_floors_licences_and_mistakes_of_a_build() -> None:
    plain = preset_settings("smoke").renders
    linear = preset_settings("smoke", noise_targets=NoiseTargets(linear_db=33.0))
    assert linear.renders.targets_db == {"psnr_linear_db": 33.0}
    added = preset_settings("smoke", changes={"renders.noise_floor_linear_db": 33.0})
    assert added.renders.targets_db == {**plain.targets_db, "psnr_linear_db": 33.0}
    assert from_record(DatasetSettings, linear.as_json()) == linear
    assert len({each.digest for each in (preset_settings("smoke"), linear, added)}) == 3
    usual = preset_settings("smoke").allowed_licences
    more = preset_settings("smoke", allow_licences=("ZZ-1.0", "AA-1.0", usual[0])).allowed_licences
    assert more == tuple(sorted({*usual, "ZZ-1.0", "AA-1.0"}))
    with pytest.raises(TrilightError, match=r"'smok' is unknown; did you mean smoke\? Expected"):
        preset_settings("smok")
    with pytest.raises(TrilightError, match=r"scenes\.lights\.number"):
        preset_settings("smoke", changes={"scenes.lights.number": 3})
    with pytest.raises(TrilightError, match="'seed' is -1"):
        preset_settings("smoke", seed=-1)


@for_each("name", JUDGED)
def test_all_that_is_judged_is_of_the_test_split(name: str) -> None:
    splits = preset_settings(name).splits
    assert {split_of_shard(shard, splits) for shard in range(50)} == {"test"}
    assert {split_of_object(f"{number:064x}", splits) for number in range(50)} == {"test"}
    assert {split_of_object("f" * 64, splits)} == {"test"}
    # Whole shards: no scene is made beyond those that are promised.
    assert DATASET_PRESETS[name].num_scenes % splits.scenes_per_shard == 0


def test_a_turn_of_the_test_sets_is_whole() -> None:
    """Every excursion meets every layout once, and every layout has its share of the benchmark."""
    strange = preset_settings("out-of-range").scenes
    assert len({(one.axis, one.value) for one in strange.excursions}) == 37
    assert DATASET_PRESETS["out-of-range"].num_scenes == 37 * len(strange.families)
    again = preset_settings("out-of-range-2").scenes
    assert again.excursions[:37] == strange.excursions
    assert len({(one.axis, one.value) for one in again.excursions}) == 49
    assert DATASET_PRESETS["out-of-range-2"].num_scenes == 49 * len(again.families)
    bench = preset_settings("benchmark-v1").scenes
    assert bench.families_in_turn
    assert DATASET_PRESETS["benchmark-v1"].num_scenes == 50 * len(bench.families)
    assert preset_settings("benchmark-v1-mini") == preset_settings("benchmark-v1")


@for_each("name", DATASET_PRESETS)
def test_the_simplest_objects_always_fit(name: str) -> None:
    """The coarsest budget of the asset stage, as often as a family has objects, fits its scene."""
    build = preset_settings(name)
    for family in build.scenes.families:
        objects = family.num_objects[1]
        left = build.scenes.max_triangles - family.shell_triangles - build.scenes.lights.count[1]
        assert objects * min(build.assets.budgets) <= left, family.name


def test_sets_to_be_judged_by_have_objects_of_their_own() -> None:
    assert object_source(preset_settings("smoke"), None) == "builtin:"
    assert object_source(preset_settings("smoke"), "folder") == "folder"
    assert object_source(preset_settings("out-of-range"), "folder") == "folder"
    for name in JUDGED:
        assert object_source(preset_settings(name), None) == "builtin:benchmark-v1"
    with pytest.raises(TrilightError, match="Omit --objects"):
        object_source(preset_settings("benchmark-v1"), "builtin:")


def test_a_frozen_set_says_whether_it_is_the_published_one() -> None:
    published = DATASET_PRESETS["benchmark-v1-mini"].scene_digest

    def note(name: str, num_scenes: int, scene_digest: str | None) -> tuple[str, ...]:
        found = types.SimpleNamespace(num_scenes=num_scenes, scene_digest=scene_digest)
        return frozen_note(name, cast(Statistics, found))

    assert "published 20 scenes" in note("benchmark-v1-mini", 20, published)[0]
    assert "cannot be compared" in note("benchmark-v1-mini", 20, "0" * 64)[0]
    assert note("benchmark-v1-mini", 40, "0" * 64) == note("smoke", 20, "0" * 64) == ()


OWN = {"scenes.materials.source": "object"}


def test_one_word_asks_for_own_materials_and_their_numbers_count_in_the_digest() -> None:
    plain = preset_settings("smoke", changes=OWN)
    assert plain.mesh_settings.own_materials.keep
    assert not plain.mesh_settings.own_materials.emission
    record = plain.as_json()
    assert record["assets"]["own_materials"]["keep"] is True
    assert "emission" not in record["assets"]["own_materials"]
    assert record["scenes"]["materials"]["source"] == "object"
    assert "own_emission" not in record["scenes"]["materials"]
    again = from_record(DatasetSettings, record)
    assert again.digest == plain.digest and again.mesh_settings == plain.mesh_settings
    for name, value in (
        ("assets.own_materials.texels", 64),
        ("assets.own_materials.if_lost", "reject"),
        ("scenes.materials.own_share", 0.5),
        ("scenes.materials.own_emission", 0.2),
    ):
        other = preset_settings("smoke", changes={**OWN, name: value})
        assert other.digest != plain.digest, name
        # a share of light asks for what objects emit too
        assert other.mesh_settings.own_materials.emission == name.endswith("own_emission")


def test_a_build_that_draws_its_materials_says_nothing_of_them() -> None:
    for name in [name for name in DATASET_PRESETS if name != "object-views"]:
        record = DATASET_PRESETS[name].settings().as_json()
        assert "own_materials" not in record["assets"]
        assert not {"source", "own_share"} & set(record["scenes"]["materials"])
    smoke = preset_settings("smoke")
    assert smoke.mesh_settings == smoke.assets
    drawn = preset_settings("smoke", changes={"scenes.materials.own_emission": 0.2})
    assert drawn.digest == smoke.digest and not drawn.mesh_settings.own_materials.keep
