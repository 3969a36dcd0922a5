"""Order of a run's scenes: a pure function of seed, epoch, and sizes of the shards.

Shards are shuffled; then the samples of each window of a few consecutive shards are shuffled.
Epochs follow one another without a gap, and global batch i is the samples at positions i B to
(i + 1) B - 1 of that endless order, for any number of ranks and workers. A resume needs only the
number of the batch. A batch is split over the ranks by shard, so that each rank reads few shards of
a window.

In a mixture of several datasets, each keeps the order that it would have alone, repeats it after
its last scene, and advances only when it is chosen. Datasets alternate as evenly as the weights
allow: the k-th scene of a dataset is due at time (k + 1/2) / weight, and the earliest is next, so
that every section of the stream holds each dataset's fraction to within a scene or two. The number
of scenes of each before a position follows from the weights alone.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any

from storage.dataset.training_data import TrainingData
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings.ranges import FLOAT32_MAX, Within

if TYPE_CHECKING:
    from train.settings import TrainSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Visit:
    """One sample at one position of the order."""

    position: int
    """Position in the endless order; it seeds the augmentation of the visit."""
    shard: int
    """Number of the shard in its set, from 0."""
    row: int
    """Row of the sample in the shard."""
    arrival: int
    """Position of the shard in the order of its epoch."""
    source: int = 0
    """Number of the dataset if several are mixed, from 0."""


@dataclass(frozen=True, kw_only=True)
class RankSlice:
    """Slice of every global batch that one process takes."""

    rank: int = 0
    """Number of the process, from 0."""
    world_size: int = 1
    """Number of processes that train together."""

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.world_size:
            raise TrilightError(
                f"rank {self.rank} of {self.world_size}; expected a rank from 0 to "
                f"{self.world_size - 1}."
            )

    def require_equal(self, batch_size: int) -> None:
        """Raise TrilightError if a batch cannot be split equally over the ranks."""
        if batch_size % self.world_size:
            raise TrilightError(
                f"a batch of {batch_size} scenes is not divisible by {self.world_size} ranks; "
                "expected a multiple, so that each takes the same number."
            )

    def of_batch(self, visits: Sequence[Visit]) -> list[Visit]:
        """Return this process's slice of a global batch, in the order of positions."""
        size = len(visits) // self.world_size
        by_shard = sorted(visits, key=lambda visit: (visit.source, visit.arrival, visit.position))
        mine = by_shard[self.rank * size : (self.rank + 1) * size]
        return sorted(mine, key=lambda visit: visit.position)


def shuffled_shards(num_shards: int, seed: int, epoch: int) -> list[int]:
    """Return the shard numbers in the order of an epoch."""
    return [int(shard) for shard in rng_for(seed, "shards", epoch).permutation(num_shards)]


