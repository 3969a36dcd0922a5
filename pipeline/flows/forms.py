"""Converts settings classes to typed parameters of flows for Prefect's forms, and back to options.

A flow takes the fields of a settings class as its parameters: their descriptions
(storage.settings.described) become the schema that Prefect checks before a run exists, and from
which it draws a form. The groups of a preset's settings become forms within it, in which every
field may stay empty.
"""

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model

from pipeline.generation.generate_options import GenerateOptions
from pipeline.objects.sources import SOURCES
from pipeline.presets.registry import DATASET_PRESETS
from pipeline.presets.settings import DatasetSettings
from storage.aliases import OBJECTS, PRESET_ALIASES
from storage.dataset.shard_set import MAX_SHARDS
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.fields import describe_fields
from storage.settings.ranges import Within

Returned = TypeVar("Returned")


def parameters_of(settings: type, **annotations: Any) -> Callable[[Any], Any]:
    """Return a decorator that gives a flow's function the signature of a settings class.

    Args:
        annotations: types that replace those of some fields.
    """

    def with_signature(function: Callable[..., Returned]) -> Callable[..., Returned]:
        parameters = [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=inspect.Parameter.empty if field.default is MISSING else field.default,
                annotation=annotations.get(field.name, field.hint),
            )
            for field in describe_fields(settings)
        ]
        lines = [f"    {field.name}: {field.sentence}" for field in describe_fields(settings)]
        function.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        text = inspect.getdoc(function) or ""
        function.__doc__ = "\n".join([text, "", "Args:", *lines])
        return function

    return with_signature


def overrides_form(settings: type, example: Any) -> type[BaseModel]:
    """Return a form of all fields of a settings class, in which every field may stay empty.

    Args:
        settings: the class, whose fields may be groups, or tuples of groups.
        example: an instance, which says what the groups within tuples are.
    """
    fields: dict[str, Any] = {}
    for field in describe_fields(settings):
        value = getattr(example, field.name)
        first = value[0] if isinstance(value, tuple) and value else value
        is_group = dataclasses.is_dataclass(first) and not isinstance(first, type)
        kind = overrides_form(type(first), first) if is_group else field.hint
        fields[field.name] = (kind | None, Field(default=None, description=field.sentence))
    return create_model(
        f"{settings.__name__}Changes", __config__=ConfigDict(extra="forbid"), **fields
    )


def changed_values(form: BaseModel | None) -> dict[str, Any]:
    """Return the filled-in fields by dotted name, as `storage.settings.overrides` takes them."""
    values: dict[str, Any] = {}
    for name, value in form or ():  # in declared order; `model_fields_set` has none
        if isinstance(value, BaseModel):
            values |= {f"{name}.{below}": entry for below, entry in changed_values(value).items()}
        elif value is not None:
            values[name] = value
    return values


_NAMED = "|".join(
    [re.escape(name) for name, source in SOURCES.items() if not source.is_place]
    + [alias.removesuffix(":") for alias in OBJECTS]
)
_NO_SECRET = (
    rf"^(?:env:TRILIGHT_SOURCE_\w*|(?:{_NAMED}):[^@?]*"
    r"|[A-Za-z][A-Za-z0-9+.\-]*://[^@?#]*|[^:]*)$"
)
"""Pattern of URLs without user, password or query: all users of the server can see a parameter. It
also refuses variables that are not for sources (pipeline.objects.sources)."""

PublicUrl = Annotated[str, Field(pattern=_NO_SECRET)]
"""A path or URL without secrets: all users of the server can see it."""
PublicPlace = Annotated[
    str,
    Field(pattern=r"^(?:[A-Za-z][A-Za-z0-9+.\-]*://[^@?#]*|(?:[^:]|:+[^:/]|:+/[^:/])*:*/?)$"),
]
"""An output folder of any name, or a URL without secrets."""
DatasetPresetName = Literal[(*PRESET_ALIASES, *DATASET_PRESETS)]  # type: ignore[valid-type]
"""Names of the registered presets, for people and as they are stored: a list to choose from."""
DatasetOverrides = overrides_form(DatasetSettings, DATASET_PRESETS["smoke"].settings())
"""Every setting of a preset."""

DATASET_FORMS: Mapping[str, Any] = {
    "build": DatasetPresetName,
    "objects": PublicUrl | None,
    "out": PublicPlace | None,
    "changes": DatasetOverrides | None,
}
"""Types of parameters that are narrower in a form than in the options."""


@checked()
class DatasetInRuns(GenerateOptions):
    """A dataset made by several flow runs, each of which makes a range of the shards."""

    flow_runs: Annotated[int, Within(1, MAX_SHARDS, unit="flow runs")] = 1
    """Total number of flow runs: this one, and one run of the deployment for each other range."""
    deployment: str = "generate-scenes/local"
    """Deployment that makes the other ranges, as FLOW/DEPLOYMENT."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shards is not None:
            raise TrilightError(
                f"shards is {self.shards!r}; expected no range, since the whole dataset is made. "
                "Run generate-scenes for a range."
            )


def options_of_form(parameters: Mapping[str, Any], kind: Callable[..., Returned]) -> Returned:
    """Return the options of a class that a flow's parameters state.

    Raises:
        TrilightError: an invalid value that the form's schema cannot detect; the message names it.
    """
    values = {name: parameters[name] for name in inspect.signature(kind).parameters}
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return kind(**{**values, **lists, "changes": changed_values(parameters["changes"])})


def run_name() -> str:
    """Return the name of the starting flow run: preset, number of scenes and output folder."""
    from prefect.runtime import flow_run

    parameters = flow_run.parameters
    preset = parameters.get("build") or parameters.get("run") or GenerateOptions.build
    parts = (preset, parameters.get("scenes"), parameters.get("out"))
    return "-".join(map(str, filter(None, parts)))
