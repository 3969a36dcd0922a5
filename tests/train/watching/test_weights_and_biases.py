"""A row as single numbers, and what of it is logged to Weights & Biases, by a stand-in."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.watching.rows import read_rows
from train.watching.scalars import scalars
from train.watching.settings import WatchSettings
from train.watching.weights_and_biases import BiasesBoard, require_wandb


class StandIn(ModuleType):
    """Has what is used of the package, and remembers it."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.begun: dict[str, Any] = {}
        self.logged: list[dict[str, Any]] = []
        self.metrics: list[tuple[str, str]] = []
        self.finished = 0
        self.Image = lambda picture: ("picture", picture.size)

    def init(self, **given: Any) -> "StandIn":
        self.begun = given
        return self

    def define_metric(self, name: str, *, step_metric: str) -> None:
        self.metrics.append((name, step_metric))

    def log(self, row: dict[str, Any]) -> None:
        self.logged.append(row)

    def finish(self) -> None:
        self.finished += 1


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    package = StandIn()
    monkeypatch.setitem(sys.modules, "wandb", package)
    return package


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=4, validation=1, per_shard=4)


def test_rows_and_sheets_of_a_run_are_logged_offline(
    dataset: Dataset, package: StandIn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    settings, out = tiny_run(num_steps=4), tmp_path / "mine"
    result = trained(
        settings, [str(dataset.folder.root)], out, watched=WatchSettings(wandb="light")
    )
    config = package.begun.pop("config")
    assert (config["num_steps"], config["model"]["width"]) == (4, 36)
    assert package.begun == {
        "project": "light", "group": "mine", "dir": str(out), "mode": "offline",
    }  # fmt: skip
    rows = [row for row in read_rows(result.folder.metrics) if "loss" in row]
    losses = {row["step"]: row["train/loss"] for row in package.logged if "train/loss" in row}
    assert losses == {row["step"]: row["loss"] for row in rows}
    assert any("validation/log_l1" in row and row["step"] == 4 for row in package.logged)
    assert any(row.get("validation", "")[0:1] == ("picture",) for row in package.logged)
    assert package.metrics == [("*", "step")] and package.finished == 1


def test_a_mode_of_the_users_own_is_obeyed(
    package: StandIn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "online")
    BiasesBoard("light", tmp_path, {})
    assert package.begun["mode"] == "online"


def test_where_it_is_missing_a_run_that_asks_for_it_does_not_begin(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    require_wandb(None)
    with pytest.raises(TrilightError, match="wandb is not installed.*pip install wandb.*--wandb"):
        trained(
            tiny_run(), [str(dataset.folder.root)], tmp_path, watched=WatchSettings(wandb="light")
        )
    assert list(tmp_path.iterdir()) == []


def test_groups_become_names_and_what_is_no_number_is_left_out() -> None:
    row = {
        "step": 4,
        "loss": 0.5,
        "l1": None,
        "time_s": {"data": 1.0},
        "memory_mb": {"process": 2.0},
        "layers": {"decoder.head": [1.0, 2.0, None]},
        "own_s": [0.1, 0.2],
    }
    assert scalars(row) == {
        "train/loss": 0.5,
        "time_s/data": 1.0,
        "memory_mb/process": 2.0,
        "grad_norm/decoder.head": 1.0,
        "weight_norm/decoder.head": 2.0,
        "own_s/process 0": 0.1,
        "own_s/process 1": 0.2,
    }
    assert scalars({"step": 4, "validation": {"log_l1": 0.1}}) == {"validation/log_l1": 0.1}
    assert scalars({"step": 4, "spike": {"value": 3.0, "keys": ["a"]}}) == {}
