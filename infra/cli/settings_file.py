"""Reads `--settings FILE.yaml`: values by dotted name, each with its line in the file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from yaml.error import MarkedYAMLError

from storage.errors import TrilightError
from storage.records.safe_read import open_plain
from storage.settings.changes import json_or_word

_MOST_BYTES = 1 << 16
_EXAMPLE = "such as scenes.lights.coloured_share: 0.5"

StatedSettings = dict[str, tuple[Any, int]]
"""Value and line of each setting, by its dotted name."""


def read_settings_file(file: str) -> StatedSettings:
    """Return the settings of a YAML file, nested or by dotted names.

    Values are read as `--set` reads them: a quoted one is a text, a plain one is JSON or a word.

    Raises:
        TrilightError: the file cannot be read, is no mapping, or states a setting twice; the
            message names file and line.
    """
    try:
        with open_plain(Path(file)) as stream:
            data = stream.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise TrilightError(
                f"--settings {file}: too large; expected at most {_MOST_BYTES} bytes."
            )
        root = yaml.compose(data.decode(), Loader=_Loader)
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
    stated: StatedSettings = {}
    for name, value, line in [] if root is None else _entries(root, file, ""):
        if name in stated:
            raise TrilightError(f"{file}, line {line}: {name} is given twice; expected it once.")
        stated[name] = value, line
    return stated


class _Loader(yaml.SafeLoader):
    """Reader that refuses aliases, which could expand without limit or contain themselves."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise MarkedYAMLError(problem="an alias; expected the value itself", problem_mark=mark)
        return super().compose_node(parent, index)


def _entries(node: yaml.Node, file: str, prefix: str) -> Iterator[tuple[str, Any, int]]:
    """Yield dotted name, value and line of each setting below a node."""
    if not isinstance(node, yaml.MappingNode):
        raise TrilightError(f"{file}, line {_line(node)}: expected names with values, {_EXAMPLE}.")
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise TrilightError(f"{file}, line {_line(key)}: expected the name of a setting.")
        if isinstance(value, yaml.MappingNode):
            yield from _entries(value, file, f"{prefix}{key.value}.")
        else:
            name = f"{prefix}{key.value}"
            yield name, _json(value, file, name), _line(key)


def _json(node: yaml.Node, file: str, name: str) -> Any:
    """Return a node as a JSON value; `name` is the setting, for messages."""
    if isinstance(node, yaml.SequenceNode):
        return [_json(entry, file, name) for entry in node.value]
    if isinstance(node, yaml.MappingNode):
        values = {str(key.value): _json(value, file, name) for key, value in node.value}
        if len(values) < len(node.value):
            raise TrilightError(
                f"{file}, line {_line(node)}: a name is given twice; expected it once."
            )
        return values
    try:
        return json_or_word(node.value) if node.style is None else node.value
    except TrilightError as error:
        raise TrilightError(f"{file}, line {_line(node)}: {name}: {error}") from error


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
