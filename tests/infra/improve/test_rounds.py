"""The closed loop: what its files hold, and which orders are refused."""

import dataclasses
import json
from pathlib import Path

import pytest

from infra.improve.datasets import dataset_order
from infra.improve.state import Drawn, Rounds
from pipeline.builds.named import named_build
from storage.errors import TrilightError
from tests.infra.improve.loop_kit import loop_order, strata_of_order

WEIGHTS = {"few_lights glossy": 0.4, "few_lights rough": 0.2, "many_lights glossy": 0.2}
DRAWN = Drawn(scenes=7, seed=3, weights={**WEIGHTS, "many_lights rough": 0.2})


def test_a_manifest_holds_the_weights_and_those_before(tmp_path: Path) -> None:
    order = loop_order(tmp_path)
    earlier = dataclasses.replace(DRAWN, weights=dict.fromkeys(DRAWN.weights, 0.25))
    first, second = (
        dataset_order(order, earlier, (), tmp_path),
        dataset_order(order, DRAWN, (earlier,), tmp_path),
    )
    assert (first.scenes, second.scenes) == (12, 8), "six shards of two; two of four"
    build = named_build(second.build, seed=second.seed, changes=second.changes)
    stored = json.loads(json.dumps(build.as_json()))["scenes"]["strata"]
    assert {row["name"]: row["weight"] for row in stored} == DRAWN.weights
    assert [row["earlier_weights"] for row in stored] == [[0.25]] * 4
    assert build.seed == 3 and len(strata_of_order(first)) == 4


def test_wrong_orders_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    for given, message in (
        ({"axes": ("lights", "lights")}, "each once"),
        ({"build": "benchmark-v1"}, "split test alone"),
        ({"floor": 1.5}, "floor"),
        ({"run_changes": {"widht": 3}}, "widht"),
        ({"changes": {"scenes.lights.count": [2, 2]}}, "axis lights"),
        ({"out": "s3://bucket/loop"}, "a folder of this machine"),
    ):
        with pytest.raises(TrilightError, match=message):
            loop_order(tmp_path, **given)
    (tmp_path / "file").write_text("")
    with pytest.raises(TrilightError, match="file cannot be made.*Choose another --out"):
        Rounds(loop_order(tmp_path / "file")).begin()
    rounds = Rounds(loop_order(tmp_path))
    rounds.begin()
    Rounds(loop_order(tmp_path, device="cpu")).begin()  # elsewhere it is the same loop
    with pytest.raises(TrilightError, match="steps is 4, but was begun with 6"):
        Rounds(loop_order(tmp_path, steps=4)).begin()


def test_numbers_of_forms_are_those_of_the_command_line(tmp_path: Path) -> None:
    """A form makes 20.0 of what a command line calls 20: it is the same loop."""
    Rounds(loop_order(tmp_path, changes={"renders.noise_floor_db": 20})).begin()
    Rounds(loop_order(tmp_path, changes={"renders.noise_floor_db": 20.0})).begin()
