"""Own materials in the settings of a build: one word asks for them; others stay as they were."""

from pipeline.builds.named import BUILDS, named_build
from pipeline.builds.settings import BuildSettings
from storage.settings.described import from_record

OWN = {"scenes.materials.source": "object"}


def test_one_word_asks_for_them() -> None:
    build = named_build("smoke", changes=OWN)
    assert build.mesh_settings.own_materials.keep
    record = build.as_json()
    assert record["assets"]["own_materials"]["keep"] is True
    assert record["scenes"]["materials"]["source"] == "object"
    again = from_record(BuildSettings, record)
    assert again.digest == build.digest and again.mesh_settings == build.mesh_settings


def test_sizes_and_shares_count_in_the_digest() -> None:
    plain = named_build("smoke", changes=OWN)
    for name, value in (
        ("assets.own_materials.texels", 64),
        ("assets.own_materials.if_lost", "reject"),
        ("scenes.materials.own_share", 0.5),
    ):
        assert named_build("smoke", changes={**OWN, name: value}).digest != plain.digest, name


def test_a_build_that_draws_its_materials_says_nothing_of_them() -> None:
    for name in BUILDS:
        record = BUILDS[name].settings().as_json()
        assert "own_materials" not in record["assets"]
        assert not {"source", "own_share"} & set(record["scenes"]["materials"])
    smoke = named_build("smoke")
    assert smoke.mesh_settings == smoke.assets


def test_a_share_of_light_asks_for_what_objects_emit_too() -> None:
    plain = named_build("smoke", changes=OWN)
    lit = named_build("smoke", changes={**OWN, "scenes.materials.own_emission": 0.2})
    assert lit.mesh_settings.own_materials.emission and lit.digest != plain.digest
    assert not plain.mesh_settings.own_materials.emission
    assert "emission" not in plain.as_json()["assets"]["own_materials"]
    assert "own_emission" not in plain.as_json()["scenes"]["materials"]
    drawn = named_build("smoke", changes={"scenes.materials.own_emission": 0.2})
    assert (
        drawn.digest == named_build("smoke").digest and not drawn.mesh_settings.own_materials.keep
    )
