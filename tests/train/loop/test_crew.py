"""Who trains where: alone without torchrun, and a device that exists."""

import pytest
import torch

from storage.errors import TrilightError
from tests.for_each import for_each
from train.loop.crew import Crew, choose_device, join_crew


def test_without_torchrun_a_process_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with join_crew("cpu") as crew:
        assert (crew.rank, crew.world_size, crew.is_first) == (0, 1, True)
        assert crew.mean([1.0, 2.0]) == [1.0, 2.0]
        assert crew.any(True) and not crew.any(False)
        assert crew.gather_text("å") == ["å"]
        assert (crew.share.rank, crew.share.world_size) == (0, 1)


@for_each(("local_rank", "order"), [(0, "made waited"), (1, "waited made")])
def test_the_first_process_of_each_machine_makes_a_thing_before_the_others(
    monkeypatch: pytest.MonkeyPatch, local_rank: int, order: str
) -> None:
    done: list[str] = []

    def made() -> int:
        done.append("made")
        return 7

    monkeypatch.setattr(Crew, "any", lambda *_: done.append("waited"))
    crew = Crew(device=torch.device("cpu"), rank=8, world_size=16, local_rank=local_rank)
    assert crew.once_a_machine(made) == 7
    assert done == order.split()


def test_a_device_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(TrilightError, match="device 'tpu'; expected cpu or cuda"):
        choose_device("tpu")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(TrilightError, match="process 2 of this machine finds 2 cards"):
        choose_device("cuda", 2)