def visits_from(
    num_shards: int, num_samples: Callable[[int], int], first: int, *, seed: int, window: int
) -> Iterator[Visit]:
    """Yield endless visits, from position `first` on.

    Args:
        num_samples: returns the size of a shard; called only for shards that are reached.
        seed: of the run's order.
        window: number of shards whose samples are shuffled together, at least 1.

    Raises:
        TrilightError: all shards are empty.
    """
    total = sum(num_samples(shard) for shard in range(num_shards)) if first else 0
    epoch, start = (first // total, first // total * total) if total else (0, 0)
    while True:
        epoch_start = start
        order = shuffled_shards(num_shards, seed, epoch)
        for number, at in enumerate(range(0, num_shards, window)):
            shards = order[at : at + window]
            sizes = [num_samples(shard) for shard in shards]
            if any(sizes) and start + sum(sizes) > first:
                drawn = rng_for(seed, "samples", epoch, number).permutation(sum(sizes))
                arrivals = [(a, row) for a, size in enumerate(sizes) for row in range(size)]
                for position, (a, row) in enumerate((arrivals[i] for i in drawn), start):
                    if position >= first:
                        yield Visit(position=position, shard=shards[a], row=row, arrival=at + a)
            start += sum(sizes)
        if start == epoch_start:
            raise TrilightError(f"all {num_shards} shards are empty; expected a sample.")
        epoch += 1


RECORD = "mixture"
"""Name of the entry in a checkpoint's header and in settings.json."""


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Weights of datasets in a stream from some position on."""

    digests: tuple[str, ...]
    """Digest of each dataset, in their order."""
    names: tuple[str, ...]
    """Display name of each dataset."""
    weights: Annotated[tuple[float, ...], Within(0, FLOAT32_MAX, low_open=True)]
    """Relative number of scenes of each dataset."""
    first: Annotated[int, Within(0, 2**63 - 1, unit="scenes")] = 0
    """First position of the stream with this mixture: 0, or where the run's data, weights or batch
    size changed."""
    before: Annotated[tuple[int, ...], Within(0, 2**63 - 1, unit="scenes")]
    """Number of scenes of each dataset before that position."""
    scenes_per_step: Annotated[int, Within(1, 10**9, unit="scenes")]
    """Number of scenes of a global batch."""

    def __post_init__(self) -> None:
        if len({len(self.digests), len(self.names), len(self.weights), len(self.before)}) > 1:
            raise TrilightError("mixture: expected as many names, weights and counts as digests.")

    def order_from(self, position: int) -> tuple[tuple[int, ...], Iterator[int]]:
        """Return the order from a position on, which is `first` or later.

        The time does not depend on the position.

        Returns:
            The number of scenes of each dataset before the position, and the number of the dataset
            at each position from there on, without end.
        """
        # exact decimal numbers, so that rounding does not accumulate
        exact = [Fraction(repr(weight)) for weight in self.weights]
        number = position - self.first
        time = max(number - len(exact), 0) / sum(exact)  # lower bounds of the counts, then the rest
        counts = [int(time * weight + Fraction(1, 2)) for weight in exact]
        order = _alternate([*counts], [1 / weight for weight in exact])
        for source in itertools.islice(order, number - sum(counts)):
            counts[source] += 1
        return tuple(map(sum, zip(counts, self.before, strict=True))), order

    def __str__(self) -> str:
        """Return percentages and names, for a note."""
        total = sum(self.weights)
        shares = zip(self.names, self.digests, self.weights, strict=True)
        return ", ".join(
            f"{weight / total:.1%} {name} ({digest.rpartition(':')[2][:8]})"
            for name, digest, weight in shares
        )


def _alternate(counts: Sequence[int], waits: Sequence[Fraction]) -> Iterator[int]:
    """Yield the number of the next dataset, without end, after `counts` scenes of each."""
    due = [(count + Fraction(1, 2)) * wait for count, wait in zip(counts, waits, strict=True)]
    while True:
        source = due.index(min(due))
        yield source
        due[source] += waits[source]


def plan_mixture(
    data: TrainingData, settings: "TrainSettings", header: Mapping[str, Any] | None
) -> Mixture | None:
    """Return the mixture of a run from here on; None if it has only had one dataset.

    Args:
        header: header of the checkpoint that is resumed; None for a new run. A dataset that the run
            has used before continues at its position.

    Raises:
        TrilightError: the number of weights is not that of the datasets.
    """
    sources = data.sources
    old = None if header is None else _mixture_of_header(header)
    if settings.data_weights and len(settings.data_weights) != len(sources):
        raise TrilightError(
            f"data_weights holds {len(settings.data_weights)} numbers, but --data names "
            f"{len(sources)} {'dataset' if len(sources) == 1 else 'datasets'}; expected one for "
            "each, in their order, or none for shares in proportion to their numbers of scenes."
        )
    if len(sources) == 1 and (old is None or old.digests == (sources[0].digest,)):
        if header is None or RECORD not in header:
            return None
    step = 0 if header is None else header["step"]
    seen_counts = dict[str, int]()
    if old is not None:
        counts, _ = old.order_from(step * old.scenes_per_step)
        seen_counts = dict(zip(old.digests, counts, strict=True))
    shards = data.split("train")
    weights = tuple(map(float, settings.data_weights)) or tuple(
        float(sum(map(shards.num_samples, part))) for part in shards.parts
    )
    new = Mixture(
        digests=tuple(source.digest for source in sources),
        names=tuple(source.name for source in sources),
        weights=weights,
        first=step * settings.scenes_per_step,
        before=tuple(seen_counts.get(source.digest, 0) for source in sources),
        scenes_per_step=settings.scenes_per_step,
    )
    identity_fields = ("digests", "weights", "scenes_per_step")
    unchanged = old is not None and all(
        getattr(old, name) == getattr(new, name) for name in identity_fields
    )
    return old if unchanged else new


def _mixture_of_header(header: Mapping[str, Any]) -> Mixture:
    """Return the mixture of a checkpoint, or that of its single dataset."""
    if RECORD in header:
        from storage.settings.described import from_record  # it loads pydantic

        return from_record(Mixture, header[RECORD])
    return single_dataset(header["data_digest"], header["settings"]["scenes_per_step"])


def single_dataset(digest: str, scenes_per_step: int) -> Mixture:
    """Return the mixture of one dataset alone."""
    return Mixture(
        digests=(digest,),
        names=("",),
        weights=(1.0,),
        before=(0,),
        scenes_per_step=scenes_per_step,
    )
