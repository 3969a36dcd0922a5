"""Open Image Denoise as we call it."""

import subprocess
import sys

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.denoiser import denoise, set_denoiser_threads
from pipeline.renders.tracer import Features
from tests.conftest import ROOT


def _noisy_step() -> tuple[NDArray[np.float32], NDArray[np.float32], Features]:
    rng = np.random.default_rng(0)
    clean = np.zeros((48, 48, 3), np.float32)
    clean[8:, :24], clean[8:, 24:] = 0.2, 3.0
    noisy = (clean * rng.gamma(4.0, 0.25, clean.shape)).astype(np.float32)
    normal = np.where(clean > 0, np.array([0, 0, 1], np.float32), np.float32(0))
    albedo = np.clip(clean, 0, 1).astype(np.float32)
    return clean, noisy, Features(albedo=albedo, normal=normal)


def test_noise_goes_and_edges_stay() -> None:
    clean, noisy, features = _noisy_step()
    for quality in ("high", "fast"):
        picture = denoise(noisy, features, quality)
        assert np.abs(picture - clean).mean() < 0.25 * np.abs(noisy - clean).mean()


def test_the_background_is_exactly_black() -> None:
    _, noisy, features = _noisy_step()
    np.testing.assert_array_equal(denoise(noisy, features, "high")[:8], 0)


def test_light_without_auxiliary_pictures_is_kept() -> None:
    """A pixel is background only if neither features nor samples saw anything there."""
    _, noisy, _ = _noisy_step()
    nothing = Features(albedo=np.zeros_like(noisy), normal=np.zeros_like(noisy))
    assert (denoise(noisy, nothing, "high")[8:] > 0).all()


def test_threads_change_no_bit() -> None:
    _, noisy, features = _noisy_step()
    pictures = []
    for threads in (1, 2):
        set_denoiser_threads(threads)
        pictures.append(denoise(noisy, features, "high"))
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_the_denoiser_brings_no_torch() -> None:
    code = (
        "import sys; from pipeline.renders.denoiser import load_oidn; load_oidn(); "
        "print('torch' in sys.modules)"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert child.stdout.strip() == "False"


def test_a_picture_without_light_stays_black() -> None:
    """The filter alone would paint what it sees of the albedo."""
    _, noisy, features = _noisy_step()
    for quality in ("high", "fast"):
        np.testing.assert_array_equal(denoise(np.zeros_like(noisy), features, quality), 0)
