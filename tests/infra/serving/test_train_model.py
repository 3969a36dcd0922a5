"""The flow `train-model`: a form of the runs and their settings, which says what is wrong."""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
from prefect.exceptions import ParameterTypeError

from infra.serving.train_model import RunChanges, TrainOrder, train_model, train_order
from storage.errors import TrilightError
from storage.settings.described import described
from tests.command_line import trilight
from tests.for_each import case
from train.runs import RUNS, named_run
from train.settings import TrainSettings

SECOND_STAGES = sorted(name for name in RUNS if named_run(name).from_weights)


def _parameters(**given: Any) -> dict[str, Any]:
    """Return what the flow is called with where nothing else is filled in."""
    plain = {field.name: field.default for field in described(TrainOrder)}
    return {**plain, "data": ["a"], "changes": None, **given}


def test_training_is_launched_by_torchrun_where_there_are_several_processes() -> None:
    one = TrainOrder(data=("a", "b"), resume=True, steps=5).command()
    assert one[1:] == ("-m trilight train smoke --data a --data b --resume --steps 5").split()
    two = TrainOrder(processes=2).command()
    assert two[1:5] == ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    with pytest.raises(TrilightError, match="processes is 0"):
        TrainOrder(processes=0)


def test_the_form_has_every_run_and_every_setting() -> None:
    schema = train_model.parameters.model_dump()
    assert schema["properties"]["run"]["enum"] == list(RUNS)
    groups = schema["definitions"]
    settings = groups["TrainSettingsChanges"]["properties"]
    assert set(settings) == {field.name for field in dataclasses.fields(TrainSettings)}
    assert settings["learning_rate"]["anyOf"][0]["exclusiveMinimum"] == 0
    assert groups["LossSettingsChanges"]["properties"]["perceptual"]["anyOf"][0]["enum"] == [
        "lpips", "ms_ssim", "none",
    ]  # fmt: skip


WRONG_FORMS: list[tuple[dict[str, Any], str]] = [
    ({"run": "pretain"}, "run"),
    ({"changes": {"warm_up": 3}}, "changes.warm_up"),
    ({"changes": {"loss": {"perceptual": "vgg"}}}, "changes.loss.perceptual"),
    ({"changes": {"model": {"width": 0}}}, "changes.model.width"),
    ({"changes": {"betas": [0.9, 1.0]}}, "changes.betas: expected numbers from 0 to below 1"),
    ({"changes": {"loss.perceptual": "none"}}, "changes.loss.perceptual"),
]


def test_a_wrong_form_is_refused_before_a_run_exists() -> None:
    for parameters, message in WRONG_FORMS:
        with case(parameters):
            with pytest.raises(ParameterTypeError, match=message):
                train_model.validate_parameters(parameters)


UNLAWFUL: list[tuple[dict[str, Any], str]] = [
    ({"changes": {"resolution": 60}}, "resolution is 60; expected a multiple of 8"),
    ({"changes": {"validate_every": 7}}, "validate_every is 7; expected a multiple"),
    ({"steps": 50, "changes": {"warmup_steps": 50}}, "warmup_steps is 50; expected 0 to 49"),
    ({"run": "finetune"}, "expected begin_with"),
    ({"run": "pretrain", "begin_with": "runs/x"}, "begin_with is runs/x"),
]


def test_laws_between_settings_are_checked_before_the_command() -> None:
    """No schema can say them; the order is made in the flow's first moment."""
    for given, message in UNLAWFUL:
        with case(message):
            form = RunChanges(**given["changes"]) if "changes" in given else None
            with pytest.raises(TrilightError, match=message):
                train_order(_parameters(**{**given, "changes": form}))


def test_a_second_stage_begins_with_the_first() -> None:
    for run in SECOND_STAGES:
        with case(run):
            form = RunChanges(**{"loss": {"perceptual_weight": 0.1}, "num_steps": 9000})
            given = {"run": run, "begin_with": "runs/pretrain", "lpips": "hub", "changes": form}
            command = train_order(_parameters(**given)).command()
            words = " ".join(command[command.index("train") :])
            assert words == (
                f"train {run} --data a --begin-with runs/pretrain --lpips hub "
                "--changes loss.perceptual_weight=0.1 --changes num_steps=9000"
            )
            going_on = {"resume": True, "changes": None, "decisions": {"learning_rate": 1e-5}}
            command = train_order(_parameters(**going_on)).command()
            assert (
                " ".join(command[4:]) == "smoke --data a --resume --decisions learning_rate=1e-05"
            )
            again = TrainOrder(run=run, resume=True).command()
            assert "--resume" in again and "--begin-with" not in again


def test_the_command_line_takes_every_option_of_the_command(tmp_path: Path) -> None:
    """It comes as far as the data, which is not there: after its options and the run's settings."""
    order = TrainOrder(
        run="finetune", data=(str(tmp_path / "none"),), out=str(tmp_path / "run"), steps=9000,
        begin_with="runs/x", lpips="hub", changes={"loss.perceptual": "none"},
    )  # fmt: skip
    python, *words = order.command()
    assert (python, words[:2]) == (sys.executable, ["-m", "trilight"])
    assert str(tmp_path / "none") in trilight(words[2:]).mistake
