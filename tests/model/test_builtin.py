"""The network that is shipped: it opens by its name, is small, and its card is of these weights."""

import re

from infra.setup.builtin_network import MOST_BYTES
from model.neural_renderer import NeuralRenderer
from model.open import BUILTIN, BUILTIN_WEIGHTS, open_network
from model.renderformer import count_parameters
from model.weights import encode_weights, from_tensors, read_tensors, trained_range
from storage.digests import sha256_hex
from tests.scenes_by_hand import tiny_scene


def test_the_card_is_of_these_weights() -> None:
    weights = BUILTIN_WEIGHTS.read_bytes()
    card = BUILTIN_WEIGHTS.with_name("README.md").read_text()
    assert len(weights) <= MOST_BYTES
    assert f"{len(weights)} bytes, sha256 `{sha256_hex(weights)}`" in card
    (stated,) = re.findall(r"size: (\d+) parameters", card)
    assert count_parameters(open_network(BUILTIN)) == int(stated)
    # it was judged, and it has learned: the network's error is below the median picture's
    (network, median, _) = re.findall(r"\| log_l1 \| (\S+) \| (\S+) \| (\S+) \|", card)[0]
    assert float(network) < 0.8 * float(median)


def test_it_renders_by_its_name_and_knows_its_range() -> None:
    renderer = NeuralRenderer.load(BUILTIN, device="cpu")
    known = renderer.trained
    assert known.resolution == 64 and known.max_triangles is not None
    picture = renderer.render(tiny_scene(), 64)
    assert picture.shape[1:] == (64, 64, 3) and picture.min() >= 0 and picture.max() > 0.01
    (note,) = renderer.resolution_notes(128)
    assert "trained on 64" in note and renderer.resolution_notes(64) == ()


def test_its_file_is_written_again_byte_for_byte() -> None:
    """A field of the configuration that came later must not change what older networks are."""
    tensors, metadata = read_tensors(BUILTIN_WEIGHTS)
    network = from_tensors(tensors, metadata)
    assert encode_weights(network, trained_range(metadata)) == BUILTIN_WEIGHTS.read_bytes()
