"""Named draws: distributed as they say, remembered, and independent of what else is drawn."""

import numpy as np
import pytest

from scene_templates.stated_draws import StatedDraws
from storage.seeds import rng_for
from tests.scene_templates.named_draws import stated_table
from tests.scene_templates.statistics import implausible, require_plausible

MANY = 1000


def _drawn() -> StatedDraws:
    draws = StatedDraws(rng_for(0, "named draws"))
    for _ in range(MANY):
        draws.uniform("number", -2.0, 5.0)
        draws.whole("count", 3, 9)
        draws.holds("it holds", 0.3)
        draws.choice("word", ("a", "b", "c"))
        draws.colour("colour", (0.1, 0.2, 0.3), (0.2, 0.9, 0.3))
        draws.shade("shade", (0, 0, 0), (1, 0.5, 0.1))
        draws.direction("direction", -30, 60)
    return draws


def test_each_is_distributed_as_stated() -> None:
    made = _drawn().made
    table = stated_table(made)
    require_plausible(table)
    # a colour has three numbers, a direction a height and an azimuth
    assert len(table) == 4 + 3 + 1 + 2
    assert not implausible({"nothing": 1.0})


def test_another_statement_would_be_noticed() -> None:
    wrong = {"number": (-2.0, 6.0), "count": (3, 10), "it holds": 0.45, "word": ("a", "b")}
    for name, stated in wrong.items():
        made = _drawn().made
        object.__setattr__(made[name], "stated", stated)
        assert implausible(stated_table(made)), name


def test_directions_are_unit_vectors_between_the_elevations() -> None:
    found = np.array(_drawn().made["direction"].values)
    # one square root and two sines, each to a few units of 2e-16
    assert np.abs(np.square(found).sum(axis=1) - 1).max() < 4e-15
    elevation = np.degrees(np.arcsin(found[:, 2]))
    assert -30 <= elevation.min() < -28 and 58 < elevation.max() <= 60


def test_a_name_has_one_statement() -> None:
    draws = StatedDraws(rng_for(0, "x"))
    draws.uniform("number", 0, 1)
    with pytest.raises(ValueError, match="number"):
        draws.uniform("number", 0, 2)


def test_a_stream_leaves_what_is_drawn_after_it() -> None:
    def rest(taken: int) -> float:
        draws = StatedDraws(rng_for(0, "x"))
        draws.stream().random(taken)
        return draws.uniform("number", 0, 1)

    assert rest(0) == rest(1000)


def test_a_statement_reads_as_words() -> None:
    words = {name: str(draw) for name, draw in _drawn().made.items()}
    assert words == {
        "number": "uniform, -2 to 5",
        "count": "whole number, 3 to 9",
        "it holds": "true with probability 0.3",
        "word": "one of a, b, c, equally likely",
        "colour": "each channel uniform from (0.1 0.2 0.3) to (0.2 0.9 0.3)",
        "shade": "uniform on the line from (0 0 0) to (1 0.5 0.1)",
        "direction": "uniform by solid angle, elevation -30 to 60 degrees",
    }


def test_parameters_are_plain_values() -> None:
    draws = StatedDraws(rng_for(0, "x"))
    draws.colour("colour", (0, 0, 0), (1, 1, 1))
    draws.whole("count", 1, 1)
    found = draws.parameters()
    assert found["count"] == (1,)
    (colour,) = found["colour"]
    assert isinstance(colour, list) and len(colour) == 3
