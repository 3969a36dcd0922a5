"""Places of single shards: paths and URLs, one by one or as brace patterns."""

import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from storage.conventions import SPLITS
from storage.errors import TrilightError
from storage.records.safe_read import open_plain
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
    count = 1
    for group in groups:
        count *= len(group)
        if count > MAX_SHARDS:
            raise TrilightError(
                f"{named}: stands for more than {MAX_SHARDS} names; expected at most that many."
            )
    return [_join_groups(fixed, chosen) for chosen in itertools.product(*groups)]


def _join_groups(fixed: Sequence[str], chosen: Sequence[str]) -> str:
    return "".join(text for pair in zip(fixed, [*chosen, ""], strict=True) for text in pair)


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
