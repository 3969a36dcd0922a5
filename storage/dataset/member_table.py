"""Names and places of the members of a shard, in 33 bytes each instead of 300 as Python objects."""

from collections.abc import Iterable, Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

Row = tuple[str, int, int]
"""Name, offset of the first byte, number of bytes."""


class MemberTable(Sequence[Row]):
    """Rows that are unpacked when they are asked for: ask for all of them at once."""

    __slots__ = ("_names", "_places")

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        """Pack rows; names hold no line break, numbers are whole ones from 0 to below 2^63."""
        held = list(rows)
        self._names = "\n".join(name for name, _, _ in held).encode()
        self._places: NDArray[np.int64] = np.array(
            [(offset, num_bytes) for _, offset, num_bytes in held], np.int64
        ).reshape(-1, 2)

    def __iter__(self) -> Iterator[Row]:
        names = self._names.decode().split("\n") if len(self) else []
        return zip(names, *self._places.T.tolist(), strict=True)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, at: int) -> Row: ...

    @overload
    def __getitem__(self, at: slice) -> Sequence[Row]: ...

    def __getitem__(self, at: int | slice) -> Row | Sequence[Row]:
        return list(self)[at]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MemberTable):
            return NotImplemented
        return self._names == other._names and np.array_equal(self._places, other._places)

    def __hash__(self) -> int:
        return hash((self._names, self._places.tobytes()))

    def __repr__(self) -> str:
        return f"MemberTable({list(self)!r})"
