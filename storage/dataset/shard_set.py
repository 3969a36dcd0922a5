"""The shards of one split, from which samples are drawn in any order.

A set knows its shards by number and opens each when it is wanted. An open shard gives any of its
samples, in any order and from several threads at once; nothing of it stays in memory but the names
of its members, and of a whole set as many unpacked maps as storage.records.held_maps allows.
"""

import contextlib
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import Member, scan_samples, with_maps
from storage.dataset.shard_places import ShardPlace
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.held_maps import HeldMaps
from storage.records.sample import Sample, decode_sample
from storage.records.stored_sample import StoredSample, stored_sample


class OpenShard:
    """A shard that is being read."""

    def __init__(self, name: str, stream: BinaryIO, held: HeldMaps) -> None:
        """Look at the headers; raises TrilightError as `storage.dataset.shard`.

        Args:
            name: for messages.
            stream: the file.
            held: maps of this shard and others that were unpacked already.
        """
        self.name = name
        self._stream = stream
        self._held = held
        self._maps: dict[str, Member] = {}
        self._samples: list[tuple[str, Mapping[str, Member]]] = list(
            scan_samples(stream, name, self._maps)
        )

    @property
    def keys(self) -> Sequence[str]:
        """The keys of its samples, in the order of the file."""
        return [key for key, _ in self._samples]

    def members(self, row: int) -> dict[str, bytes]:
        """Return the members of a sample by suffix, in one read, and one for each of its maps."""
        _, members = self._samples[row]
        first = min(member.offset for member in members.values())
        end = max(member.offset + member.num_bytes for member in members.values())
        data = self._read(first, end - first)
        contents = {
            suffix: data[member.offset - first : member.offset - first + member.num_bytes]
            for suffix, member in members.items()
        }
        return with_maps(
            contents, self._maps, lambda member: self._read(member.offset, member.num_bytes)
        )

    def _read(self, offset: int, num_bytes: int) -> bytes:
        data = os.pread(self._stream.fileno(), num_bytes, offset)
        if len(data) != num_bytes:
            raise TrilightError(f"{self.name}: became shorter while it was read. Copy it again.")
        return data

    def sample(self, row: int) -> Sample:
        """Return a sample that passes `Sample.check`.

        Raises:
            TrilightError: it is not whole, not readable or breaks a law; names shard and sample.
        """
        with self._name_errors():
            sample = decode_sample(self._samples[row][0], self.members(row), self._held)
            sample.check()
            return sample

    def stored_sample(self, row: int) -> StoredSample:
        """Return a sample whose pictures are unpacked when they are asked for.

        Raises:
            TrilightError: its scene is not readable or breaks a law; names shard and sample.
        """
        with self._name_errors():
            return stored_sample(self._samples[row][0], self.members(row), self._held)

    @contextlib.contextmanager
    def _name_errors(self) -> Iterator[None]:
        try:
            yield
        except TrilightError as error:
            raise TrilightError(f"{self.name}: {error}") from error

    def close(self) -> None:
        """Let go of the file; a cache may then remove it."""
        self._stream.close()


class ShardSet(ABC):
    """Shards by number."""

    names: Sequence[str]
    """Shard names as messages show them."""

    @property
    def parts(self) -> Sequence[range]:
        """The numbers of each dataset's shards; they are those of one unless said."""
        return (range(len(self.names)),)

    @abstractmethod
    def num_samples(self, number: int) -> int:
        """Return how many samples a shard holds; opens it where nothing else tells."""

    @abstractmethod
    def open(self, number: int) -> OpenShard:
        """Open a shard, fetched and checked.

        Raises:
            TrilightError: it cannot be read, or is not what it should be; the message names it.
        """


class ManifestShards(ShardSet):
    """Shards of a manifest: sizes and digests are known, every one is checked."""

    def __init__(self, dataset: Dataset, entries: Sequence[ShardEntry]) -> None:
        self.names = [entry.name for entry in entries]
        self._files = dataset.files
        self._entries = entries
        self._held = HeldMaps()

    def num_samples(self, number: int) -> int:
        return self._entries[number].num_samples

    def open(self, number: int) -> OpenShard:
        entry = self._entries[number]
        shard = _open_or_close(entry.name, self._files.open(entry, checked=True), self._held)
        if len(shard.keys) != entry.num_samples:
            shard.close()
            raise TrilightError(
                f"{entry.name}: holds {len(shard.keys)} samples; expected {entry.num_samples}, as "
                "the manifest says. Run `trilight verify`."
            )
        return shard


class KeysSeen:
    """The keys of all shards that were opened so far, as 8 bytes each."""

    def __init__(self) -> None:
        self._hashes: NDArray[np.uint64] = np.zeros(0, np.uint64)
        self._shards: set[str] = set()
        self._lock = threading.Lock()

    def add(self, shard: str, keys: Sequence[str]) -> None:
        """Note the keys of a shard; raises TrilightError where another shard has one of them."""
        # of 10 million keys, two agree in 8 bytes of their sha256 once in 400,000 sets
        new = np.array([int(sha256_hex(key.encode())[:16], 16) for key in keys], np.uint64)
        with self._lock:
            if shard in self._shards:
                return
            places = np.searchsorted(self._hashes, new)
            at = places.clip(max=max(len(self._hashes) - 1, 0))
            if len(self._hashes) and (twice := np.flatnonzero(self._hashes[at] == new)).size:
                raise TrilightError(
                    f"{shard}: sample {keys[int(twice[0])]} is in another shard too; expected keys "
                    "that are unique over all shards. Leave one of the two out."
                )
            order = np.argsort(new)
            self._hashes = np.insert(self._hashes, places[order], new[order])
            self._shards.add(shard)


def _open_or_close(name: str, stream: BinaryIO, held: HeldMaps) -> OpenShard:
    try:
        return OpenShard(name, stream, held)
    except BaseException:
        stream.close()
        raise


class ListedShards(ShardSet):
    """Shards of a list: nothing is known of one before it was opened, and nothing is checked."""

    def __init__(self, places: Sequence[ShardPlace], seen: KeysSeen) -> None:
        self.names = [place.display_name for place in places]
        self._places = places
        self._seen = seen
        self._counts: dict[int, int] = {}
        self._held = HeldMaps()

    def num_samples(self, number: int) -> int:
        if number not in self._counts:
            self.open(number).close()
        return self._counts[number]

    def open(self, number: int) -> OpenShard:
        place = self._places[number]
        shard = _open_or_close(place.display_name, place.open(), self._held)
        try:
            self._seen.add(place.display_name, shard.keys)
        except TrilightError:
            shard.close()
            raise
        self._counts[number] = len(shard.keys)
        return shard
