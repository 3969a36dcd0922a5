"""Overrides of a preset's settings: from a dataset, a run, a YAML file, or `--set`."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from storage.errors import TrilightError
from storage.records.safe_read import open_plain, read_plain
from storage.settings.described import checked, settings_record
from storage.settings.overrides import apply_overrides, differences, json_or_word
from storage.typed_json import read_json

if TYPE_CHECKING:
    from pipeline.generation.generate_options import GenerateOptions

Options = TypeVar("Options", bound="GenerateOptions")

_LICENCES = "allowed_licences"
_OF_SOURCES = ("build", "derived", "revisit")
"""Settings of a dataset that name its preset and the datasets that it was made from."""

_MOST_BYTES = 1 << 16
_EXAMPLE = "such as scenes.lights.coloured_share: 0.5"

StatedSettings = dict[str, tuple[Any, int]]
"""Value and line of each setting of a file, by its dotted name."""


@checked()
class BaseSettings:
    """Base settings."""

    like: str | None = None
    """Dataset, or for train a run's folder, whose settings to use; by default those of the
    preset."""
    settings: str | None = None
    """YAML file of changed settings, nested or by dotted names; by default none."""

    @property
    def is_given(self) -> bool:
        """Whether base settings are stated at all."""
        return (self.like, self.settings) != (None, None)


def parse_overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Return the overrides by name; a value is JSON, or a plain word that stands for itself.

    Raises:
        TrilightError: a text without `=`, or a name given twice.
    """
    changes: dict[str, Any] = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator or not name or name in changes:
            raise TrilightError(
                f"--set {text!r}: expected NAME=VALUE with each name once, such as "
                "scenes.lights.coloured_share=0.5."
            )
        changes[name] = _value(value, f"--set {name:.200}")
    return changes


def with_base_settings(options: Options, base: BaseSettings) -> Options:
    """Return dataset options whose `changes` hold all differences from the preset.

    Raises:
        TrilightError: settings cannot be read, or the preset refuses a value, also one that the
            options state.
    """
    from pipeline.presets.registry import option_overrides, preset_settings  # train does without

    from_options = option_overrides(options.seed, options.resolution, vars(options))
    stated = {**from_options, **options.changes}
    changes = merge_overrides(preset_settings(options.build), base, _dataset_record(base), stated)
    if not base.is_given:
        return options
    if _LICENCES in changes:  # the option adds licences to those of any source of settings
        changes[_LICENCES] = sorted({*changes[_LICENCES], *options.allow_licences})
    return dataclasses.replace(options, changes=changes)


def merge_overrides(
    settings: Any, base: BaseSettings, liked: Mapping[str, Any], stated: Mapping[str, Any]
) -> dict[str, Any]:
    """Return all overrides of a preset's settings by dotted name, and check the result.

    Args:
        base: names a settings file, which overrides `liked`.
        liked: record of the settings to use instead of the preset's; may be empty.
        stated: values of other options and of `--set` by dotted name; they override both.

    Raises:
        TrilightError: a file cannot be read, or a value is refused; for a value of the file, the
            message names its line.
    """
    filed = {} if base.settings is None else read_settings_file(base.settings)
    values = {name: value for name, (value, _) in filed.items()}
    merged: dict[str, Any] = {}
    before = {name: each for name, each in settings_record(settings).items() if name in liked}
    like = {name: new for name, _, new in differences(before, liked, alike=True)}
    for layer in (like, values, stated):
        for name, value in layer.items():  # a whole group replaces the values within it
            unchanged = [old for old in merged if not f"{old}.".startswith(f"{name}.")]
            merged = {old: merged[old] for old in unchanged} | {name: value}
    try:
        apply_overrides(settings, merged)
    except TrilightError as error:
        lines = [line for name, (_, line) in filed.items() if f"'{name}'" in str(error)]
        if not lines:
            raise
        raise TrilightError(f"{base.settings}, line {lines[0]}: {error}") from error
    return merged


