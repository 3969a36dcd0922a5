"""Weights go round through bytes; one function opens every checkpoint, and refuses the rest.

Shipped networks open by name and are those of their cards. Published checkpoints go in and out
without loss, nothing else goes in, and we are the published network to float32's own floor.
"""

import dataclasses
import json
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import load, load_file, save, save_file
from torch import Tensor

from infra.setup.builtin_network import MOST_BYTES
from model.config import SIZES
from model.inference import NeuralRenderer
from model.open import (
    BUILTIN,
    BUILTIN_NETWORKS,
    BUILTIN_TOKENS,
    CONFIG_NAME,
    PUBLISHED,
    WEIGHTS_NAME,
    find_network,
    open_network,
    save_published,
)
from model.published import (
    NORMAL,
    TANGENT_NORMAL,
    TEXTURE_CHANNELS,
    _require_frequencies,
    decode_published_config,
    encode_published_config,
    export_published_weights,
    fold,
    load_published_weights,
)
from model.renderformer import RenderFormer, count_parameters
from model.weights import (
    CONFIG_KEY,
    TrainedRange,
    encode_weights,
    read_tensors,
)
from storage.digests import sha256_hex
from storage.errors import LAST_COMMIT, TrilightError
from storage.records.safe_read import safetensors_header
from tests.for_each import case, for_each
from tests.model.check_reference import TOLERANCE, differences, main, published_network
from tests.model.kit import awake, publishable, tiny_config
from tests.scenes_by_hand import tiny_scene


def reopened(data: bytes, folder: Path) -> RenderFormer:
    """Return the network of a file of these bytes."""
    path = folder / WEIGHTS_NAME
    path.write_bytes(data)
    return open_network(path)


def same(a: RenderFormer, b: RenderFormer) -> bool:
    pairs = zip(a.state_dict().items(), b.state_dict().items(), strict=True)
    return a.config == b.config and all(n == m and torch.equal(x, y) for (n, x), (m, y) in pairs)


@for_each("head", ["linear", "dpt"])
def test_round_trip_is_exact_and_reproducible(head: str, tmp_path: Path) -> None:
    model = awake(tiny_config(head), torch.float32)
    data = encode_weights(model)
    again = reopened(data, tmp_path)
    assert same(again, model) and not again.training
    assert encode_weights(again) == data
    # ten writings: the library shuffles two entries of metadata, half of the times
    files = {encode_weights(model, TrainedRange(max_triangles=7)) for _ in range(10)}
    assert len(files) == 1
    header = safetensors_header(files.pop())["__metadata__"]
    assert list(header) == sorted(header) and len(header) == 2


def test_removed_settings_are_refused_where_they_are_used_and_no_configuration_always(
    tmp_path: Path,
) -> None:
    """Removed settings load where they meant none."""
    data = encode_weights(awake(tiny_config(), torch.float32))

    def stating(**fields: int) -> bytes:
        config = json.loads(safetensors_header(data)["__metadata__"][CONFIG_KEY]) | fields
        return save(load(data), metadata={CONFIG_KEY: json.dumps(config)})

    off = stating(projected_freqs=0, texture_cells=0, sky_cells=0)
    assert encode_weights(reopened(off, tmp_path)) == data
    for name, value in (("projected_freqs", 7), ("texture_cells", 4), ("sky_cells", 48)):
        removed = f"model.{name} is {value}: removed since, and commit {LAST_COMMIT} is"
        with pytest.raises(TrilightError, match=f"{WEIGHTS_NAME}: {removed}"):
            reopened(stating(**{name: value}), tmp_path)
    with pytest.raises(TrilightError, match="weights that carry no configuration of ours need"):
        reopened(save(load(data)), tmp_path)
    with pytest.raises(TrilightError, match=f"{WEIGHTS_NAME}: model: setting 'width' is missing"):
        reopened(save(load(data), metadata={CONFIG_KEY: "{}"}), tmp_path)


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


