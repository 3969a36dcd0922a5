"""No record that leaves a machine names it, its users or its folders."""

import getpass
import os
import platform
import re
import socket
from collections.abc import Mapping
from typing import Any

_PATH = re.compile(r"(?<![\w.:])(?:~|[A-Za-z]:)?(?:[/\\][\w.@+~ -]*[\w.@+~-])+[/\\]?|\bfile:\S+")
_COMMON = {"localhost", "root", "user", "none", "linux"}
"""Names that say nothing of a person or a place, and are words of other things."""
PATH, NAME = "<path>", "<name>"


def own_names() -> tuple[str, ...]:
    """Return what this machine and its user are called, longest first."""
    found = {platform.node(), socket.gethostname(), os.environ.get("HOSTNAME", "")}
    for variable in ("USER", "LOGNAME", "SUDO_USER"):
        found.add(os.environ.get(variable, ""))
    try:
        found.add(getpass.getuser())
    except (KeyError, OSError):  # a user without an entry
        pass
    parts = {part for name in found for part in (name, name.split(".")[0])}
    useful = {part for part in parts if len(part) > 2 and part.lower() not in _COMMON}
    return tuple(sorted(useful, key=len, reverse=True))


def without_traces(value: Any, names: tuple[str, ...] | None = None) -> Any:
    """Return a JSON value in whose strings paths and own names are replaced.

    Args:
        value: mappings (their keys are kept), lists, strings, numbers.
        names: what else to replace, as whole words; by default `own_names()`.
    """
    names = own_names() if names is None else names
    if isinstance(value, str):
        return _cleaned(value, names)
    if isinstance(value, Mapping):
        return {key: without_traces(entry, names) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_traces(entry, names) for entry in value]
    return value


def _cleaned(text: str, names: tuple[str, ...]) -> str:
    text = _PATH.sub(PATH, text)
    for name in names:
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", NAME, text, flags=re.IGNORECASE)
    return text
