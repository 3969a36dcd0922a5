"""Mixture of several datasets in one stream: the dataset of the scene at each position.

Each dataset keeps the order that it would have alone (train.data.order), repeats it after its last
scene, and advances only when it is chosen. Datasets alternate as evenly as the weights allow: the
k-th scene of a dataset is due at time (k + 1/2) / weight, and the earliest is next, so that every
section of the stream holds each dataset's fraction to within a scene or two. The number of scenes
of each before a position follows from the weights alone: a run resumes by the number of its step.
"""

import dataclasses
import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any

from storage.dataset.training_data import TrainingData
from storage.errors import TrilightError
from storage.settings.ranges import FLOAT32_MAX, Within
from train.data.order import Visit

if TYPE_CHECKING:
    from train.settings import TrainSettings

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

    def counts_before(self, position: int) -> tuple[int, ...]:
        """Return the number of scenes of each dataset before a position, `first` or later.

        The time does not depend on the position.
        """
        counts, remaining = self._lower_counts(position - self.first)
        for source, _ in zip(self._source_order(counts), range(remaining), strict=False):
            counts[source] += 1
        return tuple(now + then for now, then in zip(counts, self.before, strict=True))

    def sources_from(self, position: int) -> Iterator[int]:
        """Yield the number of the dataset at each position, from one on without end."""
        counts = [
            now - then for now, then in zip(self.counts_before(position), self.before, strict=True)
        ]
        return self._source_order(counts)

    def _lower_counts(self, number: int) -> tuple[list[int], int]:
        """Return lower bounds of the counts among the first `number`, and the remainder."""
        exact = self._exact_weights
        time = max(number - len(exact), 0) / sum(exact)
        counts = [int(time * weight + Fraction(1, 2)) for weight in exact]
        return counts, number - sum(counts)

    def _source_order(self, counts: Sequence[int]) -> Iterator[int]:
        """Yield the number of the next dataset, without end, after `counts` scenes of each."""
        waits = [1 / weight for weight in self._exact_weights]
        due = [
            ((count + Fraction(1, 2)) * wait, source)
            for source, (count, wait) in enumerate(zip(counts, waits, strict=True))
        ]
        heapq.heapify(due)
        while True:
            time, source = due[0]
            yield source
            heapq.heapreplace(due, (time + waits[source], source))

    @property
    def _exact_weights(self) -> list[Fraction]:
        """Exact decimal weights as fractions, so that rounding does not accumulate."""
        return [Fraction(repr(weight)) for weight in self.weights]

    def __str__(self) -> str:
        """Return percentages and names, for a note."""
        total = sum(self.weights)
        shares = zip(self.names, self.digests, self.weights, strict=True)
        return ", ".join(
            f"{weight / total:.1%} {name} ({digest.rpartition(':')[2][:8]})"
            for name, digest, weight in shares
        )

    def record(self) -> dict[str, Any]:
        """Return the mixture as JSON values."""
        return dataclasses.asdict(self)


def mix_visits(
    mixture: Mixture, visits: Sequence[Iterator[Visit]], parts: Sequence[range], first: int
) -> Iterator[Visit]:
    """Yield the visits of the stream without end, from position `first` on.

    Args:
        visits: endless visits of each dataset, after the scenes of `mixture.counts_before`.
        parts: shard numbers of each dataset among all.
    """
    for position, source in enumerate(mixture.sources_from(first), first):
        visit = next(visits[source])
        shard = parts[source].start + visit.shard
        yield dataclasses.replace(visit, position=position, shard=shard, source=source)


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
    position = 0 if header is None else header["step"] * settings.scenes_per_step
    seen_counts = dict[str, int]()
    if old is not None and header is not None:
        counts = old.counts_before(header["step"] * old.scenes_per_step)
        seen_counts = dict(zip(old.digests, counts, strict=True))
    shards = data.split("train")
    weights = tuple(map(float, settings.data_weights)) or tuple(
        float(sum(map(shards.num_samples, part))) for part in shards.parts
    )
    new = Mixture(
        digests=tuple(source.digest for source in sources),
        names=tuple(source.name for source in sources),
        weights=weights,
        first=position,
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
        record: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in header[RECORD].items()
        }
        return Mixture(**record)
    return Mixture(
        digests=(header["data_digest"],),
        names=("",),
        weights=(1.0,),
        before=(0,),
        scenes_per_step=header["settings"]["scenes_per_step"],
    )