def test_a_network_opens_as_file_and_as_folder(ours: Path, published: Path) -> None:
    for folder, config in ((ours, tiny_config()), (published, publishable("swin"))):
        for source in (folder, folder / WEIGHTS_NAME):
            model = open_network(str(source))
            assert same(model, awake(config, torch.float32)) and not model.training
            assert all(weight.requires_grad for weight in model.parameters())


@for_each("is_there", [True, False])
def test_a_published_name_is_fetched_from_the_hub_or_was_before(
    published: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool
) -> None:
    asked = []

    def download(repo_id: str, filename: str, local_files_only: bool) -> str:
        assert local_files_only != is_there
        asked.append((repo_id, filename))
        return str(published / filename)

    _stand_in_hub(monkeypatch, download, (lambda name, timeout: None) if is_there else _no_route)
    assert same(open_network(PUBLISHED[1]), awake(publishable("swin"), torch.float32))
    assert asked == [(PUBLISHED[1], CONFIG_NAME), (PUBLISHED[1], WEIGHTS_NAME)]


def _stand_in_hub(monkeypatch: pytest.MonkeyPatch, download: Any, model_info: Any) -> None:
    hub = ModuleType("huggingface_hub")
    hub.hf_hub_download, hub.model_info = download, model_info  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)


def _no_route(*words: Any, **named: Any) -> None:
    raise ConnectionError("no route to host\nand a page of advice")


