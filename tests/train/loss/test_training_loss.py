"""The objective: what it adds up, SSIM against scikit-image, and no stand-in for LPIPS.

LPIPS against loops in NumPy on small random weights; its laws; how its weights are found.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from torch import Tensor

from storage.conventions import preview_srgb8, srgb8
from storage.errors import TrilightError
from storage.seeds import rng_for
from tests.for_each import for_each
from train.loss.training_loss import (
    BLOCKS,
    LINEAR_FILE,
    LINEAR_URL,
    SCALE,
    SCALE_WEIGHTS,
    SHIFT,
    VGG16_FILE,
    VGG16_URL,
    Lpips,
    TrainingLoss,
    load_lpips,
    ms_ssim,
    ssim,
    tone_map,
)
from train.settings import LossSettings

WIDTHS = (4, 5, 6, 7, 8)
RESOLUTION = 16


def small_weights() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weights by their published names, but with few channels."""
    rng = rng_for(0, "vgg")
    vgg16, linear, before = {}, {}, 3
    for block, (numbers, width) in enumerate(zip(BLOCKS, WIDTHS, strict=True)):
        for number in numbers:
            weight = rng.normal(0, 0.4, (width, before, 3, 3))
            vgg16[f"features.{number}.weight"] = torch.from_numpy(weight).float()
            vgg16[f"features.{number}.bias"] = torch.from_numpy(rng.normal(0, 0.1, width)).float()
            before = width
        lin = rng.uniform(0, 1, (1, width, 1, 1))
        linear[f"lin{block}.model.1.weight"] = torch.from_numpy(lin).float()
    return vgg16, linear


def convolved(x: NDArray, weight: NDArray, bias: NDArray) -> NDArray:
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    out = np.zeros((len(weight), *x.shape[1:]))
    for row, column in itertools.product(range(3), range(3)):
        window = padded[:, row : row + x.shape[1], column : column + x.shape[2]]
        out += np.einsum("oc,chw->ohw", weight[:, :, row, column], window)
    return out + bias[:, None, None]


