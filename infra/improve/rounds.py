"""The closed loop on one page: draw, make, train, judge, and draw again what taught most.

    step    what comes out                                       who does it
    ------  ---------------------------------------------------  --------------------------------
    draw    weights of the strata, from what the last round      infra.improve.weights
            taught
    make    a dataset whose settings state them                  trilight generate, or its flow
    train   the run, longer by a round, on all datasets so far   trilight train, or its flow
    judge   the loss of held-out scenes by stratum, before and   infra.improve.judging
            after

Files are the truth (infra.improve.state): what is there is not made again, and a dataset or a run
that was begun goes on as the commands themselves do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from infra.improve.datasets import dataset_order, making_core_s, scene_costs, weighed_strata
from infra.improve.order import ImproveOrder
from infra.improve.report import write_report
from infra.improve.state import Drawn, Lessons, Rounds
from infra.improve.weights import next_weights
from infra.train_order import TrainOrder
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.mixed_data import open_mixture
from storage.dataset.training_data import TrainingData

if TYPE_CHECKING:
    from infra.improve.judging import Judged

STEPS = ("make", "train", "judge")
"""What a round does, in order."""


@dataclass(frozen=True, kw_only=True)
class LoopWorkers:
    """Who makes and trains, and who is told."""

    make: Callable[[DatasetOrder], object]
    """Makes a dataset, or what is missing of it."""
    train: Callable[[TrainOrder], float]
    """Trains, or goes on; returns the core-seconds that it took."""
    told: Callable[[int, Drawn, Lessons], None] = lambda number, drawn, lessons: None
    """Is told of each round that is done, also of those that were before."""
    begins: Callable[[int, str], None] = lambda number, what: None
    """Is told of the round and which of STEPS begins."""


def improve(order: ImproveOrder, workers: LoopWorkers) -> list[Lessons]:
    """Run a closed loop, or what is missing of it; return what each round taught.

    Raises:
        TrilightError: another loop was begun in the folder; what making, training or judging
            refuses. What is finished is safe.
    """
    rounds = Rounds(order)
    rounds.begin()
    found: list[Lessons] = []
    for number in range(1, order.rounds + 1):
        drawn = _drawn(rounds, number, found)
        lessons = rounds.lessons(number)
        if lessons is None:
            lessons = _taught(rounds, number, drawn, found, workers)
            rounds.learn(number, lessons)
        found.append(lessons)
        write_report(rounds, found)
        workers.told(number, drawn, lessons)
    return found


def _drawn(rounds: Rounds, number: int, found: list[Lessons]) -> Drawn:
    """Return what a round draws, decided now if it was not."""
    order, there = rounds.order, rounds.drawn(number)
    if there is not None:
        return there
    base = {stratum.name: stratum.weight for stratum in order.strata()}
    if not found:
        weights, scenes = next_weights(base, {}, order.floor), order.scenes
    else:
        taught = found[-1].strata
        weights = next_weights(base, taught, order.floor)
        cost = {name: lesson.core_s for name, lesson in taught.items()}
        even, price = (
            sum(shares[name] * cost[name] for name in cost) / sum(shares[name] for name in cost)
            for shares in (base, weights)
        )
        scenes = max(2, round(order.scenes * even / price))
    drawn = Drawn(scenes=scenes, seed=order.settings().seed + number - 1, weights=weights)
    rounds.decide(number, drawn)
    return drawn


def _taught(
    rounds: Rounds, number: int, drawn: Drawn, found: list[Lessons], workers: LoopWorkers
) -> Lessons:
    """Make, train and judge one round."""
    order, history = rounds.order, rounds.history(number)
    workers.begins(number, "make")
    place = rounds.dataset(number)
    workers.make(dataset_order(order, drawn, history, place))
    workers.begins(number, "train")
    data = tuple(str(rounds.dataset(earlier)) for earlier in range(1, number + 1))
    opened = open_mixture(data)
    training = order.training(number, data, _decided(opened))
    training_core_s = workers.train(training)
    workers.begins(number, "judge")
    judged = _judged(order, data[0])
    before = (
        {name: lesson.loss for name, lesson in found[-1].strata.items()}
        if found
        else judged.untrained()
    )
    made = enumerate([*history, drawn], 1)
    costs = scene_costs({rounds.dataset(k): weighed_strata(order, one, ()) for k, one in made})
    now = judged.trained(str(order.root / "run"))
    own = open_mixture([str(place)])
    return Lessons(
        digest=own.digest,
        scenes=_num_scenes(own),
        making_core_s=round(making_core_s(place), 3),
        training_core_s=round(training_core_s, 3),
        strata=judged.lessons(before, now, costs),
        losses=now,
    )


def _judged(order: ImproveOrder, dataset: str) -> "Judged":
    from infra.improve.judging import Judged  # loads torch

    return Judged(dataset, order.training(1, (dataset,), None).settings())


def _decided(data: TrainingData) -> str:
    """Return how a decision names data (train.going_on.DATA)."""
    return data.digest if ":" in data.digest else f"sha256:{data.digest}"


def _num_scenes(data: TrainingData) -> int:
    shards = data.split("train")
    return sum(map(shards.num_samples, range(len(shards.names))))
