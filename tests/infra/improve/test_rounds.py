"""The closed loop: what it draws next, what its files hold, and that a kill changes nothing."""

import dataclasses
import json
from pathlib import Path

import pytest

from infra.improve.datasets import dataset_order
from infra.improve.rounds import improve
from infra.improve.state import Drawn, Rounds
from pipeline.builds.named import named_build
from storage.errors import TrilightError
from tests.infra.improve.loop_kit import Killed, loop_order, strata_of_order, workers

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


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A loop that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole")
    improve(loop_order(folder), workers())
    return folder


def result(folder: Path) -> dict[str, bytes]:
    """Return all that a loop decided and learnt, and the network."""
    names = ["run/model.safetensors"]
    names += [f"rounds/0{k}/{what}.json" for k in (1, 2) for what in ("drawn", "lessons")]
    return {name: (folder / name).read_bytes() for name in names}


@pytest.mark.slow
def test_a_loop_draws_what_taught_most_for_its_cost(whole: Path) -> None:
    rounds = Rounds(loop_order(whole))
    first, second, taught = rounds.drawn(1), rounds.drawn(2), rounds.lessons(1)
    assert first and second and taught
    assert set(first.weights.values()) == {0.25} and first.scenes == 8
    scores = {name: lesson.score for name, lesson in taught.strata.items()}
    assert max(scores.values()) > 0 and sum(second.weights.values()) == pytest.approx(1)
    assert max(scores, key=lambda name: scores[name]) == max(
        second.weights, key=lambda name: second.weights[name]
    )
    assert {name: lesson.core_s for name, lesson in taught.strata.items()} == {
        name: 2.0 if "many" in name else 1.0 for name in scores
    }
    price = sum(second.weights[name] * taught.strata[name].core_s for name in scores)
    assert second.scenes == round(8 * 1.5 / price), "for equal core-seconds"
    summary = json.loads((whole / "run/summary.json").read_text())
    changed = {event["name"]: event["after"] for event in summary["history"]}
    assert {"data", "num_steps", "decay_share"} <= set(changed)
    assert (changed["num_steps"], changed["decay_share"]) == (12, 0.25)
    assert "few_lights rough" in (whole / "improve.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("killed_at", "step"),
    [("1 train", None), ("2 judge", None), (None, 3), (None, 9)],
)
def test_a_loop_that_is_killed_ends_the_same_to_the_bit(
    whole: Path, tmp_path: Path, killed_at: str | None, step: int | None
) -> None:
    order = loop_order(tmp_path)
    with pytest.raises(Killed):
        improve(order, workers(killed_at, step=step))
    improve(order, workers())
    assert result(tmp_path) == result(whole)


@pytest.mark.slow
def test_a_finished_loop_is_told_again_and_makes_nothing(whole: Path) -> None:
    told: list[int] = []
    nobody = dataclasses.replace(
        workers(),
        make=lambda order: pytest.fail("made"),
        train=lambda order: pytest.fail("trained"),
        told=lambda number, drawn, lessons: told.append(number),
    )
    before = result(whole)
    improve(loop_order(whole), nobody)
    assert told == [1, 2] and result(whole) == before
