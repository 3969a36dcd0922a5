"""What the bench measures against is the published network: ours, and its own outputs."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch.nn.functional import elu

from model.check_reference import read_reference
from model.published.config import PublishedConfig
from model.published.convert import from_published, to_published
from model.renderformer import ELU_ALPHA
from model.scene_tensors import SceneTensors
from tests.for_each import case
from tests.model.kit import awake, random_scene, render
from tests.model.published.published_pass import published_forward, published_inputs
from tests.model.published.test_convert import publishable

PATCH = 8


def test_the_transcription_is_our_network() -> None:
    for num_views in [1, 3]:
        with case(num_views):
            config = PublishedConfig(model=publishable("dpt"), texture_patch=PATCH)
            weights = to_published(awake(config.model, torch.float32), PATCH)
            generator = torch.Generator().manual_seed(1)
            texture = weights["texture_encoder.weight"]
            # an export holds one cell alone; a trained encoder fills them all
            weights["texture_encoder.weight"] = 0.1 * torch.randn(
                texture.shape, generator=generator
            )
            scene = random_scene(9, num_views, dtype=torch.float32)
            ours = elu(render(from_published(weights, config), scene)[0], alpha=ELU_ALPHA)
            inputs = published_inputs(scene, padded=14, texture_patch=PATCH)
            with torch.no_grad():
                theirs = published_forward(weights, config, inputs, ours.shape[1])
            # float32 rounds sums of size 1 to 1e-7, over a dozen layers
            torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-5)
            assert ours.std() > 0.05


def test_the_transcription_gives_the_published_outputs(shared: Path) -> None:
    path = shared / "renderformer_reference" / "base_tiny.safetensors"
    if not path.exists():
        pytest.skip(f"{path} is missing")
    reference = read_reference(path)
    weights = {
        name.removeprefix("param."): tensor.float()
        for name, tensor in load_file(path).items()
        if name.startswith("param.")
    }
    patch = round((weights["texture_encoder.weight"].shape[1] / 13) ** 0.5)
    config = PublishedConfig(model=reference.model.config, texture_patch=patch)
    batch = reference.batch
    assert batch.is_triangle_BT is not None
    for number, expected in enumerate(reference.expected_BVRR3):
        exists = batch.is_triangle_BT[number]
        scene = SceneTensors(
            triangles_T33=batch.triangles_BT33[number][exists],
            normals_T33=batch.normals_BT33[number][exists],
            material_TM=batch.material_BTM[number][exists],
            c2w_V44=batch.c2w_BV44[number],
            fov_deg_V=batch.fov_deg_BV[number],
        )
        inputs = published_inputs(scene, padded=len(exists) + 5, texture_patch=patch)
        with torch.no_grad():
            got = published_forward(weights, config, inputs, reference.resolution)
        # the bound of model.check_reference; float32's own rounding of these files is 6e-8
        torch.testing.assert_close(got, expected, rtol=0, atol=5e-7)
