"""The flow `improve`: its form, and what its page shows of a round."""

import logging
from pathlib import Path
from typing import Any

import pytest
from prefect.exceptions import ParameterTypeError

from infra.improve.order import ImproveOrder
from infra.improve.report import write_report
from infra.improve.state import Drawn, Lessons, Rounds
from infra.improve.weights import Lesson
from infra.serving import improve_loop as served
from infra.serving.improve_loop import improve_loop, improve_order
from pipeline.flows.submission import parameters
from storage.errors import TrilightError
from storage.settings.described import described
from tests.infra.improve.loop_kit import loop_order

LESSON = Lesson(loss_before=0.3, loss=0.2, core_s=2.0)


def _parameters(**given: Any) -> dict[str, Any]:
    plain = {field.name: field.default for field in described(served.ImproveOrder)}
    return {**plain, "changes": None, "run_changes": None, **given}


def test_what_is_filled_in_becomes_the_order() -> None:
    form = improve_loop.validate_parameters(
        _parameters(rounds=2, axes=["lights"], run_changes={"learning_rate": 0.001})
    )
    order = improve_order(form)
    assert (order.rounds, order.axes, order.run) == (2, ("lights",), "hits")
    training = order.training(1, ("data",), None)
    assert training.settings().learning_rate == 0.001 and training.restartable
    assert order.training(2, ("a", "b"), "mix:0").decisions["num_steps"] == 400


def test_what_is_submitted_is_the_order_again() -> None:
    """Through Prefect's own check of the form, and with nothing at its default."""
    order = ImproveOrder(
        rounds=2, axes=("lights",), changes={"renders.max_spp": 64}, run_changes={"resolution": 32}
    )
    given = parameters(order)
    assert given == {
        "build": "smoke",
        "rounds": 2,
        "axes": ["lights"],
        "changes": {"renders": {"max_spp": 64}},
        "run_changes": {"resolution": 32},
    }
    assert improve_order(improve_loop.validate_parameters({**_parameters(), **given})) == order


def test_wrong_forms_are_refused_by_name() -> None:
    with pytest.raises(ParameterTypeError, match="axes"):
        improve_loop.validate_parameters(_parameters(axes=["colour"]))
    with pytest.raises(TrilightError, match="each once"):
        improve_order(_parameters(axes=["lights", "lights"]))


def test_a_round_is_shown_and_a_server_that_is_away_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rounds = Rounds(loop_order(tmp_path))
    weights = {stratum.name: stratum.weight for stratum in rounds.order.strata()}
    drawn = Drawn(scenes=8, seed=0, weights=weights)
    rounds.decide(1, drawn)
    lessons = Lessons(
        digest="0" * 64,
        scenes=8,
        making_core_s=1.0,
        training_core_s=1.0,
        strata={next(iter(weights)): LESSON},
        losses={"000000000": 0.2, "000000001": 0.4},
    )
    write_report(rounds, [lessons])
    tables, pictures, bars = list[Any](), list[str](), list[Any]()
    monkeypatch.setattr(served, "get_run_logger", lambda: logging.getLogger("test"))
    monkeypatch.setattr(served, "create_table_artifact", lambda rows, **more: tables.append(rows))
    monkeypatch.setattr(served, "create_image_artifact", lambda url, **more: pictures.append(url))
    monkeypatch.setattr(served, "create_progress_artifact", lambda done, **more: bars.append(done))
    shown = served._Shown(rounds.order)
    shown.begins(1, "train")
    shown.round_done(1, drawn, lessons)
    shown.finished()
    first, second, *_ = tables[0]
    assert first["log L1"] == "0.2000" and first["fell by"] == "+0.1000"
    assert second["log L1"] == "" and second["share"] == "25.0%"
    assert pictures[0].startswith("data:image/jpeg;base64,")
    # of two rounds: a third of the first; no server gave an id by which a bar could be moved
    assert bars == [pytest.approx(100 / 6), 50.0]
    assert {"what": "training scenes", "value": "8"} in tables[1]
    assert tables[1][-1]["value"] == "0.3000 after round 1, 0.3000 at the end"

    def away(*given: Any, **more: Any) -> None:
        raise ConnectionError("no route")

    monkeypatch.setattr(served, "create_table_artifact", away)
    served._Shown(rounds.order).round_done(1, drawn, lessons)
    assert "no route" in caplog.text
