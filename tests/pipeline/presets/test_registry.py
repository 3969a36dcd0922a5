"""Every dataset preset is complete; published ones stay what they are, whatever changes later."""

import json
import types
from typing import Any, cast

import numpy as np
import pytest

from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING, RENDERFORMER_PRESETS
from pipeline.presets.registry import DATASET_PRESETS, frozen_note, preset_settings
from pipeline.presets.settings import DatasetSettings
from scene_templates import placement
from scene_templates import sample_lights as emitters
from scene_templates.sample_camera import sample_camera
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.dataset.splits import split_of_object, split_of_shard
from storage.dataset.statistics import Statistics
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings.described import from_record, settings_record
from storage.settings.overrides import differences
from tests.for_each import for_each
from tests.pipeline.programs import printed_by
from tests.scene_templates.balls import one_drawn

JUDGED = ["out-of-range", "out-of-range-2", "benchmark-v1", "benchmark-v1-mini"]


@for_each("name", DATASET_PRESETS)
def test_settings_survive_the_manifest(name: str) -> None:
    build = preset_settings(name)
    stored = json.loads(json.dumps(settings_record(build)))
    assert stored == settings_record(build)
    again = from_record(DatasetSettings, stored)
    assert settings_record(again) == stored and again.digest == build.digest
    assert build.build == ("benchmark-v1" if name == "benchmark-v1-mini" else name)


@for_each("name", DATASET_PRESETS)
def test_what_is_named_changes_and_nothing_else(name: str) -> None:
    before = preset_settings(name)
    after = preset_settings(
        name,
        seed=7,
        resolution=64,
        noise_targets={"noise_floor_db": 33.0},
        changes={"scenes.num_views": 3},
    )
    records = (settings_record(before), settings_record(after))
    found = {path: value for path, _, value in differences(*records)}
    expected: dict[str, Any] = {"seed": 7, "renders.resolution": 64}
    expected |= {"renders.noise_floor_db": 33.0, "scenes.num_views": 3}
    if before.renders.noise_floor_objects_db is not None:
        expected["renders.noise_floor_objects_db"] = None  # a target replaces all
    assert found == expected
    assert after.digest != before.digest


def test_floors_licences_and_mistakes_of_a_build() -> None:
    plain = preset_settings("smoke").renders
    linear = preset_settings("smoke", noise_targets={"noise_floor_linear_db": 33.0})
    assert linear.renders.targets_db == {"psnr_linear_db": 33.0}
    added = preset_settings("smoke", changes={"renders.noise_floor_linear_db": 33.0})
    assert added.renders.targets_db == {**plain.targets_db, "psnr_linear_db": 33.0}
    assert from_record(DatasetSettings, settings_record(linear)) == linear
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
    assert GenerateOptions(build="smoke").source == "builtin:"
    assert GenerateOptions(build="smoke", objects="folder").source == "folder"
    assert GenerateOptions(build="out-of-range", objects="folder").source == "folder"
    for name in JUDGED:
        assert GenerateOptions(build=name).source == "builtin:benchmark-v1"
    with pytest.raises(TrilightError, match="Omit --objects"):
        _ = GenerateOptions(build="benchmark-v1", objects="builtin:").source


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
    record = settings_record(plain)
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
        record = settings_record(DATASET_PRESETS[name].settings())
        assert "own_materials" not in record["assets"]
        assert not {"source", "own_share"} & set(record["scenes"]["materials"])
    smoke = preset_settings("smoke")
    assert smoke.mesh_settings == smoke.assets
    drawn = preset_settings("smoke", changes={"scenes.materials.own_emission": 0.2})
    assert drawn.digest == smoke.digest and not drawn.mesh_settings.own_materials.keep


FROZEN = {
    "renderformer-v1-256": "c801823b57cd8d06e93cba5fce8c7756882a27e5667863d8fb6da20fd71181d3",
    "renderformer-v1-512": "f107b27071d2194d773ff7b3a8d9c565741415f9aaf8b29816b9ec01db4f3e2b",
    "renderformer-v1-256-original": (
        "2b136d532d19a8018413a37c8a74656f8495878c9cca02de8e0768e20a7dbfb3"
    ),
    "renderformer-v1-512-original": (
        "56426772c2a91bbfecdea829bb87538a282a5a0f46ccb7b21d20fc19825fbcc6"
    ),
    "out-of-range": "c2a748aa52a8ef6b87a608ff6ff736f252915de5a32a176561d77e18755013e8",
    "out-of-range-2": "eb1172a3f84644efdf864e36b152c463f080d15c203b1397acff1421a0277754",
    "benchmark-v1": "74bfa7914c6aa4d7e94ec60ecd0f3530e9cec5d091d47e6aad54549bce36e5fd",
    "benchmark-v1-mini": "74bfa7914c6aa4d7e94ec60ecd0f3530e9cec5d091d47e6aad54549bce36e5fd",
}
"""Digest of each set's settings."""


