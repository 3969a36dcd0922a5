"""Conditions mean what Python means by them, and everything else is refused in one sentence."""

import numpy as np
import pytest

from pipeline.shards.expression import condition
from storage.errors import TrilightError
from tests.for_each import case, for_each

VALUES = {
    "key": "000000007",
    "split": "train",
    "template": "room",
    "uid": ["chair", "lamp"],
    "at_cap": [False, True],
    "triangles_per_scene": 4000.0,
    "lights_per_scene": 2.0,
    "roughness": [0.1, 0.5],
    "noise_floor_db": [41.0, 45.0],
    "light_size": list[float](),
}


def test_a_condition_holds_as_it_would_in_python() -> None:
    rows = [
        ("triangles_per_scene > 3999", True),
        ("3000 < triangles_per_scene <= 4000", True),
        ("3000 < triangles_per_scene < 4000", False),
        ("min(roughness) < 0.3 and lights_per_scene == 2", True),
        ("mean(noise_floor_db) - min(noise_floor_db) == 2", True),
        ("max(noise_floor_db) / 9 * -1 + 6 >= 1", True),
        ('template in ("room", "plane")', True),
        ('template not in ["room"]', False),
        ('"lamp" in uid and not "sofa" in uid', True),
        ("any(at_cap) and not all(at_cap)", True),
        ('split == "test" or key != "000000007"', False),
        ("all(at_cap) == False", True),
        ("min(light_size) > 0", False),
        ("min(light_size) <= 0", False),
        ("1 / (lights_per_scene - 2) > 0", True),
    ]
    for text, holds in rows:
        with case(text), np.errstate(divide="ignore"):
            assert condition(text).holds(VALUES) is holds
    assert condition('max(roughness) < 1 and split == "test"').names == {"roughness", "split"}


@for_each("text", ["lights_per_scene != 2 and {}", "not (lights_per_scene == 2 or {})"])
def test_a_first_part_guards_the_next(text: str) -> None:
    with np.errstate(divide="raise"):
        assert not condition(text.format("1 / (lights_per_scene - 2) > 0")).holds(VALUES)


def test_what_is_no_condition_is_refused_before_a_scene_is_read() -> None:
    rows = [
        ("roughness < 0.3", "expected min(...), max(...) or mean(...)"),
        ("0.3 > roughness", "'roughness' is numbers beside a number; expected min(...)"),
        ("roughnes < 0.3", "'roughnes' is unknown; expected one of albedo_sum, at_cap"),
        ("template > 3", "'3' is a number beside a text; expected what can be compared"),
        ('template < "room"', "a text beside a text"),
        ("lights_per_scene", "is a number; expected a comparison"),
        ("at_cap", "is truths; expected a comparison"),
        ("not at_cap", "expected any(...) or all(...) of it"),
        ('uid == "chair"', 'expected "..." in it'),
        ("min(template) > 1", "'template' is a text; expected numbers"),
        ("__import__('os').system('x') == 0", "is nothing that a condition may hold"),
        ("(lambda: 1)() == 1", "is nothing that a condition may hold"),
        ("[x for x in uid] == 1", "is nothing that a condition may hold"),
        ("2 ** 9 ** 9 ** 9 > 1", "is nothing that a condition may hold"),
        ("", "not an expression"),
        ("x\0y", "not an expression"),
        ("(" * 5000, "not an expression"),
        ("not " * 100_000 + "1", "not an expression"),
    ]
    for text, says in rows:
        with case(text[:99]), pytest.raises(TrilightError) as refused:
            condition(text)
        assert says in str(refused.value)
        assert len(str(refused.value)) < 900
        assert str(refused.value).count("; expected ") <= 1
