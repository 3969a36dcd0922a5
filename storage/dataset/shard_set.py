"""The shards of one split, from which samples are drawn in any order.

A set knows its shards by number and opens each when it is wanted. An open shard gives any of its
samples, in any order and from several threads at once; nothing of it stays in memory but the names
of its members, and of all shards as many unpacked maps as storage.records.packed_maps allows.
"""

import itertools
import math
import os
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.conventions import SPLITS
from storage.dataset.shard import ShardReader
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.safe_read import open_plain
from storage.remote.shard_cache import shard_cache
from storage.remote.url import RemoteUrl, parse_url, printable, safe_text

MAX_SHARDS = 100_000
"""Maximum number of shards in a list, and of names that one brace pattern expands to."""

_GROUP = re.compile(r"\{([^{}]*)\}")
_RANGE = re.compile(r"(\d+)\.\.(\d+)")
_WHAT = "shard"


@dataclass(frozen=True, kw_only=True, slots=True)
class SetShard:
    """One shard of a set."""

    name: str
    """Name in its dataset, or the path or URL without secrets, for messages."""
    open: Callable[[], BinaryIO]
    """Opens the file, checked where a digest is known; raises TrilightError where it cannot."""
    num_samples: int | None = None
    """Number of its samples, where a manifest says it."""

    @property
    def split(self) -> str:
        """What its name begins with, if that is a split, and else train."""
        name = self.name.rpartition("/")[2]
        return next((split for split in SPLITS if name.startswith(f"{split}-")), "train")


def listed_shards(patterns: Sequence[str]) -> list[SetShard]:
    """Return the shards that patterns name, in their order.

    Args:
        patterns: paths or URLs; `{000000..000007}` stands for each number of a range, as wide as
            its first end, and `{a,b}` for each of several texts.

    Raises:
        TrilightError: a URL is refused (storage.remote.url), a pattern is not closed or names more
            than MAX_SHARDS, a range runs backwards, or a shard is named twice.
    """
    texts = list(itertools.chain.from_iterable(expand_pattern(pattern) for pattern in patterns))
    places = [parse_url(text, what=_WHAT) for text in texts]
    if len(places) > MAX_SHARDS:
        raise TrilightError(f"the list names {len(places)} shards; expected at most {MAX_SHARDS}.")
    shards: dict[Path | RemoteUrl, SetShard] = {}
    for place in places:
        shard = _listed_shard(place)
        if place in shards:
            raise TrilightError(f"shard {shard.name!r} is named twice; expected each once.")
        shards[place] = shard
    return list(shards.values())


def _listed_shard(place: Path | RemoteUrl) -> SetShard:
    if isinstance(place, RemoteUrl):
        return SetShard(
            name=place.display_url,
            open=lambda: shard_cache().open(place, num_bytes=None, sha256=None),
        )
    name = printable(str(place))

    def open_file() -> BinaryIO:
        try:
            return open_plain(place)
        except OSError as error:
            raise TrilightError(
                f"shard {name!r}: cannot be read ({error.strerror}); expected a file. Check the "
                "list: a dataset numbers its shards over all splits."
            ) from error

    return SetShard(name=name, open=open_file)


def expand_pattern(pattern: str, what: str = "shards") -> list[str]:
    """Return what a brace pattern of `what` stands for; raises as `listed_shards`.

    A file or folder of that very name is no pattern.
    """
    if "://" not in pattern and os.path.exists(os.path.expanduser(pattern)):
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


class ShardSet:
    """Shards by number, those of one dataset after those of another."""

    def __init__(self, *datasets: Sequence[SetShard], seen: KeysSeen | None = None) -> None:
        """Take the shards of each dataset.

        Args:
            datasets: their shards.
            seen: keys of shards whose number of samples is not known: no manifest lists those.
        """
        self._shards = list(itertools.chain(*datasets))
        self.names: Sequence[str] = [shard.name for shard in self._shards]
        """Shard names as messages show them."""
        ends = itertools.accumulate(map(len, datasets), initial=0)
        self.parts: Sequence[range] = tuple(itertools.starmap(range, itertools.pairwise(ends)))
        """The numbers of each dataset's shards."""
        self._seen = seen or KeysSeen()
        self._counts: dict[int, int] = {}

    def num_samples(self, number: int) -> int:
        """Return how many samples a shard holds; opens it where nothing else tells."""
        if (stated := self._shards[number].num_samples) is not None:
            return stated
        if number not in self._counts:
            self.open(number).close()
        return self._counts[number]

    def open(self, number: int) -> ShardReader:
        """Open a shard, fetched, and checked as far as a manifest describes it.

        Raises:
            TrilightError: it cannot be read, or is not what it should be; the message names it.
        """
        shard = self._shards[number]
        opened = ShardReader(shard.open(), shard.name)
        count = len(opened.keys)
        try:
            if shard.num_samples is None:
                self._seen.add(shard.name, opened.keys)
            elif count != shard.num_samples:
                raise TrilightError(
                    f"{shard.name}: holds {count} samples; expected {shard.num_samples}, as the "
                    "manifest says. Run `trilight verify`."
                )
        except TrilightError:
            opened.close()
            raise
        self._counts[number] = count
        return opened
