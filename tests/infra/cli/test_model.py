"""`trilight model` says what a network is, or in one line why it cannot."""

import json
from pathlib import Path

import pytest
import torch

from model.open import open_network
from model.weights import encode_weights
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.for_each import case
from tests.model.kit import awake, tiny_config
from tests.model.published.test_convert import publishable


def printed(*arguments: str) -> str:
    result = trilight(["model", *arguments])
    if result.exception:
        raise result.exception
    assert result.exit_code == 0
    return result.stdout


def test_a_size_is_described() -> None:
    text = printed("base")
    for word in ("194.96 M", "692.7 GFLOP", "memory, bfloat16", "cross-attention"):
        assert word in text


def test_json_holds_the_numbers() -> None:
    found = json.loads(printed("large", "--json", "--views", "4", "--resolution", "512"))
    assert sum(found["parameters"].values()) == 483_266_819
    assert found["workload"] == {"resolution": 512, "triangles": 1536, "views": 4}
    assert found["config"]["window_bundles"] == 8
    assert found["weight_bytes"]["bfloat16"] < 0.51 * found["weight_bytes"]["float32"]


def test_a_checkpoint_is_described_and_published(tmp_path: Path) -> None:
    model = awake(publishable("swin"), torch.float32)
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights(model))
    target = tmp_path / "published"
    text = printed(str(path), "--publish", str(target), "--json", "--resolution", "64")
    assert json.loads(text)["config"]["window_bundles"] == 8
    again = open_network(str(target))
    for (name, a), b in zip(again.named_parameters(), model.parameters(), strict=True):
        assert torch.equal(a, b), name


MISTAKES = [
    (["huge"], r"neither a size nor a checkpoint here"),
    (["large", "--resolution", "72"], "a multiple of 64"),
    (["smoke", "--publish", "x"], "--publish needs a checkpoint"),
]


def test_mistakes_are_named() -> None:
    for arguments, message in MISTAKES:
        with case(arguments):
            with pytest.raises(TrilightError, match=message):
                printed(*arguments)


def test_a_linear_head_cannot_be_published(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights(awake(tiny_config(), torch.float32)))
    with pytest.raises(TrilightError, match="head linear"):
        printed(str(path), "--publish", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
