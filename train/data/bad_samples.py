"""Counter of damaged samples: stop at the first one, or replace samples up to a limit.

The count belongs to the run: a checkpoint stores it, so that frequent resumes allow no more damage
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


class BadSampleCounter:
    """Counts the damaged samples and shards of a run, and stops it at a limit."""

    def __init__(
        self, limit: int, counts: Mapping[str, int] | None = None, *, advice: str = ""
    ) -> None:
        """Create the counter.

        Args:
            limit: maximum number of unusable samples; at 0 the first one ends the run.
            counts: property `counts` of the run that is resumed.
            advice: sentence that the error at the limit ends with.
        """
        self.limit = limit
        self._advice = advice
        self._counts: dict[str, int] = dict(counts or {})
        self._messages: dict[str, str] = {}
        self._lock = threading.Lock()

    @property
    def messages(self) -> Sequence[str]:
        """Error messages, one for each damaged sample or shard that this process read."""
        return tuple(self._messages.values())

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of lost samples, by a digest of the name of the damaged sample or shard."""
        with self._lock:
            return dict(sorted(self._counts.items()))

    def add(self, name: str, num_samples: int, error: TrilightError) -> None:
        """Count a damaged sample or shard; repeated calls count once.

        Args:
            num_samples: number of samples that are lost with it.
            error: error of reading it, which includes the name.

        Raises:
            TrilightError: the text of `error` if the limit is 0, or that the limit is exceeded.
        """
        text = " ".join(filter(None, [str(error), self._advice]))
        if not self.limit:
            raise TrilightError(text) from error
        with self._lock:
            self._counts.setdefault(sha256_hex(name.encode())[:16], num_samples)
            self._messages.setdefault(name, str(error))
            count = sum(self._counts.values())
        if count > self.limit:
            raise TrilightError(
                f"data: {count} samples are unusable; expected at most {self.limit}. The last: "
                f"{text}"
            ) from error

    def add_shard(self, shards: ShardSet, number: int, error: TrilightError) -> None:
        """Count all samples of a damaged shard as `add`; 1 if its index is damaged too."""
        try:
            num_samples = shards.num_samples(number)
        except TrilightError:
            num_samples = 1
        self.add(shards.names[number], num_samples, error)


def first_samples(
    shards: ShardSet, limit: int, unusable: BadSampleCounter | None = None
) -> Iterator[Sample]:
    """Yield the first usable samples of a split, at most `limit`, in the order of the shards.

    Several datasets contribute equal numbers, or all that they have.

    Raises:
        TrilightError: more samples are damaged than `unusable` allows; by default, one is.
    """
    unusable = unusable or BadSampleCounter(0)
    count = len(shards.parts)
    for source, part in enumerate(shards.parts):
        remaining = limit // count + (source < limit % count)
        for number in part:
            if not remaining:
                break
            try:
                shard = shards.open(number)
            except TrilightError as error:
                unusable.add_shard(shards, number, error)
                continue
            with closing(shard):
                for row, key in enumerate(shard.keys[:remaining]):
                    try:
                        sample = shard.sample(row)
                    except TrilightError as error:
                        unusable.add(f"{shard.name}: sample {key}", 1, error)
                        continue
                    yield sample
                    remaining -= 1
