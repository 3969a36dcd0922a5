"""Weights go round through bytes, and nothing else is accepted."""

import json
from collections.abc import Callable

import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor

from model.weights import CONFIG_KEY, TrainedRange, decode_weights, encode_config, encode_weights
from storage.errors import TrilightError
from storage.records.safe_read import safetensors_header
from storage.removed import LAST_COMMIT
from tests.for_each import for_each
from tests.model.kit import awake, tiny_config


def with_config(data: bytes, **fields: object) -> bytes:
    """Return a file of weights whose configuration states more fields."""
    config = json.loads(safetensors_header(data)["__metadata__"][CONFIG_KEY]) | fields
    return save(load(data), metadata={CONFIG_KEY: json.dumps(config)})


@for_each("head", ["linear", "dpt"])
def test_round_trip_is_exact_and_reproducible(head: str) -> None:
    model = awake(tiny_config(head), torch.float32)
    data = encode_weights(model)
    again = decode_weights(data)
    assert again.config == model.config
    assert not again.training
    for (name, a), b in zip(model.named_parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b), name
    assert encode_weights(again) == data


def without_first(tensors: dict[str, Tensor]) -> None:
    del tensors["decoder.token_W"]


def with_other_shape(tensors: dict[str, Tensor]) -> None:
    tensors["decoder.token_W"] = torch.zeros(3)


def with_stranger(tensors: dict[str, Tensor]) -> None:
    tensors["stranger"] = torch.zeros(3)


@for_each(
    ("change", "message"),
    [
        (without_first, r"decoder.token_W is missing, expected \(48,\)"),
        (with_other_shape, r"decoder.token_W is \(3,\), expected \(48,\)"),
        (with_stranger, r"stranger is \(3,\), expected no such tensor"),
    ],
)
def test_wrong_tensors_are_listed(
    change: Callable[[dict[str, Tensor]], None], message: str
) -> None:
    config = tiny_config()
    tensors = load(encode_weights(awake(config, torch.float32)))
    change(tensors)
    with pytest.raises(TrilightError, match=message):
        decode_weights(save(tensors, metadata={CONFIG_KEY: encode_config(config)}))


@for_each(
    "data",
    [
        b"",
        b"PK\x03\x04 a zip with a pickle in it",
        save({"a": torch.zeros(1)}),
        save({"a": torch.zeros(1)}, metadata={CONFIG_KEY: "{}"}),
        save({"a": torch.zeros(1)}, metadata={CONFIG_KEY: "[1]"}),
    ],
)
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises(TrilightError):
        decode_weights(data)


def test_equal_networks_give_equal_bytes_in_any_process() -> None:
    """Ten writings: the library shuffles two entries of metadata, half of the times."""
    model = awake(tiny_config("linear"), torch.float32)
    files = {encode_weights(model, TrainedRange(max_triangles=7)) for _ in range(10)}
    assert len(files) == 1
    header = safetensors_header(files.pop())["__metadata__"]
    assert list(header) == sorted(header) and len(header) == 2


def test_removed_settings_load_where_they_meant_none() -> None:
    data = encode_weights(awake(tiny_config(), torch.float32))
    off = with_config(data, projected_freqs=0, texture_cells=0, sky_cells=0)
    assert encode_weights(decode_weights(off)) == data


@for_each("used", [{"projected_freqs": 7}, {"texture_cells": 4}, {"sky_cells": 48}])
def test_removed_settings_are_refused_where_they_are_used(used: dict[str, int]) -> None:
    data = encode_weights(awake(tiny_config(), torch.float32))
    ((name, value),) = used.items()
    message = f"^network: model.{name} is {value}: removed since, and commit {LAST_COMMIT} is"
    with pytest.raises(TrilightError, match=message):
        decode_weights(with_config(data, **used))
