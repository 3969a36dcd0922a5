"""`--settings FILE.yaml`: values by dotted name, each with the line that states it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from storage.errors import TrilightError
from storage.settings.changes import json_or_word

_MOST_BYTES = 1 << 24
_EXAMPLE = "such as scenes.lights.coloured_share: 0.5"

Stated = dict[str, tuple[Any, int]]
"""Value and line of each setting, by its dotted name."""


def read_settings_file(file: str) -> Stated:
    """Return what a YAML file of settings states, nested or by dotted names.

    Values are read as `--set` reads them: a quoted one is a text, a plain one is JSON or a word.

    Raises:
        TrilightError: a file that cannot be read, is no mapping, or states something twice; file
            and line are named.
    """
    try:
        if Path(file).stat().st_size > _MOST_BYTES:
            raise TrilightError(f"--settings {file}: too large; expected {_MOST_BYTES} bytes.")
        root = yaml.compose(Path(file).read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise TrilightError(f"--settings {file}: not readable ({error}).") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "it holds a character that YAML does not"
        raise TrilightError(f"{file}, line {mark.line + 1 if mark else 1}: {problem}.") from error
    stated: Stated = {}
    for name, value, line in [] if root is None else _entries(root, file, ""):
        if name in stated:
            raise TrilightError(f"{file}, line {line}: {name} is given twice; expected it once.")
        stated[name] = value, line
    return stated


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
            yield f"{prefix}{key.value}", _json(value, file), _line(key)


def _json(node: yaml.Node, file: str) -> Any:
    """Return a value as JSON has it."""
    if isinstance(node, yaml.SequenceNode):
        return [_json(entry, file) for entry in node.value]
    if isinstance(node, yaml.MappingNode):
        found = {str(key.value): _json(value, file) for key, value in node.value}
        if len(found) < len(node.value):
            raise TrilightError(
                f"{file}, line {_line(node)}: a name is given twice; expected it once."
            )
        return found
    return json_or_word(node.value) if node.style is None else node.value


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
