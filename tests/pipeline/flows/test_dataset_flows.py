"""A dataset in several flow runs: ranges of shards that add up to the whole."""

from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.flows import dataset_flows as building
from pipeline.flows.orders import DatasetInRuns, dataset_in_runs
from pipeline.making.tasks import shard_ranges
from storage.errors import TrilightError
from tests.for_each import for_each


def _parameters(**given: Any) -> dict[str, Any]:
    example = DatasetInRuns()
    plain = {name: getattr(example, name) for name in DatasetInRuns.__dataclass_fields__}
    return {**plain, "changes": None, **given}


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str | None]:
    """Which ranges are made, those of other runs first; nothing is."""
    ranges: list[str | None] = []

    def started(deployment: str, *, parameters: dict[str, Any], **options: Any) -> None:
        ranges.append(f"{deployment} {parameters['shards']}")

    status = SimpleNamespace(shards_planned=10)
    monkeypatch.setattr(building, "prepare_assets", lambda **given: None)
    monkeypatch.setattr(building, "read_status", lambda out: status)
    monkeypatch.setattr(building, "run_deployment", started)
    monkeypatch.setattr(building, "generate_scenes", lambda **given: ranges.append(given["shards"]))
    return ranges


def test_so_many_flow_runs_are_so_many_in_all(made: list[str | None]) -> None:
    flow: Any = building.build_dataset
    flow.fn(**_parameters(flow_runs=3, deployment="d/x"))
    assert made == ["d/x 3:6", "d/x 6:10", "0:3", None]
    made.clear()
    flow.fn(**_parameters())
    assert made == [None]


def test_there_are_no_more_ranges_than_shards() -> None:
    assert shard_ranges(2, 5) == ["0:1", "1:2"]
    assert shard_ranges(7, 1) == ["0:7"]


@for_each(
    ("given", "message"),
    [
        ({"flow_runs": 0}, "flow_runs is 0; expected a whole number from 1"),
        ({"flow_runs": 10**6}, "flow_runs is 1000000"),
        ({"shards": "0:2"}, "shards is '0:2'; expected no range"),
    ],
)
def test_wrong_numbers_of_runs_are_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        dataset_in_runs(_parameters(**given))
