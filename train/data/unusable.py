"""Damaged data: stop at the first damaged sample, or count and replace up to a limit.

The count belongs to the run: a checkpoint stores it, so that resuming often allows no more damage
than one uninterrupted run. Damaged samples are stored by a digest of their name, since names of
listed shards may be paths of a user's machine.
"""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing

from storage.dataset.shard_set import ShardSet
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.sample import Sample


class Unusable:
    """The damaged samples and shards that a run has met."""

    def __init__(
        self, most: int, met: Mapping[str, int] | None = None, *, way_on: str = ""
    ) -> None:
        """Remember the limit.

        Args:
            most: samples that may be unusable; at 0 the first one ends the run.
            met: the property `met` of the run that is resumed.
            way_on: a sentence for whoever meets the limit.
        """
        self.most = most
        self._way_on = way_on
        self._met: dict[str, int] = dict(met or {})
        self._messages: dict[str, str] = {}
        self._lock = threading.Lock()

    @property
    def messages(self) -> Sequence[str]:
        """What was wrong, one message for each damaged sample or shard that this process met."""
        return tuple(self._messages.values())

    @property
    def met(self) -> Mapping[str, int]:
        """Number of lost samples, by a digest of the name of the damaged sample or shard."""
        with self._lock:
            return dict(sorted(self._met.items()))

    def add(self, name: str, num_samples: int, error: TrilightError) -> None:
        """Count a damaged sample or shard; one that is met again counts once.

        Args:
            name: of the sample or shard.
            num_samples: how many samples are lost with it.
            error: what is wrong with it; names it.

        Raises:
            TrilightError: what `error` says where none is allowed, or that the limit is passed.
        """
        if not self.most:
            raise TrilightError(" ".join(filter(None, [str(error), self._way_on]))) from error
        with self._lock:
            self._met.setdefault(sha256_hex(name.encode())[:16], num_samples)
            self._messages.setdefault(name, str(error))
            count = sum(self._met.values())
        if count > self.most:
            raise TrilightError(
                f"data: {count} samples are unusable; expected at most {self.most}. The last: "
                + " ".join(filter(None, [str(error), self._way_on]))
            ) from error


def first_samples(shards: ShardSet, limit: int, unusable: Unusable) -> Iterator[Sample]:
    """Yield the first usable samples of a split, at most `limit`, in the order of the shards.

    Of several datasets each gives the same number, or all that it has.

    Raises:
        TrilightError: more samples are damaged than `unusable` allows.
    """
    count = len(shards.parts)
    for row, part in enumerate(shards.parts):
        yield from _first_of(shards, part, limit // count + (row < limit % count), unusable)


def _first_of(shards: ShardSet, part: range, limit: int, unusable: Unusable) -> Iterator[Sample]:
    left = limit
    for number in part:
        if not left:
            return
        try:
            shard = shards.open(number)
        except TrilightError as error:
            unusable.add(shards.names[number], lost_with(shards, number), error)
            continue
        with closing(shard):
            for row, key in enumerate(shard.keys[:left]):
                try:
                    sample = shard.sample(row)
                except TrilightError as error:
                    unusable.add(f"{shard.name}: sample {key}", 1, error)
                    continue
                yield sample
                left -= 1


def lost_with(shards: ShardSet, number: int) -> int:
    """Return how many samples a damaged shard holds; 1 where its index is damaged too."""
    try:
        return shards.num_samples(number)
    except TrilightError:
        return 1
