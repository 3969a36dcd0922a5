"""The network that is told hits: what it passes on, what it reads, what it can do without."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.hits import decoder
from model.hits.decoder import _around, _in_parts, _whole
from model.hits.traced import INPUTS
from model.hits.tracing import with_traced
from model.hits.view_inputs import Channel
from model.neural_renderer import NeuralRenderer
from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneBatch, SceneTensors, batch_scenes, scene_tensors
from model.weights import decode_weights, encode_weights
from storage.errors import TrilightError
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import corner, traced
from tests.model.kit import awake, tiny_config

PX = 32


def hits_config(**changes: Any) -> ModelConfig:
    config = tiny_config(
        encoder_layers=1,
        view_stage="hits",
        hit_rays=2,
        hit_anchors=8,
        gather_rays=16,
        pixel_width=16,
        filter_width=8,
    )
    return dataclasses.replace(config, **changes)


def network(**changes: Any) -> RenderFormer:
    """Return a network none of whose parts is zero: it stands for a trained one."""
    return awake(hits_config(**changes), torch.float32)


def tensors(scene: Scene, config: ModelConfig | None = None) -> SceneTensors:
    return with_traced(scene_tensors(scene), PX, config or hits_config(), 0)


def in_double(batch: SceneBatch) -> SceneBatch:
    def real(value: object) -> bool:
        return isinstance(value, Tensor) and value.is_floating_point()

    whole = {name: value.double() for name, value in vars(batch).items() if real(value)}
    assert batch.traced is not None
    traced = batch.traced.convert_tensors(lambda x: x.double() if real(x) else x)
    return dataclasses.replace(batch, **whole, traced=traced)


@torch.no_grad()
def picture(model: RenderFormer, *scenes: SceneTensors) -> Tensor:
    shown: Tensor = model(batch_scenes(scenes), PX)
    return shown


def test_parts_of_a_picture_come_together_again() -> None:
    values = torch.arange(2 * 24 * 24 * 3.0).reshape(2, 24, 24, 3)
    parts = _in_parts(values, 4)
    assert parts.shape == (2, 16, 36, 3)
    assert torch.equal(parts[1, 5], values[1, 6:12, 6:12].reshape(36, 3))
    assert torch.equal(_whole(parts, 4), values)


def test_anchors_around_a_part_are_those_beside_it() -> None:
    numbers = torch.arange(16.0).reshape(1, 16, 1)
    around = _around(numbers, 4)[0, ..., 0]
    assert around[5].tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10]
    assert around[0].tolist() == [0, 0, 1, 0, 0, 1, 4, 4, 5], "at the rim the nearest stand again"


def test_all_views_at_once_are_the_views_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """While learning on a card; pictures and gradients, in double precision.

    What a bias of keys is told is zero but for rounding, hence a least scale for all.
    """
    model, batch = network().double(), in_double(batch_scenes([tensors(corner())] * 2))
    results = []
    for _ in range(2):
        model.zero_grad()
        shown = model(batch, PX)
        shown.square().sum().backward()
        grads = [weight.grad for weight in model.parameters() if weight.grad is not None]
        results.append([shown.detach(), *(grad.clone() for grad in grads)])
        monkeypatch.setattr(decoder, "_blocks", lambda *_: [slice(None)])
    least = 1e-6 * max(float(grad.abs().max()) for grad in results[0][1:])
    assert least > 0
    for one_by_one, at_once in zip(*results, strict=True):
        scale = max(least, float(one_by_one.abs().max()))
        assert float((at_once - one_by_one).abs().max()) <= 1e-12 * scale  # thousands of roundings


def test_before_any_training_what_was_traced_is_passed_on() -> None:
    """Every gain is 1 and what is learned is a twentieth of the scene's mean light."""
    model = RenderFormer(hits_config(filter_width=0))
    model.initialize(torch.Generator().manual_seed(0))
    scene = corner()
    inputs = traced(scene, PX)
    shown = radiance(picture(model, tensors(scene))[0, 0]).numpy()
    known = inputs.pixels[..., Channel.SHOWN_DIFFUSE] + inputs.pixels[..., Channel.DIRECT_SPECULAR]
    known = known + inputs.pixels[..., Channel.MIRRORED]
    assert (shown >= known * (1 - 1e-4) - 1e-5).all()
    assert (shown - known).mean() < 0.5 * known.mean()
    assert not shown[inputs.pixels[..., 0] == 0].any(), "nothing is met: black"


