"""Commands whose options are the fields of settings classes, so that each is described once.

    @command("build")
    def generate(order: GenerateOptions, base: BaseSettings) -> None: ...

makes the argument BUILD, and an option of every other field. Each parameter of the function is a
class of settings (storage.settings.described) and a section of the help, with the class's first
sentence as its title. This module only converts words to values; the class checks them, and its
complaint about a wrong one then names the option.
"""

import inspect
import os
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_origin

from cyclopts import Group, Parameter, Token

from infra.cli.console import use_output
from infra.cli.extend_option import resolve_reference
from infra.cli.overrides import parse_overrides
from storage.errors import TrilightError
from storage.installation import module_name
from storage.remote.url import parse_local_path
from storage.settings.described import checked
from storage.settings.fields import (
    FieldDescription,
    default_text,
    describe_fields,
    option_of,
    parts_of,
    shown_name,
    unwrap,
)

PRESETS = {"build": "PRESET", "run": "PRESET"}
"""Arguments by what help calls them."""
_METAVARS = {int: "INT", float: "NUMBER"}
_BY_DEFAULT = re.compile(r"; by default (.+?)\.(?=\s|$)")
_NONE = re.compile(r"^there (is|are) none$")


@checked()
class OutputOptions:
    """Output."""

    json: bool = False
    """Print the result as one JSON document, and nothing else."""


class FileName(Path):
    """Type of an option that takes any text; shells complete it as a file name."""


_OUTPUT = "output"


