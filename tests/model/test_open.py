"""Weights go round through bytes; one function opens every checkpoint, and refuses the rest."""

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor

from model.open import (
    CONFIG_NAME,
    PUBLISHED,
    WEIGHTS_NAME,
    find_network,
    open_network,
    save_published,
)
from model.renderformer import RenderFormer
from model.weights import CONFIG_KEY, TrainedRange, decode_weights, encode_config, encode_weights
from storage.errors import TrilightError
from storage.records.safe_read import safetensors_header
from storage.removed import LAST_COMMIT
from tests.for_each import case, for_each
from tests.model.kit import awake, tiny_config
from tests.model.published.test_convert import publishable


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


@for_each(
    ("name", "tensor", "message"),
    [
        ("decoder.token_W", None, r"decoder.token_W is missing, expected \(48,\)"),
        ("decoder.token_W", torch.zeros(3), r"decoder.token_W is \(3,\), expected \(48,\)"),
        ("stranger", torch.zeros(3), r"stranger is \(3,\), expected no such tensor"),
    ],
)
def test_wrong_tensors_are_listed(name: str, tensor: Tensor | None, message: str) -> None:
    config = tiny_config()
    tensors = load(encode_weights(awake(config, torch.float32)))
    tensors.pop(name, None)
    if tensor is not None:
        tensors[name] = tensor
    with pytest.raises(TrilightError, match=message):
        decode_weights(save(tensors, metadata={CONFIG_KEY: encode_config(config)}))


@for_each(
    "data",
    [
        b"",
        b"PK\x03\x04 a zip with a pickle in it",
        save({"a": torch.zeros(1)}),
        save({"a": torch.zeros(1)}, metadata={CONFIG_KEY: "{}"}),
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


def test_removed_settings_are_refused_where_they_are_used() -> None:
    """And load where they meant none."""
    data = encode_weights(awake(tiny_config(), torch.float32))

    def stating(**fields: int) -> bytes:
        config = json.loads(safetensors_header(data)["__metadata__"][CONFIG_KEY]) | fields
        return save(load(data), metadata={CONFIG_KEY: json.dumps(config)})

    off = stating(projected_freqs=0, texture_cells=0, sky_cells=0)
    assert encode_weights(decode_weights(off)) == data
    for name, value in (("projected_freqs", 7), ("texture_cells", 4), ("sky_cells", 48)):
        message = f"^network: model.{name} is {value}: removed since, and commit {LAST_COMMIT} is"
        with pytest.raises(TrilightError, match=message):
            decode_weights(stating(**{name: value}))


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    model = awake(tiny_config(), torch.float32)
    (folder / WEIGHTS_NAME).write_bytes(encode_weights(model))
    return folder


@pytest.fixture
def published(tmp_path: Path) -> Path:
    save_published(awake(publishable("swin"), torch.float32), tmp_path / "hub")
    return tmp_path / "hub"


def same(a: RenderFormer, b: RenderFormer) -> bool:
    pairs = zip(a.state_dict().items(), b.state_dict().items(), strict=True)
    return a.config == b.config and all(n == m and torch.equal(x, y) for (n, x), (m, y) in pairs)


def test_ours_opens_as_file_and_as_folder(ours: Path) -> None:
    expected = awake(tiny_config(), torch.float32)
    for source in (ours, ours / WEIGHTS_NAME):
        model = open_network(str(source))
        assert same(model, expected)
        assert not model.training
        assert all(weight.requires_grad for weight in model.parameters())


def test_published_opens_as_folder_and_as_file(published: Path) -> None:
    expected = awake(publishable("swin"), torch.float32)
    assert same(open_network(str(published)), expected)
    assert same(open_network(str(published / WEIGHTS_NAME)), expected)


def test_a_published_name_is_fetched_from_the_hub(
    published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def download(repo_id: str, filename: str, local_files_only: bool) -> str:
        assert not local_files_only
        asked.append((repo_id, filename))
        return str(published / filename)

    _stand_in_hub(monkeypatch, download, lambda name, timeout: None)
    assert same(open_network(PUBLISHED[1]), awake(publishable("swin"), torch.float32))
    assert asked == [(PUBLISHED[1], CONFIG_NAME), (PUBLISHED[1], WEIGHTS_NAME)]


def _stand_in_hub(monkeypatch: pytest.MonkeyPatch, download: Any, model_info: Any) -> None:
    hub = ModuleType("huggingface_hub")
    hub.hf_hub_download, hub.model_info = download, model_info  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)


def _no_route(*words: Any, **named: Any) -> None:
    raise ConnectionError("no route to host\nand a page of advice")


def test_a_name_that_is_plainly_a_path_asks_no_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    _stand_in_hub(monkeypatch, pytest.fail, pytest.fail)
    for name in ("runs/nosuch", "mine/model.safetensors"):
        with pytest.raises(TrilightError, match=f"checkpoint {name}: no such file or folder"):
            find_network(name)


def test_a_hub_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(repo_id: str, filename: str, local_files_only: bool) -> str:
        assert local_files_only  # else the library tries for half a minute, line by line
        raise OSError("not in the cache")

    _stand_in_hub(monkeypatch, download, _no_route)
    with pytest.raises(TrilightError, match=r"the hub did not give it \(no route to host\)") as got:
        open_network(PUBLISHED[0])
    assert "\n" not in str(got.value)


def test_what_was_fetched_before_is_opened_without_the_hub(
    published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def download(repo_id: str, filename: str, local_files_only: bool) -> str:
        assert local_files_only
        return str(published / filename)

    _stand_in_hub(monkeypatch, download, _no_route)
    assert same(open_network(PUBLISHED[1]), awake(publishable("swin"), torch.float32))


def test_without_the_hub_library_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(TrilightError, match="huggingface_hub, which would fetch it, is not"):
        open_network(PUBLISHED[0])


@for_each("source", ["nowhere/at/all", "/nowhere", "weights.pt"])
def test_a_missing_file_is_not_asked_of_the_hub(source: str) -> None:
    with pytest.raises(TrilightError, match="no such file or folder"):
        open_network(source)


@for_each("name", ["pytorch_model.bin", "weights.pt", "renamed.safetensors"])
def test_pickled_code_is_refused_unread(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    torch.save({"weight": torch.zeros(2)}, path)
    with pytest.raises(TrilightError, match="pickled"):
        open_network(str(path))
    if name == "pytorch_model.bin":
        with pytest.raises(TrilightError, match=f"expected {WEIGHTS_NAME}; pickled"):
            open_network(str(tmp_path))


def test_a_config_that_is_none_is_refused(published: Path) -> None:
    for text in ("", "[1]", "{", "[" * 50_000):
        (published / CONFIG_NAME).write_text(text)
        with case(text[:9]), pytest.raises(TrilightError, match="config.json"):
            open_network(str(published))
    (published / CONFIG_NAME).unlink()
    with pytest.raises(TrilightError, match=r"config.json: cannot be read .* need the published"):
        open_network(str(published))


def test_a_truncated_file_is_refused(ours: Path) -> None:
    path = ours / WEIGHTS_NAME
    whole = path.read_bytes()
    for start in (b"", whole[:7], whole[:8], whole[:1000], b"no network"):
        path.write_bytes(start)
        with case(start[:9]), pytest.raises(TrilightError, match="model.safetensors") as caught:
            open_network(str(path))
        assert "\n" not in str(caught.value)
    path.write_bytes((1 << 40).to_bytes(8, "little") + whole[8:])
    with pytest.raises(TrilightError, match="the header claims 1099511627776 bytes"):
        open_network(str(path))