def test_a_hub_or_library_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a name that is plainly a path asks none."""
    _stand_in_hub(monkeypatch, pytest.fail, pytest.fail)
    for name in ("runs/nosuch", "mine/model.safetensors", "/nowhere", "weights.pt"):
        said = rf"checkpoint {name}: no such file or folder; expected one, default \("
        with pytest.raises(TrilightError, match=said):
            find_network(name)

    def download(repo_id: str, filename: str, local_files_only: bool) -> str:
        assert local_files_only  # else the library tries for half a minute, line by line
        raise OSError("not in the cache")

    _stand_in_hub(monkeypatch, download, _no_route)
    with pytest.raises(TrilightError, match=r"the hub did not give it \(no route to host\)") as got:
        open_network(PUBLISHED[0])
    assert "\n" not in str(got.value)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(TrilightError, match="huggingface_hub, which would fetch it, is not"):
        open_network(PUBLISHED[0])


@for_each("name", ["pytorch_model.bin", "weights.pt", "renamed.safetensors"])
def test_pickled_code_is_refused_unread(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    torch.save({"weight": torch.zeros(2)}, path)
    with pytest.raises(TrilightError, match="pickled"):
        open_network(str(path))
    if name == "pytorch_model.bin":
        with pytest.raises(TrilightError, match=f"expected {WEIGHTS_NAME}; pickled"):
            open_network(str(tmp_path))


def test_a_config_with_a_byte_order_mark_opens_and_what_is_none_is_refused(
    published: Path,
) -> None:
    """An editor may have saved it."""
    text = (published / CONFIG_NAME).read_text()
    for encoding in ("utf-8-sig", "utf-16"):
        (published / CONFIG_NAME).write_text(text, encoding)
        with case(encoding):
            assert open_network(str(published)).config == publishable("swin")
    for text in ("", "[1]", "{", "[" * 50_000):
        (published / CONFIG_NAME).write_text(text)
        with case(text[:9]), pytest.raises(TrilightError, match="config.json"):
            open_network(str(published))
    (published / CONFIG_NAME).unlink()
    with pytest.raises(TrilightError, match=r"config.json: cannot be read .* need the published"):
        open_network(str(published))


def test_a_file_that_is_cut_or_something_else_is_refused(ours: Path) -> None:
    path = ours / WEIGHTS_NAME
    whole = path.read_bytes()
    pickle = b"PK\x03\x04 a zip with a pickle in it"
    for start in (b"", whole[:7], whole[:8], whole[:1000], b"no network", pickle):
        path.write_bytes(start)
        with case(start[:9]), pytest.raises(TrilightError, match="model.safetensors") as caught:
            open_network(str(path))
        assert "\n" not in str(caught.value)
    path.write_bytes((1 << 40).to_bytes(8, "little") + whole[8:])
    with pytest.raises(TrilightError, match="the header claims 1099511627776 bytes"):
        open_network(str(path))


NAMES = tuple(name for name in BUILTIN_NETWORKS if name != BUILTIN)


@for_each("name", NAMES)
def test_a_shipped_file_is_that_of_its_card_and_is_written_again_byte_for_byte(name: str) -> None:
    """A field of the configuration that came later must not change what older networks are."""
    file = BUILTIN_NETWORKS[name]
    weights, card = file.read_bytes(), file.with_name("README.md").read_text()
    assert len(weights) <= MOST_BYTES
    assert f"{len(weights)} bytes, sha256 `{sha256_hex(weights)}`" in card
    (stated,) = re.findall(r"size: (\d+) parameters", card)
    assert count_parameters(open_network(name)) == int(stated)
    network = open_network(file)
    assert encode_weights(network, find_network(file).trained) == weights


def test_a_name_that_does_not_come_along_is_said_and_the_better_one_needs_none() -> None:
    assert find_network(BUILTIN).path == find_network("builtin:hits").path
    with pytest.raises(TrilightError, match="builtin:token: no such network comes along.*tokens"):
        find_network("builtin:token")


@for_each("name", NAMES)
def test_it_renders_by_its_name_and_knows_its_range(name: str) -> None:
    renderer = NeuralRenderer.load(name, device="cpu")
    known = renderer.trained
    assert (
        known.resolution == (64 if name == BUILTIN_TOKENS else 128)
        and known.max_triangles is not None
    )
    picture = renderer.render(tiny_scene(), 64)
    assert picture.shape[1:] == (64, 64, 3) and picture.min() >= 0 and picture.max() > 0.01
    notes = renderer.resolution_notes(128)
    assert renderer.resolution_notes(64) == ()
    assert ["trained on 64" in note for note in notes] == [True] * (name == BUILTIN_TOKENS)


SWIN_LARGE: dict[str, Any] = {
    "latent_dim": 1024, "num_layers": 12, "num_heads": 8, "dim_feedforward": 4096,
    "num_register_tokens": 32, "rope_double_max_freq": True, "texture_encode_patch_size": 1,
    "view_transformer_latent_dim": 1024, "view_transformer_ffn_hidden_dim": 4096,
    "view_transformer_n_heads": 8, "view_transformer_n_layers": 12,
    "view_transformer_use_swin_attn": True, "dpt_features": 256,
    "dpt_out_channels": [256, 512, 1024, 1024], "dpt_out_layers": [2, 5, 8, 11],
}  # fmt: skip
"""V1.1-Large as described; what is left out has V1-Base's value."""

FREQS = "view_transformer.transformer.rope_emb.freqs"


def test_the_published_sizes_are_the_named_ones() -> None:
    for fields, name, patch in (({}, "base", 32), (SWIN_LARGE, "large", 1)):
        got, texture_patch = decode_published_config(fields)
        assert dataclasses.replace(got, register_eps=0.0) == SIZES[name]()
        assert got.register_eps == 1e-5
        assert texture_patch == patch


@for_each("family", ["dpt", "swin"])
@for_each("patch", [1, 8])
def test_export_and_import_give_the_same_network(family: str, patch: int) -> None:
    config = (publishable(family), patch)
    assert (
        decode_published_config(json.loads(json.dumps(encode_published_config(config)))) == config
    )
    model = awake(config[0], torch.float32)
    assert same(load_published_weights(export_published_weights(model, patch), config), model)


def test_frequencies_differ_by_their_rounding_alone() -> None:
    """Others are those of another configuration, with which the same weights mean other places."""
    formula = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    _require_frequencies("freqs", formula * (1 + 0.9e-6), formula)
    for wrong in (1 - 1.5e-6, 1 + 1.5e-6):
        with pytest.raises(TrilightError, match="freqs is .*expected a config.json that belongs"):
            _require_frequencies("freqs", formula * wrong, formula)


