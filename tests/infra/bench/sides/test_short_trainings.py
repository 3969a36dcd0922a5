"""Short trainings end with their core-seconds, learn, and are judged on what they have not seen."""

import dataclasses

from infra.bench.experiments.token_repairs import BASE, POINTS
from model.config import smoke


def test_every_network_of_the_experiment_can_be_made() -> None:
    assert not POINTS[BASE]
    made = [dataclasses.replace(smoke(), **changes) for changes in POINTS.values()]
    assert len(set(made)) == len(POINTS)
