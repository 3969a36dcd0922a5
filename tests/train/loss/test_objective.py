"""The objective: what it adds up, SSIM against scikit-image, and no stand-in for LPIPS."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from torch import Tensor

from storage.conventions import preview_srgb8, srgb8
from storage.errors import TrilightError
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.train.loss.test_lpips import small_weights
from train.loss.lpips import Lpips
from train.loss.ms_ssim import SCALE_WEIGHTS, ms_ssim, ssim
from train.loss.objective import Objective, tone_mapped
from train.settings import LossSettings


def log10_pictures(name: str, resolution: int = 16) -> Tensor:
    rng = rng_for(0, name)
    return torch.from_numpy(rng.normal(0.2, 0.3, (2, 3, resolution, resolution, 3))).float()


def noisy_pair(resolution: int) -> tuple[Tensor, Tensor]:
    rng = rng_for(0, "pair", resolution)
    smooth = rng.random((2, 3, 4, 4)).repeat(resolution // 4, 2).repeat(resolution // 4, 3)
    noisy = np.clip(smooth + rng.normal(0, 0.15, smooth.shape), 0, 1)
    return torch.from_numpy(smooth), torch.from_numpy(noisy)


def test_the_tone_map_is_the_one_that_people_see() -> None:
    radiance = np.array([0.0, 0.01, 0.3, 0.9, 1.0, 40.0])
    mapped = tone_mapped(torch.from_numpy(np.log10(1 + radiance)))
    assert np.array_equal(srgb8(mapped.numpy()), preview_srgb8(radiance))
    assert tone_mapped(torch.tensor([-0.5])).item() == 0


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


def test_ms_ssim_multiplies_the_scales() -> None:
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


def test_ms_ssim_has_a_finite_gradient_even_at_its_opposite() -> None:
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
    losses = Objective(settings, lpips)(prediction, target, torch.zeros(2, 3))
    assert torch.equal(losses.l1_BV, (prediction - target).abs().mean(dim=(2, 3, 4)))
    for scene in range(2):
        for view in range(3):
            x, y = (
                tone_mapped(p[scene, view]).permute(2, 0, 1)[None] for p in (prediction, target)
            )
            unlike = {"lpips": lpips(x, y), "ms_ssim": 1 - ms_ssim(x, y), "none": torch.zeros(1)}
            expected = losses.l1_BV[scene, view] + 0.05 * unlike[term].item()
            # float32: one view alone and six together are convolved in another order
            assert losses.total_BV[scene, view].item() == pytest.approx(expected.item(), rel=1e-5)


def test_a_view_as_noisy_as_the_setting_counts_half() -> None:
    settings = LossSettings(perceptual="none", noise_half=0.02)
    noise = torch.tensor([[0.0, 0.02, 0.06]]).expand(2, 3)
    prediction, target = log10_pictures("p"), log10_pictures("t")
    losses = Objective(settings, None)(prediction, target, noise)
    shares = losses.total_BV / losses.l1_BV
    torch.testing.assert_close(shares, torch.tensor([[1.0, 0.5, 0.25]]).expand(2, 3))


def test_nothing_takes_the_place_of_lpips_by_itself() -> None:
    with pytest.raises(TrilightError, match=r"--lpips FOLDER .* --set loss.perceptual=ms_ssim"):
        Objective(LossSettings(perceptual="lpips"), None)
    for wrong in ({"perceptual": "vgg"}, {"perceptual_weight": -1.0}, {"noise_half": float("nan")}):
        with pytest.raises(TrilightError, match=f"{next(iter(wrong))} is"):
            LossSettings(**({"perceptual": "none"} | wrong))
