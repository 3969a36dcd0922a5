"""Published weights with textured input: the published layer's own arithmetic, stated again."""

import math

import numpy as np
import torch
from torch import Tensor

from model.published.config import PublishedConfig
from model.published.convert import TEXTURE, from_published, to_published
from model.scene_tensors import batch_scenes, batch_with_cells, scene_tensors
from model.texture_cells import TextureCells
from tests.for_each import for_each
from tests.model.hits.kit import corner, textured
from tests.model.kit import awake, render
from tests.model.published.test_convert import publishable


def _published(patch: int) -> tuple[dict[str, Tensor], PublishedConfig]:
    """Return weights of the published layout whose cells all differ."""
    config = PublishedConfig(model=publishable("dpt"), texture_patch=patch)
    tensors = to_published(awake(config.model, torch.float32), patch)
    generator = torch.Generator().manual_seed(7)
    weight = tensors[f"{TEXTURE}.weight"]
    tensors[f"{TEXTURE}.weight"] = torch.randn(weight.shape, generator=generator) / patch
    return tensors, config


def _texture_of(material_10: Tensor, cells: TextureCells | None, row: int, patch: int) -> Tensor:
    """Return the 13 x P x P numbers that the published network reads of one triangle.

    Diffuse, specular, roughness, normal, emission; zero beyond x + y = P.
    """
    texture = torch.zeros(13, patch, patch, dtype=torch.float64)
    for i in range(patch):
        for j in range(patch):
            if i + j > patch:
                continue
            texture[:7, i, j] = material_10[:7]
            if cells is not None:
                texture[:7, i, j] = cells.mean_KC[row] + cells.apart_KCPP[row, :, i, j].double()
            texture[7:10, i, j] = torch.tensor([0.5, 0.5, 1.0])
            texture[10:13, i, j] = material_10[7:]
    return texture


@for_each("patch", [1, 8, 32])
def test_tokens_are_what_the_published_layer_makes_of_cells(patch: int) -> None:
    tensors, config = _published(patch)
    network = from_published(tensors, config, cells=True).double()
    batch = batch_with_cells(batch_scenes([scene_tensors(textured())]), patch)
    cells = batch.cells
    assert cells is not None
    found = list[Tensor]()
    norm = network.encoder.tokens.material_norm
    norm.register_forward_pre_hook(lambda _, given: found.append(given[0]))
    with torch.no_grad():
        materials = cells.means_in(batch.material_BTM.double(), batch.columns)
        network.encoder.tokens(materials, batch.normals_BT33.double(), cells=cells)
    weight, bias = (tensors[f"{TEXTURE}.{kind}"].double() for kind in ("weight", "bias"))
    plain = [row for row in range(3) if row not in cells.triangle_K.tolist()]
    picked = [(None, row) for row in plain] + [
        (number, int(cells.triangle_K[number])) for number in (0, 1, len(cells.triangle_K) - 1)
    ]
    for number, row in picked:
        told = None if number is None else cells
        texture = _texture_of(batch.material_BTM[0, row].double(), told, number or 0, patch)
        expected = weight @ texture.flatten() + bias
        # The folded weight is rounded to float32 once: 6e-8 of numbers of a size of 10.
        assert (found[0][0, row] - expected).abs().max() < 3e-6


def test_scenes_without_textures_have_the_pictures_of_folded_weights() -> None:
    tensors, config = _published(8)
    scene = scene_tensors(corner())
    folded, with_cells = (
        render(from_published(tensors, config, cells=cells), scene) for cells in (False, True)
    )
    assert torch.equal(folded, with_cells)


def test_cells_trained_on_constants_keep_the_differences_they_were_drawn_with() -> None:
    """Why a textured picture by published weights is no better founded with cells than without."""
    patch = 4
    tensors, _ = _published(patch)
    drawn = tensors[f"{TEXTURE}.weight"].clone()
    weight = torch.nn.Parameter(drawn.clone())
    optimizer = torch.optim.AdamW([weight], lr=1e-2, weight_decay=0.0)
    place = torch.from_numpy(np.add.outer(np.arange(patch), np.arange(patch)) <= patch)
    rng = torch.Generator().manual_seed(0)
    for _ in range(5):
        constant = torch.rand(13, 1, 1, generator=rng) * place
        optimizer.zero_grad()
        (weight @ constant.flatten() - 1).square().sum().backward()
        optimizer.step()
    moved = (weight.detach() - drawn).unflatten(1, (13, patch, patch))[:, :, place]
    assert moved.abs().median() > 1e-3
    # Equal gradients make equal steps, to the rounding of float32.
    assert math.isclose(float((moved - moved[:, :, :1]).abs().max()), 0, abs_tol=1e-6)
