"""Extensions for the length of a test: loaded into this process, and taken back."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene_templates.templates import TEMPLATES
from storage import extensions
from storage.extensions import VARIABLE, Extension, load_extension, unload
from tests.conftest import ROOT

EXAMPLES = ROOT / "examples"


@contextmanager
def room_for_extensions() -> Iterator[None]:
    """Take back whatever the block loads, and what it says in the environment."""
    before, variable = set(extensions._loaded), os.environ.get(VARIABLE)
    try:
        yield
    finally:
        for name in set(extensions._loaded) - before:
            unload(extensions._loaded[name])
        os.environ.pop(VARIABLE, None)
        if variable is not None:
            os.environ[VARIABLE] = variable


@contextmanager
def loaded(path: Path) -> Iterator[Extension]:
    """Load a file for the block."""
    with room_for_extensions():
        yield load_extension(path)


def parts_of(template: str) -> tuple[str, ...]:
    """Return the shell parts of a template that this process knows; for children too."""
    return TEMPLATES.find(template).parts


def written(folder: Path, text: str, name: str = "own.py") -> Path:
    """Write an extension."""
    path = folder / name
    path.write_text(text)
    return path
