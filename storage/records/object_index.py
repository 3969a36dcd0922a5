"""The index of a frozen lock: where each object stands in it, and what a draw asks of all of them.

A scene draws its objects by their number in their split, by the triangles of their coarsest level
and by their licences' camp. Those are columns here, of the rows of objects sorted by split and
uid, so that the one to three that are drawn are found without reading any other. The index follows
from the lock and the assets that it names; it may be deleted, and is then made again.

The file is a safetensors file of which columns are read in parts: its arrays are `offset` u64 [N]
(byte of the row in the lock), `least` u32 [N], `camp` u16 [N], and `name` u8 [N, 16].
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.licences import share_alike_camp
from storage.records.objects import OBJECT, LockRows
from storage.records.safe_read import MAX_HEADER_BYTES, open_plain, safetensors_header
from storage.typed_json import read_json

_FORMAT = 1
_TYPES = {"U8": "<u1", "U16": "<u2", "U32": "<u4", "U64": "<u8"}
_NAME_BYTES = 16


@dataclass(frozen=True, kw_only=True)
class CampSizes:
    """The objects of one share-alike camp, or of none."""

    count: int
    least: int
    """Triangles of the coarsest level of the simplest one."""
    most: int
    """The same of the most demanding one."""


@dataclass(frozen=True, kw_only=True)
class SplitRows:
    """The rows of one split."""

    start: int
    stop: int
    camps: Mapping[str, CampSizes]
    """Sizes by camp; "" is that of objects without one."""


@dataclass(frozen=True, kw_only=True)
class IndexFacts:
    """Identity and contents of an index of objects."""

    lock_sha256: str
    lock_bytes: int
    asked: str
    """Digest of the query to the source; a change of it lists the source again."""
    num_found: int
    """Objects in the source, refused ones included."""
    num_maps: int
    """Rows of the lock that are textures and skies; they are not in the index."""
    camps: tuple[str, ...]
    """Camps by their number in the column."""
    splits: Mapping[str, SplitRows]
    format: int = _FORMAT

    @property
    def num_objects(self) -> int:
        """Number of frozen objects."""
        return sum(rows.stop - rows.start for rows in self.splits.values())


def write_object_index(
    path: Path, lock: Path, assets: Iterable[tuple[str, int]], *, query_sha256: str, num_found: int
) -> None:
    """Write the index of a lock atomically.

    Args:
        path: the index.
        lock: the file of the lock.
        assets: of each object of the lock, in its order, the name of the prepared file (32
            hexadecimal digits) and the triangles of the coarsest level.
        query_sha256: digest of the query to the source.
        num_found: objects in the source, refused ones included.

    Raises:
        TrilightError: the lock cannot be read, or the index cannot be written.
    """
    objects = ((offset, row) for offset, row in LockRows(lock) if row.kind == OBJECT)
    rows = [
        (row.split, share_alike_camp(row.licence), offset, *asset)
        for (offset, row), asset in zip(objects, assets, strict=True)
    ]
    rows.sort(key=itemgetter(0))
    split_names, camp_names, offsets, names, least_triangles = zip(*rows, strict=True)
    least = np.array(least_triangles, "<u4")
    camps = sorted(set(camp_names))
    camp = np.array([camps.index(name) for name in camp_names], "<u2")
    arrays: dict[str, NDArray[Any]] = {
        "offset": np.array(offsets, "<u8"),
        "least": least,
        "camp": camp,
        "name": np.frombuffer(bytes.fromhex("".join(names)), "<u1").reshape(-1, _NAME_BYTES),
    }
    splits = {}
    start = 0
    for split, count in Counter(split_names).items():
        stop = start + count
        sizes = camp_sizes(least[start:stop], camp[start:stop], camps)
        splits[split] = SplitRows(start=start, stop=stop, camps=sizes)
        start = stop
    data = lock.read_bytes()
    facts = IndexFacts(
        lock_sha256=sha256_hex(data),
        lock_bytes=len(data),
        asked=query_sha256,
        num_found=num_found,
        num_maps=data.count(b"\n") - len(rows),
        camps=tuple(camps),
        splits=splits,
    )
    header = json.dumps(dataclasses.asdict(facts), sort_keys=True)
    write_atomically(path, save(arrays, metadata={"objects": header}))


def camp_sizes(
    least: NDArray[Any], camp: NDArray[Any], camps: Sequence[str]
) -> dict[str, CampSizes]:
    """Return the sizes of the objects of each camp that occurs.

    Args:
        least: [N] triangles of the coarsest level of each object.
        camp: [N] number of the camp of each object.
        camps: names of the camps by number.
    """
    sizes = {name: least[camp == number] for number, name in enumerate(camps)}
    return {
        name: CampSizes(count=len(some), least=int(some.min()), most=int(some.max()))
        for name, some in sizes.items()
        if len(some)
    }


class ObjectIndex:
    """An index of which only the rows that are asked for are read: its columns are mapped."""

    def __init__(self, path: Path) -> None:
        """Open an index; raises TrilightError where it is missing, damaged or of another form."""
        try:
            with open_plain(path) as stream:
                head = stream.read(8 + MAX_HEADER_BYTES)
            header = safetensors_header(head, name=str(path))
            self.facts = read_json(header.pop("__metadata__")["objects"], IndexFacts, "its header")
            if self.facts.format != _FORMAT:
                raise ValueError("another format")
            first = 8 + int.from_bytes(head[:8], "little")
            self._columns: dict[str, np.memmap[Any, Any]] = {}
            for name, entry in header.items():
                at = first + int(entry["data_offsets"][0])
                shape = tuple(entry["shape"])
                self._columns[name] = np.memmap(path, _TYPES[entry["dtype"]], "r", at, shape)
        except (OSError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise TrilightError(
                f"{path}: is no index of objects ({error}); delete it, and it is made again."
            ) from error

    def column(self, name: str, rows: SplitRows) -> NDArray[Any]:
        """Return `offset`, `least` or `camp` of the rows of a split."""
        return self._columns[name][rows.start : rows.stop]

    def asset_name(self, row: int) -> str:
        """Return the name of the prepared file of a row of the whole index."""
        return self._columns["name"][row].tobytes().hex()
