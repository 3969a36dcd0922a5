"""Leaving at once, without waiting for threads, children or libraries."""

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

_SHOW_CURSOR = "\x1b[?25h"
_temporary: set[Path] = set()


def leave(message: str, status: int) -> NoReturn:
    """End at once: every child ends with its parent, and every file is whole or absent."""
    sys.stdout.flush()
    if sys.stdout.isatty():  # a progress bar hides the cursor, which stands behind it
        sys.stdout.write(f"{_SHOW_CURSOR}\n")
        sys.stdout.flush()
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()
    for folder in _temporary:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(status)


@contextlib.contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """Lend an empty folder that is gone after the block, and after Ctrl-C too."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    _temporary.add(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _temporary.discard(folder)
