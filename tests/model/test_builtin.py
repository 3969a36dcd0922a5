"""The networks that are shipped: they open by name, are small, and their cards are of them."""

import re

import pytest

from infra.setup.builtin_network import MOST_BYTES
from model.neural_renderer import NeuralRenderer
from model.open import BUILTIN, BUILTIN_NETWORKS, BUILTIN_TOKENS, find_network, open_network
from model.renderformer import count_parameters
from model.weights import encode_weights, from_tensors, read_tensors, trained_range
from storage.digests import sha256_hex
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_scene

NAMES = tuple(name for name in BUILTIN_NETWORKS if name != BUILTIN)


@for_each("name", NAMES)
def test_the_card_is_of_these_weights(name: str) -> None:
    file = BUILTIN_NETWORKS[name]
    weights, card = file.read_bytes(), file.with_name("README.md").read_text()
    assert len(weights) <= MOST_BYTES
    assert f"{len(weights)} bytes, sha256 `{sha256_hex(weights)}`" in card
    (stated,) = re.findall(r"size: (\d+) parameters", card)
    assert count_parameters(open_network(name)) == int(stated)


def test_the_better_one_opens_without_a_name() -> None:
    assert find_network(BUILTIN).path == find_network("builtin:hits").path
    assert open_network(BUILTIN).config.view_stage == "hits"
    assert open_network(BUILTIN_TOKENS).config.view_stage == "bundles"


def test_a_name_that_does_not_come_along_is_said() -> None:
    with pytest.raises(TrilightError, match="builtin:token: no such network comes along.*tokens"):
        find_network("builtin:token")


@for_each("name", NAMES)
def test_it_renders_by_its_name_and_knows_its_range(name: str) -> None:
    renderer = NeuralRenderer.load(name, device="cpu")
    known = renderer.trained
    assert known.resolution == 64 and known.max_triangles is not None
    picture = renderer.render(tiny_scene(), 64)
    assert picture.shape[1:] == (64, 64, 3) and picture.min() >= 0 and picture.max() > 0.01
    notes = renderer.resolution_notes(128)
    assert renderer.resolution_notes(64) == ()
    assert ["trained on 64" in note for note in notes] == [True] * (name == BUILTIN_TOKENS)


@for_each("name", NAMES)
def test_its_file_is_written_again_byte_for_byte(name: str) -> None:
    """A field of the configuration that came later must not change what older networks are."""
    tensors, metadata = read_tensors(BUILTIN_NETWORKS[name])
    network = from_tensors(tensors, metadata)
    again = encode_weights(network, trained_range(metadata))
    assert again == BUILTIN_NETWORKS[name].read_bytes()
