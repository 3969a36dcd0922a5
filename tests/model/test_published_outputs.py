"""The architecture is the published one: its outputs, from its weights, to float32's floor.

Loading checkpoints is a later feature; this holds the layers themselves to the reference now.
"""

import dataclasses
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import elu

from model.config import ModelConfig
from model.renderformer import ELU_ALPHA, RenderFormer
from model.scene_tensors import SceneBatch
from tests.model.published import our_names

TOLERANCE = 5e-7
"""The file's own float32 rounding is 6e-8; 1e-5 would accept ten real mistakes."""

CONFIG = ModelConfig(
    width=256,
    num_heads=2,
    encoder_layers=1,
    decoder_layers=4,
    hidden_width=512,
    num_registers=4,
    rope_num_freqs=6,
    rope_max_freq=5.0,
    head="dpt",
    dpt_features=16,
    dpt_channels=(16, 24, 32, 48),
    dpt_taps=(0, 1, 2, 3),
)
"""As the file's metadata states it."""


@pytest.fixture(scope="module")
def tensors(shared: Path) -> dict[str, Tensor]:
    path = shared / "renderformer_reference" / "base_tiny.safetensors"
    if not path.exists():
        pytest.skip(f"{path} is missing")
    return {name: tensor.float() for name, tensor in load_file(path).items()}


@pytest.fixture(scope="module")
def network(tensors: dict[str, Tensor]) -> RenderFormer:
    start = "param."
    published = {n.removeprefix(start): t for n, t in tensors.items() if n.startswith(start)}
    model = RenderFormer(CONFIG).eval()
    model.load_state_dict(our_names(published, CONFIG, patch=8))
    return model


def reference_batch(tensors: dict[str, Tensor]) -> SceneBatch:
    material = tensors["input.material13"]
    ten = torch.cat([material[..., :7], torch.log10(1 + material[..., 10:])], dim=-1)
    is_triangle = tensors["input.valid_mask"].bool()
    real = is_triangle[..., None].float()
    return SceneBatch(
        triangles_BT33=tensors["input.triangles"] * real[..., None],
        normals_BT33=tensors["input.vertex_normals"] * real[..., None],
        material_BT10=ten * real,
        c2w_BV44=tensors["input.c2w"],
        fov_deg_BV=tensors["input.fov_deg"][..., 0],
        is_triangle_BT=is_triangle,
    )


def difference(network: RenderFormer, batch: SceneBatch, expected: Tensor) -> float:
    with torch.no_grad():
        got = elu(network(batch, 64), alpha=ELU_ALPHA)
    return (got - expected).abs().max().item()


def test_outputs_are_the_published_ones(network: RenderFormer, tensors: dict[str, Tensor]) -> None:
    expected = tensors["output.log10_radiance_bvchw"].movedim(2, -1)
    assert difference(network, reference_batch(tensors), expected) < TOLERANCE


def test_each_scene_alone_and_unpadded_gives_the_same(
    network: RenderFormer, tensors: dict[str, Tensor]
) -> None:
    expected = tensors["output.log10_radiance_bvchw"].movedim(2, -1)
    batch = reference_batch(tensors)
    assert batch.is_triangle_BT is not None
    for scene, length in enumerate(batch.is_triangle_BT.sum(1).tolist()):
        fields = {
            name: value[[scene], :length] if "BT" in name else value[[scene]]
            for name, value in vars(batch).items()
        }
        alone = dataclasses.replace(batch, **fields | {"is_triangle_BT": None})
        assert difference(network, alone, expected[[scene]]) < TOLERANCE
