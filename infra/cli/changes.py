"""`--set NAME=VALUE` of the command line: settings by their names in a manifest."""

import json
from collections.abc import Iterable
from typing import Any

from storage.errors import TrilightError


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
            changes[name] = json.loads(value)
        except json.JSONDecodeError:
            changes[name] = value
    return changes
