"""Ends the process at once, without waiting for threads, children or libraries."""

import contextlib
import io
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from storage.remote.url import escape_lines

_SHOW_CURSOR = "\x1b[?25h"
_temporary: set[Path] = set()


def open_missing_streams() -> None:
    """Open /dev/null for each closed standard stream, whose number a later file would get.

    Characters that the encoding of an open stream lacks are written as escapes.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)
        elif mode == "w" and isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


class InertFormatter(logging.Formatter):
    """Formatter of warnings that escapes control characters."""

    def format(self, record: logging.LogRecord) -> str:
        return escape_lines(super().format(record))


def leave(message: str, status: int) -> NoReturn:
    """End the process at once; children end with it, and every file is whole or absent."""
    out = sys.__stdout__ or sys.stdout
    errors = sys.__stderr__ or sys.stderr
    # A signal may arrive in the middle of a write, and Python refuses (RuntimeError) to write or
    # flush the same stream then: hence the descriptors, which no progress bar redraws either.
    with contextlib.suppress(RuntimeError, OSError):
        sys.stdout.flush()
    if out.isatty():  # a progress bar hides the cursor and leaves it at the end of the bar
        os.write(out.fileno(), f"{_SHOW_CURSOR}\n".encode())
    with contextlib.suppress(OSError):
        os.write(errors.fileno(), f"{escape_lines(message)}\n".encode())
    for folder in _temporary:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(status)


@contextlib.contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """Yield an empty folder that is deleted after the block, also after Ctrl-C."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    _temporary.add(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _temporary.discard(folder)
