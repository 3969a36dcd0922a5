"""Where Trilight keeps what it can make again, outside of any dataset."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Return a folder of the user's cache: below TRILIGHT_CACHE, or ~/.cache/trilight."""
    root = os.environ.get("TRILIGHT_CACHE")
    return (Path(root) if root else Path.home() / ".cache" / "trilight") / name
