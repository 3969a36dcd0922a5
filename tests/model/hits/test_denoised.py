"""Denoised light: less noise, the same surfaces and units, and only in wide pictures."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from model.hits.traced import Traced, denoise_traced
from model.hits.tracing import with_traced
from model.hits.view_inputs import Channel
from model.inference import NeuralRenderer
from model.renderformer import radiance
from model.scene_tensors import batch_scenes, scene_tensors
from storage.metrics import pepper
from tests.model.hits.kit import corner, traced
from tests.model.kit import awake, hits_config

PX = 64
UNIT = torch.tensor([0.5, 1.0, 2.0])
LIGHTS = (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED)


def _traced(**changes: int) -> Tensor:
    return torch.from_numpy(traced(corner(), PX, **changes).pixels[None])


def _denoise(pixels_VRRC: Tensor, unit_3: Tensor) -> Tensor:
    empty = torch.zeros(0)
    views = Traced(empty, unit_3, pixels_VRRC, empty, empty, empty)
    return denoise_traced(views, hits_config(denoise_from_px=PX)).pixels_VRRC


def _light(pixels: Tensor) -> Tensor:
    return sum((pixels[0, ..., channel] for channel in LIGHTS), torch.zeros(PX, PX, 3))


def test_noise_goes_and_light_and_surfaces_stay() -> None:
    noisy = _traced()
    clean = _denoise(noisy, UNIT)
    truth = torch.stack([_traced(seed=seed) for seed in range(1, 17)]).mean(dim=0)
    assert pepper(_light(clean), _light(truth)) < 0.5 * pepper(_light(noisy), _light(truth))
    torch.testing.assert_close(_light(clean).mean(), _light(noisy).mean(), rtol=0.05, atol=0)
    kept = torch.ones(noisy.shape[-1], dtype=torch.bool)
    for channel in LIGHTS:
        kept[channel] = False
    assert torch.equal(clean[..., kept], noisy[..., kept])
    nothing = noisy[0, ..., 0] == 0
    assert nothing.any() and not _light(clean)[nothing].any(), "nothing is met: black"


def test_it_scales_with_the_lamps_and_is_the_same_in_every_thread() -> None:
    noisy = _traced()
    brighter = noisy.clone()
    scale = torch.tensor([8.0, 4.0, 2.0])
    for channel in LIGHTS:
        brighter[..., channel] *= scale
    with ThreadPoolExecutor(2) as pool:
        one, other = pool.map(_denoise, (noisy, brighter), (UNIT, UNIT * scale))
    assert torch.equal(_light(other), _light(one) * scale)


def test_wide_pictures_are_denoised_wherever_their_light_is_traced() -> None:
    scene, config = corner(), hits_config(denoise_from_px=PX)
    tensors = scene_tensors(scene)
    inputs = {
        (px, which.denoise_from_px): with_traced(tensors, px, which).traced
        for px in (PX, PX // 2)
        for which in (hits_config(), config)
    }
    small, plain, wide = (inputs[key] for key in ((PX // 2, PX), (PX, 0), (PX, PX)))
    assert small is not None and plain is not None and wide is not None
    below = inputs[PX // 2, 0]
    assert below is not None and torch.equal(small.pixels_VRRC, below.pixels_VRRC)
    expected = _denoise(plain.pixels_VRRC, plain.unit_3)
    assert torch.equal(wide.pixels_VRRC, expected)
    model = awake(config, torch.float32)
    with torch.no_grad():
        trained = radiance(model(batch_scenes([with_traced(tensors, PX, config)]), PX)[0, 0])
    shown = NeuralRenderer(model).render(scene, PX)[0]
    np.testing.assert_allclose(shown, trained.numpy(), rtol=1e-4, atol=1e-6)
