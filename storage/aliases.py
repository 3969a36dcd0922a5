"""Names for people, and the names that datasets, runs and digests keep for the same things."""

from collections.abc import Mapping

PRESET_ALIASES = {"tiny": "smoke"}
"""Dataset presets and training presets."""

OBJECTS = {"procedural:": "builtin:"}
"""Sources of objects; what follows the colon stays."""

NETWORKS = {"default": "builtin:"}
"""Networks that Trilight ships."""


def name_for_people(stored: str, names: Mapping[str, str]) -> str:
    """Return the alias of a stored name, or the name itself where it has none."""
    return next((alias for alias, name in names.items() if name == stored), stored)


def stored_name(typed: str, names: Mapping[str, str]) -> str:
    """Return the stored name of a typed one; a name that is no alias stands for itself."""
    for alias, stored in names.items():
        if typed == alias or (alias.endswith(":") and typed.startswith(alias)):
            return stored + typed.removeprefix(alias)
    return typed
