"""Cells of textures: area means, nothing for what is constant, and tokens that read them."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

import model.scene_tensors
from model.hits.textures import SurfaceTextures
from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors, batch_scenes, batch_with_cells, scene_tensors
from model.scene_tensors import with_cells as with_own_cells
from model.texture_cells import CHANNELS, TextureCells, texture_cells
from model.weights import decode_weights, encode_weights
from storage.errors import TrilightError
from storage.records.scene_maps import MAX_UV
from storage.records.texture import CONSTANT, Texture
from tests.for_each import for_each
from tests.model.hits.kit import corner, textured
from tests.model.kit import awake, render, tiny_config
from train.data.augment import with_channels, with_vertices_turned
from train.data.scenes import TrainingScene

Cells = NDArray[np.float32]


def _textures(texture: Texture, uv_T32: Any, place: int = 0) -> SurfaceTextures:
    """Return triangles of which one column is textured."""
    uv = np.asarray(uv_T32, np.float32)
    rows = np.full((len(uv), 3), CONSTANT, np.int32)
    rows[:, place] = 0
    return SurfaceTextures(uv_T32=uv, rows_T3=rows, textures=(texture,))


def _found(textures: SurfaceTextures, cells_a_side: int) -> TextureCells:
    found = texture_cells(
        textures, np.full((len(textures.uv_T32), CHANNELS), 0.3, np.float32), cells_a_side
    )
    assert found is not None
    return found


def _whole(cells: TextureCells) -> NDArray[np.float64]:
    """Return what cells hold [K, 7, P, P]."""
    return (cells.mean_KC[..., None, None].double() + cells.apart_KCPP.double()).numpy()


@for_each("cells_a_side", [1, 4, 8, 32])
@for_each("size", [0.002, 0.03, 0.5])
def test_cells_of_a_ramp_are_its_analytic_means(cells_a_side: int, size: float) -> None:
    ramp = (np.arange(64) + 0.5) / 64
    texels = np.stack(np.broadcast_arrays(ramp, ramp[:, None], 0.25), axis=-1)
    uv = 0.25 + size * np.array([[[1.0, 0.1], [0.2, 0.9], [0.0, 0.0]]])
    found = _whole(_found(_textures(Texture(texels=texels.astype(np.float32)), uv), cells_a_side))
    for row in range(cells_a_side):
        for column in range(cells_a_side - row):
            on_rim = row + column == cells_a_side - 1
            into = 1 / 3 if on_rim else 1 / 2  # the centre of the half within, or of the cell
            first, second = (column + into) / cells_a_side, (row + into) / cells_a_side
            middle = first * uv[0, 0] + second * uv[0, 1] + (1 - first - second) * uv[0, 2]
            # Texels and coordinates are float32: 6e-8 of 0.75, a few times.
            assert np.abs(found[0, 0:2, row, column] - middle).max() < 3e-7
            assert np.abs(found[0, 2:7, row, column] - [0.25, 0.3, 0.3, 0.3, 0.3]).max() < 1e-7


def test_cells_beyond_the_longest_side_say_nothing() -> None:
    rng = np.random.default_rng(0)
    texture = Texture(texels=rng.uniform(size=(8, 8, 3)).astype(np.float32))
    apart = _found(_textures(texture, [[[1, 0], [0, 1], [0, 0]]]), 8).apart_KCPP[0]
    beyond = np.add.outer(np.arange(8), np.arange(8)) >= 8
    assert not apart[:, beyond].any() and apart[:3, ~beyond].all()


def test_the_mean_of_a_triangle_is_that_of_its_cells_by_area() -> None:
    rng = np.random.default_rng(1)
    texture = Texture(texels=rng.uniform(size=(16, 16, 3)).astype(np.float32))
    cells = _found(_textures(texture, [[[2.1, 0.3], [0.2, 1.5], [0, 0]]]), 8)
    apart = cells.apart_KCPP[0, :3].double().numpy()
    place = np.add.outer(np.arange(8), np.arange(8))
    area = np.where(place < 7, 1.0, np.where(place == 7, 0.5, 0.0))
    assert np.abs((apart * area).sum(axis=(1, 2)) / area.sum()).max() < 1e-7  # float32


@for_each(
    ("texels", "uv"),
    [
        (np.ones((1, 1, 3), np.float32), [[0, 0], [1, 0], [0, 1]]),
        (np.zeros((4, 4, 3), np.float32), [[0, 0], [1, 0], [0, 1]]),
    ],
)
def test_a_constant_texture_has_no_cells(texels: Cells, uv: list[list[float]]) -> None:
    textures = _textures(Texture(texels=texels), [uv])
    assert texture_cells(textures, np.ones((1, CHANNELS), np.float32), 4) is None


@for_each(
    "uv",
    [
        [[0.3, 0.3]] * 3,
        [[0.1, 0.1], [0.9, 0.9], [0.5, 0.5]],
        [[MAX_UV, -MAX_UV], [-MAX_UV, MAX_UV], [MAX_UV, MAX_UV]],
    ],
)
@for_each("sides", [(2, 1), (3, 5), (64, 64)])
def test_folded_and_far_coordinates_are_read(uv: list[list[float]], sides: tuple[int, int]) -> None:
    texels = np.random.default_rng(0).uniform(size=(*sides, 3)).astype(np.float32)
    cells = _found(_textures(Texture(texels=texels), [uv]), 8)
    values = _whole(cells)[0, :3]
    assert np.isfinite(values).all()
    assert values.min() >= 0 and values.max() <= 1


def _model(texture_cells: int, **changes: Any) -> RenderFormer:
    model = awake(tiny_config(texture_cells=texture_cells, **changes), torch.float32)
    if texture_cells:
        generator = torch.Generator().manual_seed(1)
        torch.nn.init.normal_(model.encoder.tokens.cells_WC, std=0.3, generator=generator)
    return model


def _tokens(model: RenderFormer, scene: SceneTensors) -> Tensor:
    """Return the tokens of a scene, before the first layer."""
    batch = batch_with_cells(batch_scenes([scene]), model.config.texture_cells)
    found = list[Tensor]()
    hook = model.encoder.tokens.register_forward_hook(lambda _, __, out: found.append(out))
    with torch.no_grad():
        model.encode(batch)
    hook.remove()
    return found[0][0]


def test_constant_triangles_keep_their_tokens_to_the_bit() -> None:
    scene = scene_tensors(textured())
    with_cells, without = (_tokens(_model(cells), scene) for cells in (4, 0))
    assert scene.textures is not None
    is_textured = torch.from_numpy(scene.textures.is_textured)
    assert torch.equal(with_cells[~is_textured], without[~is_textured])
    apart = (with_cells - without)[is_textured].abs().amax(dim=-1)
    assert (apart > 1e-3).all()


def test_a_network_begins_as_without_cells() -> None:
    """Nothing else is drawn for their sake, and at 0 they say only each triangle's own mean."""
    states = []
    for cells in (0, 8):
        model = RenderFormer(tiny_config(texture_cells=cells))
        model.initialise(torch.Generator().manual_seed(4))
        states.append(model.state_dict())
    assert not states[1].pop("encoder.tokens.cells_WC").any()
    for name, weight in states[0].items():
        assert torch.equal(weight, states[1][name]), name


