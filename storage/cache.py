"""The user's cache: files outside of any dataset that Trilight can make again."""

import os
import stat
from pathlib import Path
from typing import IO, Any

from storage.errors import TrilightError


def cache_folder(name: str) -> Path:
    """Return a folder of the user's cache: below TRILIGHT_CACHE, or ~/.cache/trilight.

    Raises:
        TrilightError: there is no home directory, or something else is where the cache would be.
    """
    configured = os.environ.get("TRILIGHT_CACHE")
    try:
        root = Path(configured) if configured else Path.home() / ".cache" / "trilight"
    except RuntimeError as error:  # neither HOME nor an entry of /etc/passwd
        raise TrilightError(
            f"user {os.getuid()} has no home directory; expected one for the cache. Set "
            "TRILIGHT_CACHE to a folder of your own."
        ) from error
    existing = next((place for place in (root, *root.parents) if os.path.lexists(place)), root)
    if os.path.lexists(existing) and not os.path.isdir(existing):
        raise TrilightError(
            f"the cache {str(root)!r}: {str(existing)!r} is no folder; expected one, or a name "
            "that is free. Set TRILIGHT_CACHE to a folder of your own."
        )
    return root / name


def private_folder(path: Path) -> Path:
    """Make a folder that only its user may enter, or make an existing one so, and return it.

    Raises:
        TrilightError: it cannot be made so, or is shared by all users, as /tmp is.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = path.stat().st_mode
        if mode & stat.S_ISVTX:
            raise TrilightError(
                f"{path} is shared by all users; expected a folder of your own. Name one below it."
            )
        if stat.S_IMODE(mode) != 0o700:
            path.chmod(0o700)
    except OSError as error:
        raise TrilightError(
            f"{path} cannot be made private ({error.strerror}); expected a folder of your own."
        ) from error
    return path


def open_private(path: Path, mode: str) -> IO[Any]:
    """Open a file to write; where it is new, only its user may read it."""
    return open(path, mode, opener=lambda name, flags: os.open(name, flags, 0o600))