def by_hand(a: NDArray, b: NDArray, vgg16: dict, linear: dict) -> float:
    """Zhang et al. 2018, equation 1, for one pair [3, R, R] in [0, 1]."""
    total = 0.0
    grids = [
        (2 * picture - 1 - np.array(SHIFT)[:, None, None]) / np.array(SCALE)[:, None, None]
        for picture in (a, b)
    ]
    for block, numbers in enumerate(BLOCKS):
        if block:
            grids = [
                np.maximum.reduce([g[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]) for g in grids
            ]
        for number in numbers:
            weight, bias = (
                vgg16[f"features.{number}.{part}"].double().numpy() for part in ("weight", "bias")
            )
            grids = [np.maximum(convolved(grid, weight, bias), 0) for grid in grids]
        x, y = (g / np.maximum(np.sqrt((g**2).sum(0, keepdims=True)), 1e-10) for g in grids)
        lin = linear[f"lin{block}.model.1.weight"].double().numpy()[0]
        total += float((lin * (x - y) ** 2).sum(axis=0).mean())
    return total


def pictures(name: str, count: int = 2) -> Tensor:
    rng = rng_for(0, name)
    return torch.from_numpy(rng.random((count, 3, RESOLUTION, RESOLUTION))).float()


def test_the_distance_is_the_published_formula_symmetric_and_zero_for_equals() -> None:
    weights = small_weights()
    lpips = Lpips(*weights)
    a, b = pictures("a"), pictures("b")
    expected = [by_hand(x, y, *weights) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    # float32 against float64 through thirteen convolutions
    np.testing.assert_allclose(lpips(a, b).numpy(), expected, rtol=1e-5)
    assert min(expected) > 0.01
    assert torch.equal(lpips(a, a), torch.zeros(2))
    torch.testing.assert_close(lpips(a, b), lpips(b, a), rtol=0, atol=0)


def test_gradients_are_those_of_the_values_and_finite_without_any_feature() -> None:
    lpips = Lpips(*small_weights()).double()
    a, b = pictures("a", 1).double().requires_grad_(), pictures("b", 1).double()
    lpips(a, b).sum().backward()
    assert a.grad is not None
    step = 1e-6 * torch.from_numpy(rng_for(0, "step").normal(size=a.shape))
    with torch.no_grad():
        change = (lpips(a + step, b) - lpips(a - step, b)).item() / 2
    # central differences; a ReLU that a step of 1e-6 crosses costs about as much
    assert change == pytest.approx((a.grad * step).sum().item(), rel=1e-4)
    assert not any(weight.requires_grad for weight in lpips.parameters())
    vgg16, linear = small_weights()
    vgg16 = {name: -tensor.abs() for name, tensor in vgg16.items()}
    black = torch.full((1, 3, RESOLUTION, RESOLUTION), 0.9, requires_grad=True)
    Lpips(vgg16, linear)(black, pictures("b", 1)).sum().backward()
    assert black.grad is not None and torch.isfinite(black.grad).all()
    with pytest.raises(TrilightError, match="pictures of 8 pixels; expected at least 16"):
        Lpips(*small_weights())(*torch.zeros(2, 1, 3, 8, 8))


def test_weights_come_from_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    assert load_lpips(None) is None
    vgg16, linear = small_weights()
    with pytest.raises(TrilightError, match=f"{VGG16_FILE} does not exist"):
        load_lpips(str(tmp_path))
    torch.save(vgg16, tmp_path / VGG16_FILE)
    torch.save(linear, tmp_path / LINEAR_FILE)
    a, b = pictures("a"), pictures("b")
    expected = Lpips(vgg16, linear)(a, b)
    found = load_lpips(str(tmp_path))
    assert found is not None and torch.equal(found(a, b), expected)
    monkeypatch.setenv("TRILIGHT_LPIPS", str(tmp_path))
    found = load_lpips(None)
    assert found is not None and torch.equal(found(a, b), expected)


class _RunsCode:
    def __reduce__(self) -> tuple:
        return print, ("this ran",)


def test_a_file_that_is_none_is_refused_and_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    vgg16, linear = small_weights()
    torch.save(linear, tmp_path / LINEAR_FILE)
    for wrong, message in (
        ({"x": _RunsCode()}, "is not readable"),
        ([1, 2], "holds no state dict"),
        (linear, "no features.0.weight"),
        (vgg16 | {"features.5.weight": torch.zeros(5, 3, 3, 3)}, "features.5.weight has the shape"),
    ):
        torch.save(wrong, tmp_path / VGG16_FILE)
        with pytest.raises(TrilightError, match=message):
            load_lpips(str(tmp_path))
    assert "this ran" not in capsys.readouterr().out
    (tmp_path / VGG16_FILE).write_bytes(b"<html>")
    with pytest.raises(TrilightError, match="is not readable"):
        load_lpips(str(tmp_path))
    with pytest.raises(TrilightError, match="lin3.model.1.weight is missing"):
        Lpips(vgg16, {name: t for name, t in linear.items() if "3" not in name})


def log10_pictures(name: str) -> Tensor:
    rng = rng_for(0, name)
    return torch.from_numpy(rng.normal(0.2, 0.3, (2, 3, RESOLUTION, RESOLUTION, 3))).float()


def noisy_pair(resolution: int) -> tuple[Tensor, Tensor]:
    rng = rng_for(0, "pair", resolution)
    smooth = rng.random((2, 3, 4, 4)).repeat(resolution // 4, 2).repeat(resolution // 4, 3)
    noisy = np.clip(smooth + rng.normal(0, 0.15, smooth.shape), 0, 1)
    return torch.from_numpy(smooth), torch.from_numpy(noisy)


def test_the_tone_map_is_the_one_that_people_see() -> None:
    radiance = np.array([0.0, 0.01, 0.3, 0.9, 1.0, 40.0])
    mapped = tone_map(torch.from_numpy(np.log10(1 + radiance)))
    assert np.array_equal(srgb8(mapped.numpy()), preview_srgb8(radiance))
    assert tone_map(torch.tensor([-0.5])).item() == 0


@for_each("resolution", [12, 40])
def test_ssim_is_that_of_scikit_image(resolution: int) -> None:
    a, b = noisy_pair(resolution)
    for ours, x, y in zip(ssim(a, b).tolist(), a.numpy(), b.numpy(), strict=True):
        _, windows = structural_similarity(
            x, y, channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )  # fmt: skip
        theirs = windows[:, 5:-5, 5:-5].mean()
        assert ours == pytest.approx(theirs, rel=1e-9)  # float64 on both sides
        assert 0.1 < ours < 0.98


def structure_by_scipy(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004, equation 13 without luminance, of one pair [3, R, R]."""

    def blurred(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values, (0, 1.5, 1.5), radius=5)[:, 5:-5, 5:-5]

    covariance = blurred(x * y) - blurred(x) * blurred(y)
    variances = blurred(x * x) - blurred(x) ** 2 + blurred(y * y) - blurred(y) ** 2
    return float(((2 * covariance + 0.03**2) / (variances + 0.03**2)).mean())


def test_ms_ssim_multiplies_the_scales_and_has_a_gradient_even_at_its_opposite() -> None:
    """At 24 pixels there are two: structure at 24, all of SSIM at 12, each to its share."""
    a, b = noisy_pair(24)
    fine, coarse = (weight / sum(SCALE_WEIGHTS[:2]) for weight in SCALE_WEIGHTS[:2])
    whole = ssim(*(torch.nn.functional.avg_pool2d(x, 2) for x in (a, b)))
    for row, ours in enumerate(ms_ssim(a, b).tolist()):
        structure = structure_by_scipy(a[row].numpy(), b[row].numpy())
        expected = structure**fine * whole[row].item() ** coarse
        assert ours == pytest.approx(expected, rel=1e-9)  # float64 on both sides
        assert 0.1 < ours < 0.98
    torch.testing.assert_close(ms_ssim(a, a), torch.ones(2).double())
    a, _ = noisy_pair(64)
    opposite = (1 - a).requires_grad_()
    ms_ssim(opposite, a).sum().backward()
    assert opposite.grad is not None and torch.isfinite(opposite.grad).all()
    with pytest.raises(TrilightError, match="pictures of 8 pixels"):
        ms_ssim(a[..., :8, :8], a[..., :8, :8])


@for_each("term", ["lpips", "ms_ssim", "none"])
def test_the_loss_adds_up_its_terms(term: str) -> None:
    lpips = Lpips(*small_weights())
    settings = LossSettings(perceptual=term, perceptual_weight=0.05)  # type: ignore[arg-type]
    prediction, target = log10_pictures("p"), log10_pictures("t").abs()
    total, l1 = TrainingLoss(settings, lpips)(prediction, target, torch.zeros(2, 3))
    assert torch.equal(l1, (prediction - target).abs().mean(dim=(2, 3, 4)))
    for scene in range(2):
        for view in range(3):
            x, y = (tone_map(p[scene, view]).permute(2, 0, 1)[None] for p in (prediction, target))
            unlike = {"lpips": lpips(x, y), "ms_ssim": 1 - ms_ssim(x, y), "none": torch.zeros(1)}
            expected = l1[scene, view] + 0.05 * unlike[term].item()
            # float32: one view alone and six together are convolved in another order
            assert total[scene, view].item() == pytest.approx(expected.item(), rel=1e-5)


def test_a_view_as_noisy_as_the_setting_counts_half() -> None:
    settings = LossSettings(perceptual="none", noise_half=0.02)
    noise = torch.tensor([[0.0, 0.02, 0.06]]).expand(2, 3)
    prediction, target = log10_pictures("p"), log10_pictures("t")
    total, l1 = TrainingLoss(settings, None)(prediction, target, noise)
    shares = total / l1
    torch.testing.assert_close(shares, torch.tensor([[1.0, 0.5, 0.25]]).expand(2, 3))


def test_the_hub_has_both_files_and_the_large_one_is_checked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checked, there = {}, dict(zip((VGG16_URL, LINEAR_URL), small_weights(), strict=True))

    def download(url: str, *, check_hash: bool, **_: Any) -> dict[str, Tensor]:
        checked[url] = check_hash
        return there[url]

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", download)
    found, (a, b) = load_lpips("hub"), (pictures("a"), pictures("b"))
    assert found is not None
    assert torch.equal(found(a, b), Lpips(*small_weights())(a, b))
    assert checked == {VGG16_URL: True, LINEAR_URL: False}