def test_the_settings_and_tries_of_a_frozen_set_stay_what_they_are() -> None:
    """Tries are seldom used up, so that the layouts below may not show it."""
    assert {name: preset_settings(name).digest for name in FROZEN} == FROZEN
    assert set(FROZEN) == {*PRESETS_FOR_JUDGING, *RENDERFORMER_PRESETS}
    assert (placement.ARRANGEMENT_TRIES, placement.PLACE_TRIES) == (100, 16)
    assert (emitters.SPACING_TRIES, emitters.PALEST) == (256, 0.2)


DRAWN = {
    "renderformer-v1-256": "1191dc2fb8d3dcc7",
    "renderformer-v1-512": "734e2aa70a627316",
    "renderformer-v1-256-original": "b714a23cd3b0c8fc",
    "renderformer-v1-512-original": "0904cc37f3c68d75",
    "out-of-range": "8dfb2892883d2baa",
    "out-of-range-2": "8dfb2892883d2baa",
    "benchmark-v1": "d5aea36fd1efd811",
}
"""Digest of the numbers of the first layouts of each set, balls in place of objects."""


def test_what_is_drawn_from_them_stays_what_it_is() -> None:
    """So that the code, too, which draws a layout from its data, changes no published set."""
    for name, digest in DRAWN.items():
        build = preset_settings(name)
        numbers = [_numbers(build.scenes, build.seed, index) for index in range(12)]
        # to a millionth: exp, sin and cos differ between processors in their sixteenth digit
        rounded = np.round(np.concatenate(numbers) * 1e6).astype(np.int64)
        assert sha256_hex(rounded.tobytes())[:16] == digest, name


def _numbers(settings: SceneSettings, seed: int, index: int) -> np.ndarray:
    drawn = one_drawn(settings, index, seed)
    layout, after = drawn.layout, settings.of_scene(index)
    sector = TEMPLATES[drawn.plan.family.template].cameras
    camera = sample_camera(rng_for(seed, "camera of a test", index), after.cameras, sector)
    found: list[Any] = [part.positions for part in layout.shell]
    for placed in layout.objects:
        found += [placed.pose.centre, placed.pose.radius, placed.pose.rotation]
    surfaces = [part.surface for part in layout.shell] + [one.surface for one in layout.objects]
    found += [surface.diffuse_rgb for surface in surfaces]
    found += [surface.roughness for surface in surfaces]
    found += [value for lamp in layout.emitters for value in (lamp.triangle, lamp.radiance_rgb)]
    return np.concatenate([np.ravel(value) for value in (*found, *camera)])


def test_a_layout_that_is_registered_later_changes_no_build() -> None:
    """Nor those that networks are trained on: it joins them where its name is written."""
    found = _digests_after("""
        from storage.extensions import load_extension
        for name in ("template", "family", "object_source"):
            load_extension(f"examples/{name}.py")
        from scene_templates.families import TEMPLATES, Family
        assert "corridor" in TEMPLATES and "crowd" in Family.PRESETS
        from pipeline.presets.registry import DATASET_PRESETS
        """)
    assert found == {name: build.settings().digest for name, build in DATASET_PRESETS.items()}


def test_a_default_that_is_changed_later_changes_no_frozen_set() -> None:
    """They are made where no field of any group of settings has a default to fall back on."""
    found = _digests_after("""
        from pipeline.assets import settings as assets
        from pipeline.presets import settings as presets
        from pipeline.renders import settings as renders
        from scene_templates import settings as scenes
        from scene_templates import families
        from scene_templates import rooms
        from storage.dataset import settings as dataset_settings
        modules = (assets, presets, renders, scenes, families, rooms)
        kinds = {kind for module in (*modules, dataset_settings) for kind in vars(module).values()
                 if isinstance(kind, type) and hasattr(kind, "__pydantic_fields__")}
        assert len(kinds) > 14
        def without_defaults(kind):
            plain, names = kind.__init__, set(kind.__pydantic_fields__)
            def stating_all(self, **values):
                if missing := names - set(values):
                    raise TypeError(f"{kind.__name__} lacks {missing}")
                plain(self, **values)
            kind.__init__ = stating_all
        for kind in kinds:
            without_defaults(kind)
        try:
            scenes.ViewLaws()
        except TypeError:
            pass
        else:
            raise AssertionError("a default is still there")
        from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING, RENDERFORMER_PRESETS
        DATASET_PRESETS = PRESETS_FOR_JUDGING | RENDERFORMER_PRESETS
        """)
    assert found == {name: DATASET_PRESETS[name].settings().digest for name in FROZEN}


def _digests_after(code: str) -> dict[str, str]:
    """Return the digests of `DATASET_PRESETS`, which the code imports, in a process of its own."""
    lines = "\n".join(line.removeprefix(" " * 8) for line in code.splitlines())
    digests = "{n: b.settings().digest for n, b in DATASET_PRESETS.items()}"
    tail = f"import json\nprint(json.dumps({digests}))"
    found: dict[str, str] = json.loads(printed_by(f"{lines}\n{tail}"))
    return found
