"""Reading from outside: only plain files, and nothing in them decides how much memory is taken."""

import contextlib
import errno
import json
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from storage.errors import TrilightError

MAX_HEADER_BYTES = 1 << 20
"""A scene's header takes about 1 KiB."""

_GZIP = 31
"""zlib's name for a gzip stream; its header then holds no time."""


def open_plain(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: as `open`, or it is something else: opening a FIFO would block forever.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # of regular files, it changes nothing
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a plain file", str(path))
    return os.fdopen(descriptor, "rb")


@contextlib.contextmanager
def name_unreadable(name: object) -> Iterator[None]:
    """Raise TrilightError, which names the file, for what the system says of it in the block."""
    try:
        yield
    except OSError as error:
        raise TrilightError(f"{name}: cannot be read ({error.strerror}).") from error


def read_plain(path: Path) -> bytes:
    """Return the bytes of a regular file; raises OSError as `open_plain`."""
    with open_plain(path) as stream:
        return stream.read()


def read_safetensors(
    data: bytes, max_header_bytes: int = MAX_HEADER_BYTES, *, name: str = "safetensors"
) -> tuple[dict[str, NDArray], dict[str, str]]:
    """Return arrays and metadata of a safetensors file held in memory.

    Raises:
        TrilightError: as `safetensors_header`, or the library refuses the bytes (it checks every
            offset against the length of `data`).
    """
    header = safetensors_header(data, max_header_bytes, name=name)
    try:
        arrays = load(data)
    except (SafetensorError, ValueError, LookupError) as error:
        # the last one of a type that numpy has not, such as BF16
        raise TrilightError(f"{name}: unreadable; expected a safetensors file.") from error
    metadata = header.get("__metadata__", {})
    return {name: np.asarray(array) for name, array in arrays.items()}, metadata


def safetensors_header(
    data: bytes, max_header_bytes: int = MAX_HEADER_BYTES, *, name: str = "safetensors"
) -> dict[str, Any]:
    """Return the header of a safetensors file held in memory, as it stands there.

    Args:
        data: the file, or as much of it as the header may take.
        max_header_bytes: a longer header is refused.
        name: of the file, for messages.

    Raises:
        TrilightError: the bytes are truncated, the header is larger than `max_header_bytes`, or it
            is no JSON object.
    """
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(max_header_bytes, len(data) - 8):
        raise TrilightError(
            f"{name}: the header claims {length} bytes of a file of {len(data)}; expected at most "
            f"{max_header_bytes}. The file is damaged, or no safetensors file."
        )
    try:
        header = json.loads(data[8 : 8 + length])
    except (ValueError, RecursionError) as error:
        raise TrilightError(f"{name}: unreadable; expected a safetensors file.") from error
    if not isinstance(header, dict):
        raise TrilightError(f"{name}: the header is not a JSON object.")
    return header


def pack_gzip(data: bytes) -> bytes:
    """Return a gzip stream of some bytes; equal bytes give equal streams."""
    return zlib.compress(data, 6, wbits=_GZIP)


def unpack_gzip(packed: bytes, most: int, name: str, *, is_whole: bool = True) -> bytes:
    """Return what a gzip stream holds, at most so many bytes.

    Args:
        packed: the stream.
        most: bytes of memory that may be taken.
        name: of the stream, for messages.
        is_whole: refuse a stream that holds more, is cut short or has bytes after its end.

    Raises:
        TrilightError: damaged, or not whole.
    """
    unpacker = zlib.decompressobj(wbits=_GZIP)
    try:
        data = unpacker.decompress(packed, most)
    except zlib.error as error:
        raise TrilightError(f"{name} is damaged ({error}).") from error
    if is_whole and (not unpacker.eof or unpacker.unused_data):
        raise TrilightError(
            f"{name} is cut short, goes on after its end, or holds more than {most} bytes."
        )
    return data