def test_a_scene_without_textures_pays_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("cells were made")

    monkeypatch.setattr(model.scene_tensors, "texture_cells", refuse)
    plain = scene_tensors(corner())
    with_cells, without = (render(_model(cells), plain) for cells in (8, 0))
    assert torch.equal(with_cells, without)
    assert with_own_cells(plain, 8) is plain


def test_cells_made_ahead_are_those_that_the_network_makes() -> None:
    network = _model(4)
    scene = scene_tensors(textured())
    ahead = with_own_cells(scene, 4)
    assert ahead.cells is not None
    assert torch.equal(render(network, scene), render(network, ahead))
    # A scene in company is the same scene, to the rounding of other matrix products.
    fewer = dataclasses.replace(scene_tensors(corner()), textures=None)
    both = render(network, fewer, ahead)
    assert torch.allclose(both[1], render(network, ahead)[0], atol=1e-6)
    assert not torch.allclose(render(network, ahead), render(_model(0), scene), atol=1e-4)


def test_cells_go_with_the_vertices_and_the_channels() -> None:
    tensors = scene_tensors(textured())
    training = TrainingScene(
        key="",
        tensors=tensors,
        target_VRR3=torch.zeros(1, 4, 4, 3),
        noise_V=torch.zeros(1),
        light_T=torch.zeros(tensors.num_triangles, dtype=torch.int64),
    )
    before = with_own_cells(tensors, 4).cells
    order = np.array([2, 0, 1])
    permuted = with_own_cells(with_channels(training, order).tensors, 4).cells
    turn = np.full(tensors.num_triangles, 1)
    turned = with_own_cells(with_vertices_turned(training, turn).tensors, 4).cells
    assert before is not None and permuted is not None and turned is not None
    numbers = [*order, *(3 + order), 6]
    assert torch.equal(permuted.apart_KCPP, before.apart_KCPP[:, numbers])
    assert torch.equal(permuted.mean_KC, before.mean_KC[:, numbers])
    # The same triangle has other cells, as its vertices are named, and the same mean; places of
    # the lookups differ: of a map of independent texels 0.01.
    assert (turned.mean_KC - before.mean_KC).abs().max() < 0.02
    assert (turned.apart_KCPP - before.apart_KCPP).abs().max() > 0.05


def test_a_network_with_cells_goes_through_its_file() -> None:
    network = _model(4)
    again = decode_weights(encode_weights(network))
    assert again.config == network.config
    assert torch.equal(again.encoder.tokens.cells_WC, network.encoder.tokens.cells_WC)


def test_cells_learn() -> None:
    network = _model(4)
    network(batch_scenes([scene_tensors(textured())]), 32).square().sum().backward()
    gradient = network.encoder.tokens.cells_WC.grad
    assert gradient is not None and gradient.abs().max() > 0


@for_each(
    ("changes", "message"),
    [
        ({"texture_cells": 65}, "texture_cells is 65; expected a whole number from 0 to 64"),
        (
            {"texture_cells": 4, "material_columns": ("diffuse", "emission")},
            "texture_cells 4 without columns",
        ),
    ],
)
def test_a_contradictory_config_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        tiny_config(**changes)
