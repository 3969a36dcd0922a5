"""A Dask cluster that cannot make a dataset is refused before any work."""

from pathlib import Path
from typing import Any, cast

import pytest

from pipeline.flows import on_dask
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError


def test_a_dask_worker_that_sees_another_folder_is_named_before_any_work(tmp_path: Path) -> None:
    class Client:
        """Two workers, of which the second is on another machine."""

        def run(self, function: Any, *arguments: Any) -> dict[str, bool]:
            return {"tcp://a:1": function(*arguments), "tcp://b:1": False}

    order = DatasetOrder(out=str(tmp_path / "set"))
    with pytest.raises(TrilightError, match="1 of 2 Dask workers do not see.*such as tcp://b:1"):
        on_dask._require_shared(cast(Any, Client()), order)
    assert list((tmp_path / "set" / ".staging").iterdir()) == []


def test_a_dask_scheduler_that_does_not_answer_is_named() -> None:
    pytest.importorskip("distributed", reason="needs the package distributed (setup-all)")
    with (
        pytest.raises(TrilightError, match="--address http://127.0.0.1:1: no Dask scheduler"),
        on_dask._client("http://127.0.0.1:1"),
    ):
        pass
