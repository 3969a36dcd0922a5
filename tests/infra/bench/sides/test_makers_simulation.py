"""Simulated makers: where the answer is known, it is that one."""

import dataclasses
import math

import pytest

from infra.bench.sides.makers_simulation import (
    MAKING,
    WAITING,
    Fleet,
    Growing,
    MakerStep,
    Protocol,
    simulated,
)
from tests.for_each import case

FLEET = Fleet(
    machines=4, num_shards=40, scenes_per_shard=2, scene_core_s=8.0, spread=0.0, slow_share=0.0,
    life_s=math.inf, shards_per_task=1,
)  # fmt: skip
"""40 shards of one second each, which is ten seconds."""
FREE = Protocol(
    start_s=0.0, begin=MakerStep(), note=MakerStep(), end=MakerStep(), finish=MakerStep()
)


def _step(seconds: float, **changes: float) -> MakerStep:
    return MakerStep(work_s=Growing(fixed=seconds), in_turn_s=Growing(**changes))


KNOWN = [
    (FREE, 10.0),
    (dataclasses.replace(FREE, start_s=1.0), 20.0),
    (dataclasses.replace(FREE, note=_step(0.5)), 15.0),
    (dataclasses.replace(FREE, end=_step(1.0, fixed=1.0)), 41.0),  # one after the other
    (dataclasses.replace(FREE, end=_step(0.0, planned=1 / 40)), 41.0),
    (dataclasses.replace(FREE, finish=_step(7.0)), 17.0),
]


def test_what_is_known() -> None:
    for protocol, seconds in KNOWN:
        with case(protocol):
            fate = simulated(FLEET, protocol)
            assert fate.seconds == pytest.approx(seconds)
            assert fate.spent_s[MAKING] == pytest.approx(40.0)
            assert sum(fate.spent_s.values()) == pytest.approx(4 * seconds)


def test_a_turn_that_grows_with_what_is_made_stops_to_scale() -> None:
    protocol = dataclasses.replace(FREE, end=_step(0.0, made=0.05))
    fates = [simulated(dataclasses.replace(FLEET, machines=n), protocol) for n in (4, 40)]
    assert fates[1].seconds > 0.7 * fates[0].seconds
    assert fates[1].shares()[WAITING] > 0.4


def test_all_is_made_by_machines_that_vanish() -> None:
    for keeps_scenes in [True, False]:
        with case(keeps_scenes):
            fleet = dataclasses.replace(FLEET, life_s=3.0, replaced_s=1.0, shards_per_task=4)
            protocol = dataclasses.replace(FREE, keeps_scenes=keeps_scenes)
            fate = simulated(fleet, protocol)
            assert fate.vanished > 3 and fate.seconds > 10.0
            # what is made, without what is made twice, is all there is
            assert fate.spent_s[MAKING] == pytest.approx(40.0)