@for_each(
    ("fields", "message"),
    [
        ({"activation": "gelu"}, "activation 'gelu', expected 'swiglu'"),
        ({"use_dpt_decoder": False}, "use_dpt_decoder False, expected True"),
        ({"num_frequencies": 3}, r"num_frequencies \(unknown\)"),
        ({"latent_dim": 1536}, "view_transformer_latent_dim 768, expected latent_dim 1536"),
        ({"dpt_out_channels": 3}, "dpt_out_channels 3, expected list"),
        ({"dpt_out_layers": [0, 1, 2, 99]}, "dpt_taps"),
    ],
)
def test_what_was_never_published_is_refused_by_name(fields: dict, message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        decode_published_config(fields)


@for_each(
    ("changes", "message"),
    [
        ({"head": "linear", "dpt_features": 0, "dpt_channels": (), "dpt_taps": ()}, "head linear"),
        ({"window_bundles": 4}, "window_bundles 4"),
        ({"rope_max_freq": 3.0}, "rope_max_freq 3.0 of 3 frequencies"),
        ({"demodulated": True, "hit_rays": 1}, "demodulated True"),
    ],
)
def test_what_their_code_cannot_build_is_not_exported(changes: dict, message: str) -> None:
    model = dataclasses.replace(publishable("dpt"), **changes)
    with pytest.raises(TrilightError, match=message):
        encode_published_config((model, 1))


@for_each(
    ("name", "tensor", "message"),
    [
        ("vn_encoding_proj.bias", None, r"vn_encoding_proj.bias is missing, expected \(144,\)"),
        ("reg_tokens", torch.zeros(1, 3, 144), r"is \(1, 3, 144\), expected \(1, 2, 144\)"),
        ("stranger.weight", torch.zeros(2), r"stranger.weight is \(2,\), expected no such tensor"),
        ("texture_encoder.weight", torch.zeros(144, 208), r"is \(144, 208\), expected \(144, 13\)"),
        (FREQS, torch.tensor([1.01, 2**0.5, 2.0]), f"{FREQS} is .* the configuration means"),
    ],
)
def test_wrong_published_tensors_are_listed(name: str, tensor: Tensor | None, message: str) -> None:
    config = (publishable("dpt"), 1)
    tensors = export_published_weights(awake(config[0], torch.float32), 1)
    tensors.pop(name, None)
    if tensor is not None:
        tensors[name] = tensor
    with pytest.raises(TrilightError, match=message):
        load_published_weights(tensors, config)


def texture(material_TM: Tensor, patch: int) -> Tensor:
    """Return the published input [T, 13 P P], cell by cell."""
    pictures = torch.zeros(len(material_TM), TEXTURE_CHANNELS, patch, patch, dtype=torch.float64)
    normal = torch.tensor(TANGENT_NORMAL, dtype=torch.float64).expand(len(material_TM), 3)
    thirteen = torch.cat([material_TM[:, :7], normal, material_TM[:, 7:]], dim=1)
    for x in range(patch):
        for y in range(patch):
            if x + y <= patch:
                pictures[:, :, x, y] = thirteen
    return pictures.flatten(1)


@for_each(("patch", "cells"), [(1, 1), (8, 43), (32, 559)])
def test_a_folded_layer_is_the_unfolded_one(patch: int, cells: int) -> None:
    generator = torch.Generator().manual_seed(patch)
    inputs = TEXTURE_CHANNELS * patch**2
    weight = torch.randn(5, inputs, generator=generator, dtype=torch.float64)
    bias = torch.randn(5, generator=generator, dtype=torch.float64)
    material = torch.rand(4, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pictures = texture(material, patch)
    assert int((pictures[0, : patch**2] != 0).sum()) == cells
    ten, folded_bias = fold(weight, bias, patch)
    # float64 sums of 559 x 13 products of size 1
    expected = pictures @ weight.T + bias
    torch.testing.assert_close(material @ ten.T + folded_bias, expected, rtol=0, atol=1e-11)


def test_folding_sums_in_float64() -> None:
    """559 float32 weights that cancel: a float32 sum would keep their rounding."""
    weight = torch.full((1, TEXTURE_CHANNELS * 32**2), 0.1)
    ten, bias = fold(weight, torch.zeros(1), 32)
    exact = 559 * float(torch.tensor(0.1))
    assert ten[0, 0].item() == torch.tensor(exact).item()
    normal_sum = exact * sum(TANGENT_NORMAL)
    assert bias.item() == torch.tensor(normal_sum).item()
    assert NORMAL == slice(7, 10)


FILES = ["base_tiny.safetensors", "swin_tiny.safetensors"]


def found_in(shared: Path, name: str) -> Path:
    path = shared / "renderformer_reference" / name
    if not path.exists():
        pytest.skip(f"{path} is missing")
    return path


@pytest.fixture(scope="module", params=FILES)
def reference(request: pytest.FixtureRequest, shared: Path) -> Path:
    return found_in(shared, request.param)


def test_export_gives_back_what_was_published(reference: Path) -> None:
    """All but the texture encoder bit by bit; that one as a function, by the test above."""
    published, config = published_network(*read_tensors(reference))
    exported = export_published_weights(load_published_weights(published, config), config[1])
    assert exported.keys() == published.keys()
    for key, tensor in exported.items():
        assert tensor.shape == published[key].shape, key
        if not key.startswith("texture_encoder."):
            assert torch.equal(tensor, published[key].float()), key


def changed(reference: Path, folder: Path, name: str, change: Tensor) -> str:
    """Return a copy of the file in which one tensor is another."""
    _, metadata = read_tensors(reference)
    tensors = load_file(reference)
    path = folder / "changed.safetensors"
    save_file(tensors | {name: change.to(tensors[name].dtype)}, path, metadata=metadata)
    return str(path)


def test_outputs_are_the_published_ones(reference: Path, capsys: pytest.CaptureFixture) -> None:
    found = differences(reference)
    # float32's own rounding of these files is 6e-8; ten real mistakes would pass at 1e-5
    assert TOLERANCE == 5e-7 > max(found["padded"], found["unpadded"])
    assert main([str(reference)]) == 0
    printed = capsys.readouterr().out
    for name in ("padded", "unpadded"):
        assert f"{name:<9} max difference {found[name]:.3g}" in printed
    assert "passes" in printed


def test_a_pixel_that_differs_is_in_both_differences_and_nan_fails(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """In the first or the last scene: neither comparison may stop at the other's result."""
    base, name = found_in(shared, FILES[0]), "output.log10_radiance_bvchw"
    for place in (0, -1):
        expected = load_file(base)[name].float()
        expected[(place,) * 5] += 1e-6
        path = changed(base, tmp_path, name, expected)
        found = differences(Path(path))
        assert found["padded"] > TOLERANCE and found["unpadded"] > TOLERANCE and main([path]) == 1
    capsys.readouterr()
    name = "param.view_transformer.out_dpt.scratch.output_conv2.2.bias"
    assert main([changed(base, tmp_path, name, torch.full((3,), torch.nan))]) == 1
    assert "FAILS" in capsys.readouterr().out


def test_what_stands_in_the_padding_does_not_matter(reference: Path, tmp_path: Path) -> None:
    tensors = load_file(reference)
    triangles = tensors["input.triangles"]
    triangles[tensors["input.valid_mask"] == 0] = torch.nan
    assert main([changed(reference, tmp_path, "input.triangles", triangles)]) == 0


def test_the_command_takes_one_reference(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([]) == main(["a", "b"]) == 2
    path = tmp_path / "other.safetensors"
    save_file({"input.triangles": torch.zeros(1, 1, 3, 3)}, path)
    assert main([str(path)]) == 1
    printed = capsys.readouterr().err
    assert "no input.vertex_normals, " in printed and "config" in printed
