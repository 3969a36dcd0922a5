"""`HeldMaps`: maps that were unpacked and checked, for the next sample that uses them.

They go by the very bytes that they were unpacked from, so that the next call returns what
unpacking would give, in any order of samples and of shards: bytes that are refused once are refused
again. Arrays may not be written to, since several samples share them.
"""

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

from storage.digests import sha256_hex
from storage.records.environment import Environment
from storage.records.texture import Texture

HELD_BYTES = 1 << 26
"""Most bytes that the maps of all open shards of a set take: 40 skies of 512 x 256 texels in
float32, or 340 colours of 256 x 256 in 8 bits."""

Map = TypeVar("Map", Texture, Environment)

_Key = tuple[type, str, str]
"""What a map is said to be and to hold, and the digest of the bytes that it was unpacked from."""


class HeldMaps:
    """The most recently used maps; for several threads at once."""

    def __init__(self, most_bytes: int = HELD_BYTES) -> None:
        """Hold nothing yet.

        Args:
            most_bytes: of all maps together; a larger map is not held.
        """
        self._most = most_bytes
        self._maps: OrderedDict[_Key, Any] = OrderedDict()
        self._lock = threading.Lock()
        self.num_bytes = 0
        """Of the arrays that are held."""

    def get_or_unpack(
        self, kind: type[Map], sha256: str, packed: bytes, unpack: Callable[[], Map]
    ) -> Map:
        """Return the map of some bytes: the held one, or what `unpack` returns, then held.

        Two threads that miss the same map both unpack it.

        Args:
            kind: what it is said to be.
            sha256: of the content that it is said to have.
            packed: what it is unpacked from.
            unpack: makes the map, and raises unless it is lawful and has this content.
        """
        key = kind, sha256, sha256_hex(packed)
        with self._lock:
            if key in self._maps:
                self._maps.move_to_end(key)
                known: Map = self._maps[key]
                return known
        made = unpack()
        _array(made).flags.writeable = False
        with self._lock:
            self._hold(key, made)
        return made

    def _hold(self, key: _Key, made: Texture | Environment) -> None:
        num_bytes = _array(made).nbytes
        if num_bytes > self._most or key in self._maps:
            return
        while self.num_bytes + num_bytes > self._most:
            _, oldest = self._maps.popitem(last=False)
            self.num_bytes -= _array(oldest).nbytes
        self._maps[key] = made
        self.num_bytes += num_bytes


def _array(one: Texture | Environment) -> Any:
    return one.texels if isinstance(one, Texture) else one.radiance_rgb


def with_same_content(one: Map, **changes: Any) -> Map:
    """Return a map with another name or turn; what was computed of its content stays known."""
    other = dataclasses.replace(one, **changes)
    vars(other).update({**vars(one), **vars(other)})
    return other
