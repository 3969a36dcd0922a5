"""The one sentence about what earlier versions stored and this one no longer reads."""

from collections.abc import Mapping
from typing import Any

from storage.errors import TrilightError

LAST_COMMIT = "643b412e"
"""The last commit that reads what was removed in November 2026."""


def removal_message(thing: str) -> str:
    """Return the refusal of `thing`, such as "weights.safetensors: sky tokens"."""
    return f"{thing}: removed since, and commit {LAST_COMMIT} is the last that reads it."


def without_removed(
    record: Mapping[str, Any], removed: Mapping[str, Any], source: str
) -> dict[str, Any]:
    """Return a stored record without the removed settings.

    Args:
        record: settings by name.
        removed: the removed settings, at the values that meant none.
        source: what stands before a setting's name in the refusal.

    Raises:
        TrilightError: a removed setting has another value.
    """
    for name, off in removed.items():
        if record.get(name, off) != off:
            raise TrilightError(removal_message(f"{source}.{name} is {record[name]!r}"))
    return {name: value for name, value in record.items() if name not in removed}
