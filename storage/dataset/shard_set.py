"""The shards of one split, from which samples are drawn in any order.

A set knows its shards by number and opens each when it is wanted. An open shard gives any of its
samples, in any order and from several threads at once; nothing of it stays in memory but the names
of its members, and of a whole set as many unpacked maps as storage.records.packed_maps allows.
"""

import contextlib
import itertools
import math
import os
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.shard import ShardReader
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.packed_maps import HeldMaps
from storage.records.safe_read import open_plain
from storage.records.sample import Sample, StoredSample, decode_sample, stored_sample
from storage.remote.safe_url import printable, safe_text
from storage.remote.shard_cache import shard_cache
from storage.remote.url import RemoteUrl, parse_local_path, parse_url

MAX_SHARDS = 100_000
"""Maximum number of shards in a list, and of names that one brace pattern expands to."""

_GROUP = re.compile(r"\{([^{}]*)\}")
_RANGE = re.compile(r"(\d+)\.\.(\d+)")
_WHAT = "shard"


@dataclass(frozen=True, kw_only=True)
class ShardPlace:
    """The place of one shard."""

    place: Path | RemoteUrl
    """A file of this machine, or one on a server."""

    @property
    def display_name(self) -> str:
        """The path or URL without secrets, for messages."""
        if isinstance(self.place, RemoteUrl):
            return self.place.display_url
        return printable(str(self.place))

    @property
    def split(self) -> str:
        """What its name begins with, if that is a split, and else train."""
        name = self.display_name.rpartition("/")[2]
        return next((split for split in SPLITS if name.startswith(f"{split}-")), "train")

    def open(self) -> BinaryIO:
        """Open the shard; raises TrilightError where it cannot be read."""
        if isinstance(self.place, RemoteUrl):
            return shard_cache().open(self.place, num_bytes=None, sha256=None)
        try:
            return open_plain(self.place)
        except OSError as error:
            raise TrilightError(
                f"shard {self.display_name!r}: cannot be read ({error.strerror}); expected a file. "
                "Check the list: a dataset numbers its shards over all splits."
            ) from error


def listed_shards(patterns: Sequence[str]) -> list[ShardPlace]:
    """Return the shards that patterns name, in their order.

    Args:
        patterns: paths or URLs; `{000000..000007}` stands for each number of a range, as wide as
            its first end, and `{a,b}` for each of several texts.

    Raises:
        TrilightError: a URL is refused (storage.remote.url), a pattern is not closed or names more
            than MAX_SHARDS, a range runs backwards, or a shard is named twice.
    """
    texts = list(itertools.chain.from_iterable(expand_pattern(pattern) for pattern in patterns))
    places = [ShardPlace(place=parse_url(text, what=_WHAT)) for text in texts]
    if len(places) > MAX_SHARDS:
        raise TrilightError(f"the list names {len(places)} shards; expected at most {MAX_SHARDS}.")
    seen: set[Path | RemoteUrl] = set()
    for place in places:
        if place.place in seen:
            raise TrilightError(f"shard {place.display_name!r} is named twice; expected each once.")
        seen.add(place.place)
    return places


def expand_pattern(pattern: str, what: str = "shards") -> list[str]:
    """Return what a brace pattern of `what` stands for; raises as `listed_shards`.

    A file or folder of that very name is no pattern.
    """
    if "://" not in pattern and os.path.exists(parse_local_path(pattern)):
        return [pattern]
    named = f"{what} {printable(safe_text(pattern))!r}"
    groups = [_alternatives(group[1], named) for group in _GROUP.finditer(pattern)]
    fixed = _GROUP.split(pattern)[::2]
    if any("{" in text or "}" in text for text in fixed):
        raise TrilightError(
            f"{named}: a brace is not closed, or stands within another; expected such as "
            "train-{000000..000007}.tar."
        )
    count = math.prod(map(len, groups))
    if count > MAX_SHARDS:
        raise TrilightError(
            f"{named}: stands for more than {MAX_SHARDS} names; expected at most that many."
        )
    return [
        "".join(text for pair in zip(fixed, [*chosen, ""], strict=True) for text in pair)
        for chosen in itertools.product(*groups)
    ]


def _alternatives(group: str, named: str) -> Sequence[str]:
    match = _RANGE.fullmatch(group)
    if match is None:
        return group.split(",")
    first = int(match[1])
    last = int(match[2])
    if not first <= last <= first + MAX_SHARDS:
        raise TrilightError(
            f"{named}: the range {group} is backwards or longer than {MAX_SHARDS}; expected such "
            "as 000000..000007."
        )
    width = len(match[1])
    return [f"{number:0{width}d}" for number in range(first, last + 1)]


class OpenShard(ShardReader):
    """A shard that is being read, whose samples have numbers."""

    def __init__(self, name: str, stream: BinaryIO, held: HeldMaps) -> None:
        """Look at the headers; raises TrilightError as `storage.dataset.shard`.

        Args:
            name: for messages.
            stream: the file.
            held: maps of this shard and others that were unpacked already.
        """
        super().__init__(stream, name)
        self._held = held
        self.keys = list(self.samples)
        """The keys of its samples, in the order of the file."""

    def sample(self, row: int) -> Sample:
        """Return a sample that passes `Sample.check`.

        Raises:
            TrilightError: it is not whole, not readable or breaks a law; names shard and sample.
        """
        with self._name_errors():
            sample = decode_sample(self.keys[row], self.members(self.keys[row]), self._held)
            sample.check()
            return sample

    def stored_sample(self, row: int) -> StoredSample:
        """Return a sample whose pictures are unpacked when they are asked for.

        Raises:
            TrilightError: its scene is not readable or breaks a law; names shard and sample.
        """
        with self._name_errors():
            return stored_sample(self.keys[row], self.members(self.keys[row]), self._held)

    @contextlib.contextmanager
    def _name_errors(self) -> Iterator[None]:
        try:
            yield
        except TrilightError as error:
            raise TrilightError(f"{self.name}: {error}") from error


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
        self._dataset = dataset
        self._entries = entries
        self._held = HeldMaps()

    def num_samples(self, number: int) -> int:
        return self._entries[number].num_samples

    def open(self, number: int) -> OpenShard:
        entry = self._entries[number]
        stream = self._dataset.open_stream(entry, checked=True)
        shard = OpenShard(entry.name, stream, self._held)
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
        shard = OpenShard(place.display_name, place.open(), self._held)
        try:
            self._seen.add(place.display_name, shard.keys)
        except TrilightError:
            shard.close()
            raise
        self._counts[number] = len(shard.keys)
        return shard
