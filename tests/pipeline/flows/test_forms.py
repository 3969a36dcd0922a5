"""Forms of the flows: every setting with its sentence, wrong values refused by name, no secrets."""

import dataclasses
from typing import Any

import pytest
from prefect.exceptions import ParameterTypeError

from infra.serving.train_model import train_model
from pipeline.flows.forms import DatasetOverrides, changed_values, options_of_form
from pipeline.flows.prefect_flows import (
    build_dataset,
    generate_scenes,
    make_by_array,
    prepare_assets,
)
from pipeline.flows.prefect_runner import is_retryable
from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.settings import DatasetSettings
from storage.errors import EnvironmentFailure, TrilightError
from tests.for_each import for_each

CANARY = "CANARY-7f3a"
FLOWS = {
    "prepare-assets": prepare_assets,
    "generate-scenes": generate_scenes,
    "build-dataset": build_dataset,
    "make-by-array": make_by_array,
    "train-model": train_model,
}


def _defaults(**given: Any) -> dict[str, Any]:
    plain = {field.name: field.default for field in dataclasses.fields(GenerateOptions)}
    return {**plain, "changes": None, **given}


@for_each("name", FLOWS)
def test_every_parameter_has_a_sentence_and_a_default(name: str) -> None:
    flow = FLOWS[name]
    assert flow.name == name
    assert flow.parameters.properties
    for parameter, schema in flow.parameters.properties.items():
        assert len(schema["description"]) > 10, parameter
        assert "default" in schema, parameter
    assert not flow.parameters.required


def test_the_forms_within_have_every_setting_of_a_build_and_its_range() -> None:
    schema = generate_scenes.parameters.model_dump()
    groups = schema["definitions"]
    renders = groups["RenderSettingsChanges"]["properties"]
    assert renders["max_spp"]["description"].startswith("The cap")
    assert renders["denoiser"]["anyOf"][0]["enum"] == ["high", "fast", "off"]
    assert set(groups["DatasetSettingsChanges"]["properties"]) == set(
        DatasetSettings.__dataclass_fields__
    )
    # As declared at the fields, but for what no form can hold exactly.
    shown = schema["properties"]
    assert shown["scenes"]["anyOf"][0] == {"type": "integer", "minimum": 1, "maximum": 10**9}
    assert shown["seed"]["anyOf"][0] == {"type": "integer", "minimum": 0}
    assert (shown["failure_budget"]["minimum"], shown["failure_budget"]["maximum"]) == (0, 1)
    cameras = schema["definitions"]["CameraSettingsChanges"]["properties"]
    assert cameras["fov_deg"]["anyOf"][0]["items"] == {
        "type": "number", "minimum": 1, "maximum": 170,
    }  # fmt: skip
    assert train_model.parameters.properties["processes"]["maximum"] == 1024


def test_changes_become_dotted_names() -> None:
    form = DatasetOverrides(**{"renders": {"max_spp": 64}, "storage": {"profile": "lossless"}})
    expected = {"renders.max_spp": 64, "storage.profile": "lossless"}
    assert changed_values(form) == expected
    order = options_of_form(_defaults(scenes=3, changes=form), GenerateOptions)
    assert order == GenerateOptions(scenes=3, changes=expected)
    assert options_of_form(_defaults(), GenerateOptions) == GenerateOptions()


@for_each(
    ("parameters", "message"),
    [
        ({"build": "nonsense"}, "build"),
        ({"scenes": "many"}, "scenes"),
        ({"scenes": 0}, "scenes"),
        (
            {"changes": {"scenes": {"cameras": {"fov_deg": [30, 171]}}}},
            "fov_deg: expected numbers from 1 to 170 degrees",
        ),
        ({"changes": {"renders": {"most_spp": 4}}}, "changes.renders.most_spp"),
        ({"changes": {"renders": {"denoiser": "best"}}}, "changes.renders.denoiser"),
    ],
)
def test_wrong_values_are_refused_by_name(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterTypeError, match=message):
        generate_scenes.validate_parameters(parameters)


@for_each(
    "source",
    [
        f"https://user:{CANARY}@host/folder",
        f"https://host/folder?token={CANARY}",
        "env:PATH",
        "env:AWS_SECRET_ACCESS_KEY",
        "env:TRILIGHT_SOURCE_A/x",
    ],
)
def test_secrets_are_refused_before_a_run_exists(source: str) -> None:
    """The server checks the same schema when a run is made, so that it never stores one."""
    with pytest.raises(ParameterTypeError, match="objects"):
        generate_scenes.validate_parameters({"objects": source})
    for parameter, given in (("data", [source]), ("begin_with", source), ("lpips", source)):
        with pytest.raises(ParameterTypeError, match=parameter):
            train_model.validate_parameters({parameter: given})
    known = (
        "builtin:500",
        "procedural:5",
        "https://host/folder",
        "s3://b/f",
        "env:TRILIGHT_SOURCE_A",
        "a/b c",
    )
    for harmless in (*known, None):
        generate_scenes.validate_parameters({"objects": harmless})


@for_each("name", ["prepare-assets", "generate-scenes", "build-dataset"])
def test_a_place_to_write_to_holds_no_secret(name: str) -> None:
    for out in (f"s3://me:{CANARY}@bucket/set", f"s3://bucket/set?key={CANARY}"):
        with pytest.raises(ParameterTypeError, match="out"):
            FLOWS[name].validate_parameters({"out": out})
    for out in ("data/set", "/d/2026-01-01T10:30/a", "a:/b", "C:", "s3://bucket/a b/set", "gs://b"):
        FLOWS[name].validate_parameters({"out": out})


def test_a_place_that_cannot_be_written_is_refused_by_name() -> None:
    """Before anything is begun: a flow makes its order first."""
    for out in ("https://host/set", "hf://datasets/ada/set", "ftp://host/set"):
        with pytest.raises(TrilightError, match=f"^out '{out}'"):
            options_of_form(_defaults(out=out), GenerateOptions)


def test_only_what_can_pass_is_tried_again() -> None:
    class Failed:
        def __init__(self, error: Exception) -> None:
            self._error = error

        def result(self) -> None:
            raise self._error

    outcomes = {
        error: is_retryable(None, None, Failed(error))  # type: ignore[arg-type]
        for error in (
            EnvironmentFailure("disk"),
            OSError("gone"),
            TrilightError("wrong"),
            KeyError(),
        )
    }
    assert list(outcomes.values()) == [True, True, False, False]
