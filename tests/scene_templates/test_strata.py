"""Strata: shares in every stretch of scenes, and settings that refuse contradictions."""

from collections import Counter

import pytest

from pipeline.builds.named import named_build
from scene_templates.strata import Stratum, stratum_of
from storage.errors import TrilightError
from storage.settings.changes import changed
from tests.for_each import for_each

STRATA = (
    Stratum(name="rare", weight=0.1),
    Stratum(name="often", weight=0.6),
    Stratum(name="some", weight=0.3),
)


@for_each("first", [0, 7, 1000, 999_999_900])
def test_every_stretch_holds_each_share(first: int) -> None:
    for length in (10, 40, 100):
        found = Counter(stratum_of(STRATA, first + k).name for k in range(length))
        for stratum in STRATA:
            assert abs(found[stratum.name] - stratum.weight * length) < 2.5, (length, found)


def test_weights_are_relative_and_history_changes_no_scene() -> None:
    other = [
        Stratum(name=one.name, weight=10 * one.weight, earlier_weights=(1.0,)) for one in STRATA
    ]
    for index in range(50):
        assert stratum_of(STRATA, index).name == stratum_of(other, index).name


@for_each(
    ("strata", "message"),
    [
        ([{"name": "a", "weight": 1}, {"name": "a", "weight": 1}], "unique names"),
        ([{"name": "a", "weight": 1, "families": ["tunnel"]}], "tunnel"),
        ([{"name": "a", "weight": 1, "changes": [["lights.cuont", [1, 2]]]}], "cuont"),
        ([{"name": "a", "weight": 0}], "weight"),
    ],
)
def test_contradictions_are_named(strata: list[dict[str, object]], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        changed(named_build("smoke").scenes, {"strata": strata})


def test_a_build_without_strata_does_not_record_them() -> None:
    build = named_build("smoke")
    assert "strata" not in build.as_json()["scenes"]
    with_one = changed(build, {"scenes.strata": [{"name": "all", "weight": 1}]})
    (stored,) = with_one.as_json()["scenes"]["strata"]
    assert stored["name"] == "all" and with_one.digest != build.digest
