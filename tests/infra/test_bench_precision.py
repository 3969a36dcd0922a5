"""Rounding a network part by part: nothing where nothing is rounded, each part where it stands."""

import copy
import json

import pytest
import torch
from torch import Tensor

from infra.bench.harness import ROOT
from infra.bench.marked_block import read_block
from infra.bench.model.precision_parts import measure, num_rounds
from infra.bench.model.precision_report import AS_CHOSEN, MARK, lines
from infra.bench.model.rounded_parts import parts_of, rounded
from model.attention import attend
from model.precision import set_precision
from model.renderformer import RenderFormer
from tests.model.kit import FAMILIES, awake, random_scene, render, tiny_config
from tests.train.toy import RESOLUTION, toy_sample
from train.data.scenes import training_scene

BFLOAT16 = torch.bfloat16


def network(family: str) -> RenderFormer:
    return awake(tiny_config(family), torch.float32)


def picture(model: RenderFormer) -> Tensor:
    return render(model, random_scene(12, dtype=torch.float32))


def error(model: RenderFormer, *names: str, dtype: torch.dtype = BFLOAT16) -> float:
    """Return the largest change of a pixel."""
    return (picture(rounded(model, names, dtype)) - picture(model)).abs().max().item()


@pytest.mark.parametrize("family", FAMILIES)
def test_rounding_nothing_changes_nothing(family: str) -> None:
    assert error(network(family)) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_each_part_alone_changes_the_picture_and_not_the_network(family: str) -> None:
    model = network(family)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for part in parts_of(model):
        coarse, fine = error(model, part.name), error(model, part.name, dtype=torch.float16)
        # three more digits are an eighth of the error; half leaves room for chance
        assert 0 < fine < coarse / 2, part.name
        # 8 digits of a network of four layers whose pictures have size 1
        assert coarse < 0.3, part.name
    assert all(torch.equal(before[name], tensor) for name, tensor in model.state_dict().items())


@pytest.mark.parametrize("family", FAMILIES)
def test_the_narrow_parts_are_what_a_precision_rounds(family: str) -> None:
    """Weight by weight, to the bit: none is forgotten, none is counted that stays float32."""
    model = network(family)
    names = [part.name for part in parts_of(model) if part.narrow]
    emulated = rounded(model, names, BFLOAT16).state_dict()
    chosen = set_precision(copy.deepcopy(model), "bfloat16").state_dict()
    for name, tensor in chosen.items():
        assert torch.equal(tensor.float(), emulated[name]), name
    every = rounded(model, [part.name for part in parts_of(model)], BFLOAT16).state_dict()
    for name, tensor in every.items():
        assert torch.equal(tensor, model.state_dict()[name].bfloat16().float()), name


def test_a_pass_that_fails_leaves_torch_as_it_was() -> None:
    """The kernel is replaced while an attention layer computes, and only then."""
    generator = torch.Generator().manual_seed(0)
    q, k, v = torch.randn(3, 1, 2, 5, 8, generator=generator)
    before = attend(q, k, v, None)
    model = rounded(network("linear"), ["encoder: attention kernel"], BFLOAT16)
    attention = model.encoder.layers.get_submodule("0.attention")

    def fail(*_: object) -> None:
        assert not torch.equal(attend(q, k, v, None), before)
        raise RuntimeError("within the layer")

    attention.get_submodule("out").register_forward_pre_hook(fail)
    with pytest.raises(RuntimeError, match="within the layer"):
        picture(model)
    assert torch.equal(attend(q, k, v, None), before)


def test_a_network_is_measured_whole_and_told() -> None:
    model = network("linear")
    scenes = [training_scene(toy_sample(index), RESOLUTION) for index in range(2)]
    rounds: list[None] = []
    result = measure(
        model, scenes, network="tiny", dataset="toys", round_done=lambda: rounds.append(None)
    )
    assert len(rounds) == num_rounds(model)
    assert (result.scenes, result.views) == (2, 4)
    assert all(found.worst <= found.median < 100 for found in result.wholes.values())
    # all parts together are worse than the most harmless of them
    every = result.wholes["bfloat16, every part"].median
    assert every < max(one.alone.median for one in result.parts)
    told = lines(result)
    assert sum(line.startswith("|") for line in told) == len(result.parts) + 5 + len(result.wholes)
    assert len(json.loads(result.as_json_line())["parts"]) == len(result.parts)
    assert AS_CHOSEN in "\n".join(told)


def test_the_page_has_a_place_for_the_table() -> None:
    assert "alone in bfloat16" in read_block(ROOT / "docs" / "tradeoffs.md", MARK)
