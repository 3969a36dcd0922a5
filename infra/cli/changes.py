"""Settings that differ from the named ones: as a dataset or run has them, of a file, by `--set`."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.settings.changes import changed, differences, json_or_word
from storage.settings.described import checked, settings_record
from storage.typed_json import read_json

_OF_SOURCES = ("build", "derived", "revisit")
"""What the settings of a dataset say of its name and of the datasets that it was made of."""

if TYPE_CHECKING:
    from infra.cli.settings_file import Stated


@checked()
class Shared:
    """Settings from elsewhere, which other options and --set change further."""

    like: str | None = None
    """Dataset (a folder or a URL), or for train a run (its folder), whose settings to use; by
    default those of the given name."""
    settings: str | None = None
    """YAML file of changed settings, nested or by dotted names; by default there is none."""

    @property
    def is_given(self) -> bool:
        """Whether there are any."""
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
    settings: Any, shared: Shared, liked: Mapping[str, Any], stated: Mapping[str, Any]
) -> dict[str, Any]:
    """Return by dotted name what differs from named settings, and check that all fits together.

    Args:
        settings: the named ones.
        shared: names a file, which counts more than `liked`.
        liked: the record of other settings that was asked for, or none.
        stated: values that other options and `--set` state, by dotted name; they count most.

    Raises:
        TrilightError: a file that cannot be read, or a value that is refused; where it is one of
            the file, its line is named.
    """
    filed = {} if shared.settings is None else _read(shared.settings)
    values = {name: value for name, (value, _) in filed.items()}
    found: dict[str, Any] = {}
    for layer in (differences(settings_record(settings), liked), values, stated):
        for name, value in layer.items():  # a whole group takes the place of what was in it
            kept = [old for old in found if not f"{old}.".startswith(f"{name}.")]
            found = {old: found[old] for old in kept} | {name: value}
    try:
        changed(settings, found)
    except TrilightError as error:
        lines = [line for name, (_, line) in filed.items() if f"'{name}'" in str(error)]
        if not lines:
            raise
        raise TrilightError(f"{shared.settings}, line {lines[0]}: {error}") from error
    return found


def _read(file: str) -> "Stated":
    from infra.cli.settings_file import read_settings_file  # YAML takes time to import

    return read_settings_file(file)


def dataset_record(shared: Shared) -> dict[str, Any]:
    """Return the settings of the dataset that is to be followed, without the name of its build."""
    from storage.dataset.dataset import open_dataset

    settings = {} if shared.like is None else open_dataset(shared.like).manifest.settings
    found = {name: value for name, value in settings.items() if name not in _OF_SOURCES}
    if "listed_shards" in found.get("splits", {}):  # those of yet another dataset
        splits = found["splits"].items()
        found["splits"] = {name: value for name, value in splits if name != "listed_shards"}
    return found


def run_record(shared: Shared) -> dict[str, Any]:
    """Return the settings of the run that is to be followed, without its name.

    Raises:
        TrilightError: the folder is not that of a run, or the run uses what was removed.
    """
    if shared.like is None:
        return {}
    from train.stored_settings import known_settings  # it brings the checker of settings along

    path = Path(shared.like) / "settings.json"
    try:
        settings = dict(read_json(read_plain(path), dict[str, Any], str(path))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrilightError(
            f"--like {shared.like}: {path} cannot be read; expected the folder of a run."
        ) from error
    known = known_settings(settings, f"--like {shared.like}")
    return {name: value for name, value in known.items() if name != "run"}
