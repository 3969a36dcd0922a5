"""Several datasets in one stream: which of them the scene at each position comes from.

Each dataset keeps the order that it would have alone (train.data.order), begins it again when it
is through, and moves on only when its turn comes. Turns are taken as evenly as weights allow: the
k-th scene of a dataset is due at time (k + 1/2) / weight, and the earliest is next, so that every
stretch of the stream holds each dataset's share to within a scene or two. How many scenes of each
came before a position follows from the weights alone: a run resumes by the number of its step.
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
from train.data.order import Place

if TYPE_CHECKING:
    from train.settings import TrainSettings

RECORD = "mixture"
"""Entry of a checkpoint's header, and of settings.json."""


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Shares of datasets in a stream from some position on."""

    digests: tuple[str, ...]
    """Of the datasets, in their order."""
    names: tuple[str, ...]
    """What they are called."""
    weights: Annotated[tuple[float, ...], Within(0, FLOAT32_MAX, low_open=True)]
    """Scenes of each, in proportion."""
    first: Annotated[int, Within(0, 2**63 - 1, unit="scenes")] = 0
    """Position of the stream from which this holds: 0, or where the run's data, weights or batch
    were changed."""
    before: Annotated[tuple[int, ...], Within(0, 2**63 - 1, unit="scenes")]
    """Scenes of each that the run had been shown until then."""
    scenes_per_step: Annotated[int, Within(1, 10**9, unit="scenes")]
    """Scenes of a global batch."""

    def __post_init__(self) -> None:
        if len({len(self.digests), len(self.names), len(self.weights), len(self.before)}) > 1:
            raise TrilightError("mixture: expected as many names, weights and counts as digests.")

    def taken(self, position: int) -> tuple[int, ...]:
        """Return how many scenes of each the stream has shown before a position, `first` or later.

        In a time that does not depend on the position.
        """
        counts, left = self._settled(position - self.first)
        for source, _ in zip(self._turns(counts), range(left), strict=False):
            counts[source] += 1
        return tuple(now + then for now, then in zip(counts, self.before, strict=True))

    def sources_from(self, position: int) -> Iterator[int]:
        """Yield the number of the dataset at each position from one on, without end."""
        counts = [now - then for now, then in zip(self.taken(position), self.before, strict=True)]
        return self._turns(counts)

    def _settled(self, number: int) -> tuple[list[int], int]:
        """Return counts of each that are surely among the first so many, and how many are left."""
        exact = self._exact
        time = max(number - len(exact), 0) / sum(exact)
        counts = [int(time * weight + Fraction(1, 2)) for weight in exact]
        return counts, number - sum(counts)

    def _turns(self, counts: Sequence[int]) -> Iterator[int]:
        """Yield who is next, without end, after so many of each."""
        waits = [1 / weight for weight in self._exact]
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
    def _exact(self) -> list[Fraction]:
        """The weights as they were written, in fractions: rounding would pile up."""
        return [Fraction(repr(weight)) for weight in self.weights]

    def __str__(self) -> str:
        """Say the shares, for a note."""
        total = sum(self.weights)
        shares = zip(self.names, self.digests, self.weights, strict=True)
        return ", ".join(
            f"{weight / total:.1%} {name} ({digest.rpartition(':')[2][:8]})"
            for name, digest, weight in shares
        )

    def record(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return dataclasses.asdict(self)


def mixed_places(
    mixture: Mixture, places: Sequence[Iterator[Place]], parts: Sequence[range], first: int
) -> Iterator[Place]:
    """Yield the places of the stream without end, from position `first` on.

    Args:
        mixture: whose turn it is.
        places: of each dataset without end, from what `mixture.taken` says on.
        parts: numbers of each dataset's shards among all.
        first: position of the stream.
    """
    for position, source in enumerate(mixture.sources_from(first), first):
        place = next(places[source])
        shard = parts[source].start + place.shard
        yield dataclasses.replace(place, position=position, shard=shard, source=source)


def mixture_of(
    data: TrainingData, settings: "TrainSettings", header: Mapping[str, Any] | None
) -> Mixture | None:
    """Return how a run's datasets are mixed from here on; None of a run that has only had one.

    Args:
        data: of the run.
        settings: of the next step.
        header: of the checkpoint that it goes on from; None where it begins. A dataset that the run
            knows goes on where it was.

    Raises:
        TrilightError: not as many weights as datasets.
    """
    sources, old = data.sources, None if header is None else _recorded(header)
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
    shown = dict[str, int]() if old is None or header is None else _shown(old, header["step"])
    new = Mixture(
        digests=tuple(source.digest for source in sources),
        names=tuple(source.name for source in sources),
        weights=tuple(float(w) for w in settings.data_weights) or _sizes(data),
        first=position,
        before=tuple(shown.get(source.digest, 0) for source in sources),
        scenes_per_step=settings.scenes_per_step,
    )
    kept = ("digests", "weights", "scenes_per_step")
    unchanged = old is not None and all(getattr(old, name) == getattr(new, name) for name in kept)
    return old if unchanged else new


def _shown(old: Mixture, step: int) -> dict[str, int]:
    """Return by digest how many scenes a run has been shown."""
    taken = old.taken(step * old.scenes_per_step)
    return dict(zip(old.digests, taken, strict=True))


def _recorded(header: Mapping[str, Any]) -> Mixture:
    """Return the mixture of a checkpoint; of one dataset alone where it says none."""
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


def _sizes(data: TrainingData) -> tuple[float, ...]:
    """Return how many scenes of each dataset are for training."""
    shards = data.split("train")
    return tuple(float(sum(map(shards.num_samples, part))) for part in shards.parts)