@for_each("tokens", [True, False])
def test_the_picture_scales_with_the_lamps(tokens: bool) -> None:
    scene = corner()
    materials = scene.materials.copy()
    materials[:, EMISSION] *= np.array([8.0, 4.0, 2.0], np.float32)
    brighter = dataclasses.replace(scene, materials=materials)
    model = network(scene_tokens=tokens)
    one, other = (radiance(picture(model, tensors(each))[0, 0]) for each in (scene, brighter))
    # colours change the odds with which lamps are drawn; one lamp leaves nothing to draw
    torch.testing.assert_close(other, one * torch.tensor([8.0, 4.0, 2.0]), rtol=2e-3, atol=1e-4)


def test_pictures_of_a_batch_are_those_of_the_scenes_alone() -> None:
    small = corner()
    kept = scene_tensors(small)
    fewer = dataclasses.replace(
        kept,
        triangles_T33=kept.triangles_T33[4:],
        normals_T33=kept.normals_T33[4:],
        material_TM=kept.material_TM[4:],
    )
    scenes = [tensors(small), with_traced(fewer, PX, hits_config(), 0)]
    model = network()
    together = picture(model, *scenes)
    for index, scene in enumerate(scenes):
        torch.testing.assert_close(together[index], picture(model, scene)[0], rtol=1e-3, atol=1e-5)


def test_what_comes_traced_is_what_the_network_traces_itself() -> None:
    scene, model = corner(), network()
    plain = scene_tensors(scene)
    assert torch.equal(picture(model, plain), picture(model, tensors(scene)))
    renderer = NeuralRenderer(model)
    shown = renderer.render(scene, PX)[0]
    expected = radiance(picture(model, plain)[0, 0]).numpy()
    np.testing.assert_allclose(shown, expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(TrilightError, match="multiple of 8"):
        renderer.render(scene, 30)


def test_each_input_is_read_and_can_be_withheld() -> None:
    model, scene = network(), tensors(corner())
    whole = picture(model, scene)
    assert scene.traced is not None
    for index, name in enumerate(INPUTS):
        kept = torch.ones(1, len(INPUTS))
        kept[0, index] = 0
        without = dataclasses.replace(scene, traced=scene.traced.without(kept))
        shown = picture(model, without)
        assert torch.isfinite(shown).all()
        assert (shown - whole).abs().max() > 1e-4, name


@for_each("tokens", [True, False])
def test_every_weight_has_a_gradient_and_comes_back_from_its_file(tokens: bool) -> None:
    model = network(scene_tokens=tokens)
    assert tokens == any(name.startswith("encoder") for name, _ in model.named_parameters())
    model(batch_scenes([tensors(corner())]), PX).square().sum().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name
    again = decode_weights(encode_weights(model))
    assert again.config == model.config
    assert any(isinstance(each, nn.RMSNorm) for each in again.decoder.modules()), "for training"
    scene = tensors(corner())
    shown = picture(again, scene)
    assert torch.equal(shown, picture(model.eval(), scene)) and torch.isfinite(shown).all()


def test_gradients_are_those_of_differences() -> None:
    """In double precision, for some weights of every part."""
    model = network().double()
    scenes = in_double(batch_scenes([tensors(corner())]))

    def value() -> Tensor:
        total: Tensor = model(scenes, PX).square().sum()
        return total

    model.zero_grad()
    value().backward()
    for weight in (model.decoder.head.last.weight, model.decoder.told.weight,
                   model.encoder.tokens.light.weight, model.decoder.head.nearness):  # fmt: skip
        flat, grad = weight.data.view(-1), weight.grad.view(-1)
        at = int(grad.abs().argmax())
        step = 1e-5
        flat[at] += step
        with torch.no_grad():
            above = value()
        flat[at] -= 2 * step
        with torch.no_grad():
            below = value()
        flat[at] += step
        # central differences: the error falls with the square of the step
        assert float((above - below) / (2 * step)) == pytest.approx(float(grad[at]), rel=1e-4)


@for_each(
    ("changes", "message"),
    [
        ({"hit_rays": 0}, "hit_rays 0 with view_stage hits"),
        ({"pixel_width": 0}, "pixel_width 0"),
        ({"hit_anchors": 12}, "a multiple of 8"),
        ({"patch_px": 4}, "patch_px 4"),
        ({"view_stage": "bundles"}, "fields of hits beside view_stage bundles"),
    ],
)
def test_settings_that_go_not_together_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        hits_config(**changes)


def test_it_takes_bfloat16_for_what_is_rounded() -> None:
    from model.precision import set_precision

    scene = tensors(corner())
    exact = picture(network(), scene)
    rounded = picture(set_precision(network(), "bfloat16"), scene)
    assert rounded.dtype == torch.float32
    # 8 bits of mantissa in anchors alone, whose numbers gain at most twice what was traced
    assert (rounded - exact).abs().mean() < 0.03 * exact.abs().mean()