def _dataset_record(base: BaseSettings) -> dict[str, Any]:
    """Return the settings of the dataset of `--like`, without the name of its preset."""
    from storage.dataset.dataset import open_dataset

    settings = {} if base.like is None else open_dataset(base.like).manifest.settings
    record = {name: value for name, value in settings.items() if name not in _OF_SOURCES}
    if "listed_shards" in record.get("splits", {}):  # those of yet another dataset
        splits = record["splits"].items()
        record["splits"] = {name: value for name, value in splits if name != "listed_shards"}
    return record


def run_record(base: BaseSettings) -> dict[str, Any]:
    """Return the settings of the run of `--like`, without the name of its preset.

    Raises:
        TrilightError: the folder is not that of a run, or the run uses a removed feature.
    """
    if base.like is None:
        return {}
    from train.settings import known_settings

    path = Path(base.like) / "settings.json"
    try:
        settings = dict(read_json(read_plain(path), dict[str, Any], str(path))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrilightError(
            f"--like {base.like}: {path} cannot be read; expected the folder of a run."
        ) from error
    known = known_settings(settings, f"--like {base.like}")
    return {name: value for name, value in known.items() if name != "run"}


def read_settings_file(file: str) -> StatedSettings:
    """Return the settings of a YAML file, nested or by dotted names.

    Values are read as `--set` reads them: a quoted one is a text, a plain one is JSON or a word.

    Raises:
        TrilightError: the file cannot be read, is no mapping, holds an alias, or states a setting
            twice; the message names file and line.
    """
    import yaml  # takes time, and most commands need none

    try:
        with open_plain(Path(file)) as stream:
            data = stream.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise TrilightError(
                f"--settings {file}: too large; expected at most {_MOST_BYTES} bytes."
            )
        root = yaml.compose(data.decode(), yaml.SafeLoader)
        for event in yaml.parse(data.decode(), yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):  # it could expand without limit
                raise _mistake(file, event, "an alias; expected the value itself")
        values = () if root is None else _entries(root, file)
        stated: StatedSettings = {}
        for name, value, line in values:
            if name in stated:
                raise TrilightError(
                    f"{file}, line {line}: {name} is given twice; expected it once."
                )
            stated[name] = value, line
    except RecursionError as error:
        raise TrilightError(
            f"--settings {file}: nested too deeply; expected names with values, {_EXAMPLE}."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise TrilightError(f"--settings {file}: not readable ({error}).") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "it holds a character that YAML does not"
        raise TrilightError(f"{file}, line {mark.line + 1 if mark else 1}: {problem}.") from error
    return stated


def _mistake(file: str, node: Any, problem: str) -> TrilightError:
    """Return the complaint about a node of YAML, or an event."""
    return TrilightError(f"{file}, line {node.start_mark.line + 1}: {problem}.")


def _entries(node: Any, file: str, prefix: str = "") -> Iterator[tuple[str, Any, int]]:
    """Yield dotted name, value and line of each setting below a node of YAML."""
    if node.id != "mapping":
        raise _mistake(file, node, f"expected names with values, {_EXAMPLE}")
    for key, value in node.value:
        if key.id != "scalar":
            raise _mistake(file, key, "expected the name of a setting")
        name = prefix + key.value
        if value.id == "mapping":
            yield from _entries(value, file, f"{name}.")
        else:
            yield name, _json(value, file, name), key.start_mark.line + 1


def _json(node: Any, file: str, name: str) -> Any:
    """Return a node as a JSON value; `name` is the setting, for messages."""
    if node.id == "sequence":
        return [_json(entry, file, name) for entry in node.value]
    if node.id == "mapping":
        values = {str(key.value): _json(value, file, name) for key, value in node.value}
        if len(values) < len(node.value):
            raise _mistake(file, node, "a name is given twice; expected it once")
        return values
    line = node.start_mark.line + 1
    return node.value if node.style else _value(node.value, f"{file}, line {line}: {name}")


def _value(text: str, where: str) -> Any:
    """Return a value as it is typed; `where` begins the complaint."""
    try:
        return json_or_word(text)
    except TrilightError as error:
        raise TrilightError(f"{where}: {error}") from error