def command(
    *arguments: str, has_json: bool = True
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a command of a function of settings classes.

    Args:
        arguments: fields that are positional arguments, and required unless they are empty or None
            by default; all other fields are options.
        has_json: add `--json`, by which the command prints only its JSON.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        parts = typing.get_type_hints(function)
        parts.pop("return")
        kinds = {**parts, **({_OUTPUT: OutputOptions} if has_json else {})}
        parameters = {
            field.name: _parameter(field, group, by_place=field.name in arguments)
            for kind in kinds.values()
            for title in [(inspect.getdoc(kind) or "").split("\n")[0].removesuffix(".")]
            for group in [Group.create_ordered(title)]
            for field in describe_fields(kind)
        }
        assert len(parameters) == sum(len(describe_fields(kind)) for kind in kinds.values()), (
            parameters
        )
        in_order = [*arguments, *(name for name in parameters if name not in arguments)]
        signature = inspect.Signature([parameters[name] for name in in_order])

        def run(*_words: Any, **_options: Any) -> None:
            arguments_by_name = signature.bind(*_words, **_options).arguments
            values = {name: _settings(kind, arguments_by_name) for name, kind in kinds.items()}
            output = values.pop(_OUTPUT, OutputOptions())
            with use_output(as_json=output.json):
                function(**values)

        run.__name__ = function.__name__
        run.__signature__ = signature  # type: ignore[attr-defined]
        return run

    return decorate


def _parameter(field: FieldDescription, group: Group, *, by_place: bool) -> inspect.Parameter:
    """Return a field as a parameter of the signature that cyclopts reads."""
    # an argument may be left out where the field is empty or None by default
    required = field.default is MISSING or (by_place and field.default not in ((), None))
    several = get_origin(field.bare) is tuple or takes_names(field.hint)
    parts = list(parts_of(field.hint))
    choices = tuple(part for part in parts if isinstance(part, str))
    kind = next((kind for kind in (bool, int, float) if kind in parts), str)
    module, constant = NAMES.get(field.name, ("", ""))
    complete = (
        (lambda _: list(getattr(import_module(module_name(module)), constant))) if module else None
    )
    word: Any = bool if kind is bool else str  # numbers are read when the class is made
    if kind is str and not (choices or complete or takes_names(field.hint)):
        word = FileName

    def words_of(_: Any, tokens: tuple[Token, ...]) -> Any:
        words = [token.value for token in tokens]
        return words if several else words[0]

    names = dict.fromkeys([shown_name(field), option_of(field.name)])
    metavar = "CHOICE" if choices else _METAVARS.get(kind, "TEXT")
    declared = Parameter(
        name=PRESETS.get(field.name) if by_place else tuple(names),
        help=_help(field, choices, several=several, required=required),
        group=group,
        metavar=None if kind is bool else "NAME=VALUE" if takes_names(field.hint) else metavar,
        negative=(),
        show_default=False,
        show_choices=False,
        choices=choices or None,
        json_list=False,
        completer=complete,
        converter=None if kind is bool else words_of,
    )
    return inspect.Parameter(
        field.name,
        inspect.Parameter.POSITIONAL_ONLY if by_place else inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if required else None,
        annotation=Annotated[(list[word] if several else word) | None, declared],
    )


def _help(
    field: FieldDescription, choices: tuple[str, ...], *, several: bool, required: bool
) -> str:
    """Return the sentence of a field, and in brackets its choices, range and default.

    A clause "; by default X." of the sentence stands in the brackets as "default: X".
    """
    facts = [", ".join(choices)] if choices else []
    facts += [str(field.within)] if field.within else []
    facts += ["may be repeated"] if several else []
    sentence = field.sentence
    clause = _BY_DEFAULT.search(sentence)
    if required:
        facts.append("required")
    elif field.default is not None and field.default is not False and field.default not in ((), {}):
        facts.append(f"default: {default_text(field.default)}")
    elif clause is not None:
        sentence = f"{sentence[: clause.start()]}.{sentence[clause.end() :]}"
        facts.append(f"default: {_NONE.sub('none', clause[1])}")
    return f"{sentence} [{'; '.join(facts)}]" if facts else sentence


def _settings(kind: type, words_by_name: Mapping[str, Any]) -> Any:
    """Return an instance of settings from words; a complaint about a field names its option."""
    fields = {field.name: field for field in describe_fields(kind)}
    values = {
        name: resolve_reference(name, value_of(words, fields[name].hint))
        for name, words in words_by_name.items()
        if name in fields and words is not None
    }
    try:
        return kind(**values)
    except TrilightError as error:
        name = re.match(r"(\w+)(\.\d+)?(?= is )", str(error))  # perhaps one of several words
        if name is None or name[1] not in fields:
            raise
        raise TrilightError(shown_name(fields[name[1]]) + str(error)[name.end() :]) from error


def value_of(words: bool | str | Sequence[str], hint: Any) -> Any:
    """Return the value of a field from its words.

    Args:
        words: the typed word, a list for a field that takes several, or a bool for a switch.
        hint: type of the field. A word that is no value of it is returned unchanged, so that the
            class reports what it expects.

    Raises:
        TrilightError: the field takes names with values, and a word is not NAME=VALUE.
    """
    if isinstance(words, bool):
        return words
    if isinstance(words, str):
        return _one(words, hint)
    if takes_names(hint):
        return parse_overrides(words)
    return tuple(_one(word, hint) for word in words)


def _one(word: str, hint: Any) -> Any:
    word = os.path.expanduser(word)  # a shell leaves the ~ of --out=~/x as it is
    kinds = list(parts_of(hint))
    for kind, parse in ((int, int), (float, float), (Path, parse_local_path)):
        if kind in kinds:
            try:
                return parse(word)
            except ValueError:
                pass
    return word


def takes_names(hint: Any) -> bool:
    """Return whether a field takes names with values."""
    return get_origin(unwrap(hint)[0]) in (Mapping, dict)


NAMES = {
    "build": ("pipeline.presets.registry", "DATASET_PRESETS"),
    "run": ("train.presets", "TRAINING_PRESETS"),
    "network": ("model.config", "SIZES"),
    "runner": ("pipeline.executors.registry", "EXECUTORS"),
}
"""Module and constant with the known names, by the field that takes one; a field may also take a
name that is not listed."""
