"""Reads HDF5 arrays of untrusted files; every claim is checked before memory is allocated.

An HDF5 file can refer to other files (external links, external storage, virtual datasets), load a
filter as a plug-in, claim shapes without the data, and hold chunks that inflate without end. So
only plain arrays are read, and this module unpacks chunks instead of the library's filters.
The library still parses the structure of the file, so untrusted files are opened in a child process
with limits (pipeline.isolation).
"""

import contextlib
import math
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.safe_read import name_unreadable, open_plain

MAX_BLOCK_BYTES = 64 << 20
"""Maximum bytes of one block of an array."""

MAX_CHUNKS = 1 << 22
"""Maximum number of chunks in an array; 4096 triangles with published textures take 22528."""

_DEFLATE = 1
_SHUFFLE = 2
"""Numbers of the only supported filters."""


@contextlib.contextmanager
def open_h5(path: Path) -> Iterator[Any]:
    """Open a file for reading and yield its root group.

    Raises:
        TrilightError: the file is not HDF5, or damaged. Errors of the `with` block get its name.
    """
    import h5py  # slow to import, and rarely needed

    with name_unreadable(path.name):
        open_plain(path).close()
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except TrilightError as error:
        raise TrilightError(f"{path.name}: {error}") from error
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise TrilightError(f"{path.name}: not a readable HDF5 file.") from error


def plain_array(group: Any, name: str, shape: Sequence[int | None], longest: int) -> Any:
    """Return an h5py dataset, unread: little-endian floats that the file itself holds.

    In the required shape, None is any length from 1 to `longest`.

    Raises:
        TrilightError: the array is missing, a link, or of another type or shape.
    """
    import h5py
    from h5py import h5t

    if name not in sorted(group):  # follows no link
        raise TrilightError(f"{name}: missing; expected an array {_format_shape(shape)}.")
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise TrilightError(f"{name}: is a link; expected an array in the file itself.")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise TrilightError(f"{name}: is no array; expected one {_format_shape(shape)}.")
    claimed = dataset.shape or ()
    fits = len(claimed) == len(shape) and all(
        1 <= got <= longest if expected is None else got == expected
        for got, expected in zip(claimed, shape, strict=True)
    )
    if not fits:
        raise TrilightError(
            f"{name}: has shape {list(claimed)}; expected {_format_shape(shape)} with lengths of "
            f"at most {longest}."
        )
    stored = dataset.id.get_type()
    if not any(map(stored.equal, (h5t.IEEE_F16LE, h5t.IEEE_F32LE, h5t.IEEE_F64LE))):
        raise TrilightError(
            f"{name}: has another type of elements; expected little-endian floats of 16, 32 or 64 "
            "bits."
        )
    return dataset


def iterate_blocks(array: Any) -> Iterator[tuple[tuple[slice, ...], NDArray]]:
    """Yield (slices, values) of blocks that cover the array once; one block is in memory.

    Raises:
        TrilightError: bytes are missing, damaged, outside the file, or packed by filters other than
            deflate and shuffle.
    """
    from h5py import h5d

    plan = array.id.get_create_plist()
    if plan.get_external_count() or plan.get_layout() == h5d.VIRTUAL:
        raise _error(array, "its bytes are elsewhere; expected them in the file.")
    if plan.get_layout() == h5d.CHUNKED:
        yield from _iterate_chunks(array, plan)
        return
    num_bytes = math.prod(array.shape) * array.dtype.itemsize
    if array.id.get_storage_size() != num_bytes:
        raise _error(array, "holds other bytes than its shape needs.")
    if not array.shape:
        yield (), np.asarray(array[()])
        return
    row_bytes = num_bytes // array.shape[0]
    _require_memory(array, row_bytes, MAX_BLOCK_BYTES)
    rows = MAX_BLOCK_BYTES // row_bytes
    for start in range(0, array.shape[0], rows):
        where = (slice(start, min(start + rows, array.shape[0])),)
        yield where, array[where]


