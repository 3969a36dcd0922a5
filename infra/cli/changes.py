"""Changes to the settings of a preset: from a dataset, a run, a YAML file, or `--set`."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.settings.changes import changed, differences, json_or_word
from storage.settings.described import checked, settings_record
from storage.typed_json import read_json

_OF_SOURCES = ("build", "derived", "revisit")
"""Settings of a dataset that name its preset and the datasets that it was made from."""

if TYPE_CHECKING:
    from infra.cli.settings_file import StatedSettings


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


def parse_changes(texts: Iterable[str]) -> dict[str, Any]:
    """Return the values by name; a value is JSON, or a plain word that stands for itself.

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
        try:
            changes[name] = json_or_word(value)
        except TrilightError as error:
            raise TrilightError(f"--set {name:.200}: {error}") from error
    return changes


def all_changes(
    settings: Any, base: BaseSettings, liked: Mapping[str, Any], stated: Mapping[str, Any]
) -> dict[str, Any]:
    """Return all changes to a preset's settings by dotted name, and check the changed settings.

    Args:
        settings: settings of the preset.
        base: names a settings file, which overrides `liked`.
        liked: record of the settings to use instead of the preset's; may be empty.
        stated: values of other options and of `--set` by dotted name; they override both.

    Raises:
        TrilightError: a file cannot be read, or a value is refused; for a value of the file, the
            message names its line.
    """
    filed = {} if base.settings is None else _read(base.settings)
    values = {name: value for name, (value, _) in filed.items()}
    merged: dict[str, Any] = {}
    for layer in (differences(settings_record(settings), liked), values, stated):
        for name, value in layer.items():  # a whole group replaces the values within it
            unchanged = [old for old in merged if not f"{old}.".startswith(f"{name}.")]
            merged = {old: merged[old] for old in unchanged} | {name: value}
    try:
        changed(settings, merged)
    except TrilightError as error:
        lines = [line for name, (_, line) in filed.items() if f"'{name}'" in str(error)]
        if not lines:
            raise
        raise TrilightError(f"{base.settings}, line {lines[0]}: {error}") from error
    return merged


def _read(file: str) -> "StatedSettings":
    from infra.cli.settings_file import read_settings_file  # YAML takes time to import

    return read_settings_file(file)


def dataset_record(base: BaseSettings) -> dict[str, Any]:
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
    from train.stored_settings import known_settings  # slow: imports pydantic

    path = Path(base.like) / "settings.json"
    try:
        settings = dict(read_json(read_plain(path), dict[str, Any], str(path))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrilightError(
            f"--like {base.like}: {path} cannot be read; expected the folder of a run."
        ) from error
    known = known_settings(settings, f"--like {base.like}")
    return {name: value for name, value in known.items() if name != "run"}
