"""Named runs exist, and contradictions are refused by field."""

import json

import pytest

from storage.errors import TrilightError
from tests.train.kit import tiny_run
from train.settings import RUNS, named_run, settings_record


@pytest.mark.parametrize("name", sorted(RUNS))
def test_named_runs_carry_their_name_and_survive_json(name: str) -> None:
    settings = named_run(name)
    assert settings.run == name
    record = settings_record(settings)
    assert json.loads(json.dumps(record)) == record
    assert record["model"]["width"] == settings.model.width


def test_an_unknown_run_is_refused_with_the_known_ones() -> None:
    with pytest.raises(TrilightError, match="run 'smoek': no such run; expected one of smoke"):
        named_run("smoek")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resolution": 20}, "resolution is 20; expected a multiple of 8"),
        ({"resolution": 0}, "resolution is 0"),
        ({"num_steps": 0}, "num_steps is 0; expected at least 1"),
        ({"views_per_scene": 0}, "views_per_scene is 0"),
        ({"warmup_steps": 12}, "warmup_steps is 12; expected 0 to 11"),
        ({"learning_rate": 0.0}, "learning_rate is 0.0; expected above 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"grad_clip": -1.0}, "grad_clip is -1.0"),
        ({"weight_decay": -0.1}, "weight_decay is -0.1"),
        ({"validate_every": 5}, "validate_every is 5; expected a multiple of log_every, 2"),
        ({"checkpoint_every": 3}, "checkpoint_every is 3"),
    ],
)
def test_contradictory_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        tiny_run(**changes)