def read_whole(
    group: Any,
    name: str,
    shape: Sequence[int | None],
    longest: int,
    most_bytes: int = MAX_BLOCK_BYTES,
) -> NDArray[np.float32]:
    """Read a whole array of a group as float32.

    Raises:
        TrilightError: the array or a block is unusable (`plain_array`, `iterate_blocks`), it takes
            more than `most_bytes`, or a value is not finite.
    """
    array = plain_array(group, name, shape, longest)
    _require_memory(array, math.prod(array.shape) * 4, most_bytes)
    values = np.zeros(array.shape, np.float32)
    for where, block in iterate_blocks(array):
        require_finite(array, block)
        values[where] = block
    return values


def require_finite(array: Any, values: NDArray) -> None:
    """Raise TrilightError where a value is NaN or infinite, or becomes so as float32."""
    with np.errstate(over="ignore"):
        finite = np.isfinite(values.astype(np.float32))
    if not finite.all():
        raise _error(array, f"holds {values[~finite][0]}; expected finite values.")


def _iterate_chunks(array: Any, plan: Any) -> Iterator[tuple[tuple[slice, ...], NDArray]]:
    size = array.chunks
    filters = [plan.get_filter(at)[0] for at in range(plan.get_nfilters())]
    if filters not in ([], [_DEFLATE], [_SHUFFLE], [_SHUFFLE, _DEFLATE]):
        raise _error(array, f"is packed with filters {filters}; expected deflate, shuffle or none.")
    _require_memory(array, math.prod(size) * array.dtype.itemsize, MAX_BLOCK_BYTES)
    counts = [-(-length // chunk) for length, chunk in zip(array.shape, size, strict=True)]
    if math.prod(counts) > MAX_CHUNKS:
        raise _error(array, f"has {math.prod(counts)} chunks; expected up to {MAX_CHUNKS}.")
    stored_offsets = _list_chunk_offsets(array)
    for where in array.iter_chunks():
        offset = tuple(part.start for part in where)
        if offset not in stored_offsets:
            raise _error(array, f"the chunk at {list(offset)} is missing.")
        _, packed = array.id.read_direct_chunk(offset)
        values = np.frombuffer(_unpack(array, packed, filters), array.dtype).reshape(size)
        yield where, values[tuple(slice(part.stop - part.start) for part in where)]


def _list_chunk_offsets(array: Any) -> set[tuple[int, ...]]:
    """Return the offsets of the stored chunks; none is larger than a block or the file."""
    most = min(MAX_BLOCK_BYTES, array.file.id.get_filesize())
    offsets: set[tuple[int, ...]] = set()

    def add_offset(chunk: Any) -> bool | None:
        if chunk.filter_mask or chunk.size > most or len(offsets) >= MAX_CHUNKS:
            return True  # ends the iteration; the chunk then counts as missing
        offsets.add(chunk.chunk_offset)
        return None

    array.id.chunk_iter(add_offset)
    return offsets


def _unpack(array: Any, packed: bytes, filters: list[int]) -> bytes:
    num_bytes = math.prod(array.chunks) * array.dtype.itemsize
    if _DEFLATE in filters:
        inflater = zlib.decompressobj()
        try:
            # one byte more than expected, whatever the data claims
            packed = inflater.decompress(packed, num_bytes + 1)
        except zlib.error as error:
            raise _error(array, "a chunk is damaged.") from error
        if not inflater.eof:
            raise _error(array, "a chunk ends too early or too late.")
    if len(packed) != num_bytes:
        raise _error(array, "a chunk holds other bytes than its shape needs.")
    if _SHUFFLE in filters:
        planes = np.frombuffer(packed, np.uint8).reshape(array.dtype.itemsize, -1)
        packed = planes.T.tobytes()
    return packed


def _require_memory(array: Any, num_bytes: int, most: int) -> None:
    if num_bytes > most:
        raise _error(array, f"would take {num_bytes} bytes at once; expected at most {most}.")


def _error(array: Any, text: str) -> TrilightError:
    """Return an error of an array, whose name begins its message."""
    return TrilightError(f"{str(array.name).removeprefix('/')}: {text}")


def _format_shape(shape: Sequence[int | None]) -> str:
    return "[" + ", ".join("any" if length is None else str(length) for length in shape) + "]"
