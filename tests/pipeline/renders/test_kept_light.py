"""Converged highlights stay, and no picture is darker than its samples."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.kept_light import (
    LEAST_PASSES,
    Pictures,
    keep_converged,
    keep_in_halves,
    with_mean_of,
)
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.noise_floor import Half, measure_floor
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.samples import HalfSamples
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tiles import TileChoice
from pipeline.renders.tracer import Chosen
from storage.records.scene import Scene
from tests.pipeline.renders.scene_kit import sampled_like_scene

PIXELS = {
    "glint": (2.0, 4.1, True),
    "noise": (2.0, 3.9, False),
    "hardly brighter": (1.4, 8.0, False),
    "dark": (0.2, 4.1, True),
    "dark noise": (0.2, 3.9, False),
    "hardly darker": (0.3, 8.0, False),
}
"""Its value beside 1, how many of its own errors that is off, and whether it is kept."""


def test_a_pixel_is_kept_where_it_stands_out_by_its_own_error() -> None:
    denoised = np.ones((4, 4, 3), np.float32)
    for name, (raw, errors, kept) in PIXELS.items():
        noisy = denoised.copy()
        noisy[1, 2] = raw
        standard_error = np.full((4, 4), abs(raw - 1) / errors)
        (picture,) = keep_converged(denoised[None], noisy[None], standard_error)
        np.testing.assert_array_equal(picture, noisy if kept else denoised, err_msg=name)


def test_a_dark_pixel_beside_one_that_is_still_noisy_is_not_kept() -> None:
    denoised = np.ones((4, 4, 3), np.float32)
    raw = denoised.copy()
    raw[1, 2] = 0.1
    standard_error = np.full((4, 4), 0.01)
    np.testing.assert_array_equal(keep_converged(denoised[None], raw[None], standard_error)[0], raw)
    standard_error[2, 3] = 1.0  # a third of it, in the mean square of nine pixels, is 0.33
    np.testing.assert_array_equal(
        keep_converged(denoised[None], raw[None], standard_error)[0], denoised
    )


def test_the_mean_is_that_of_the_samples() -> None:
    rng = np.random.default_rng(0)
    raw, denoised = rng.uniform(size=(2, 8, 8, 3)).astype(np.float32)
    denoised *= 0.9
    scaled = with_mean_of(denoised, raw)
    assert scaled.mean(dtype=np.float64) == pytest.approx(raw.mean(dtype=np.float64), rel=1e-6)
    np.testing.assert_allclose(scaled / denoised, scaled[0, 0, 0] / denoised[0, 0, 0], rtol=1e-6)
    black = np.zeros_like(raw)
    np.testing.assert_array_equal(with_mean_of(black, black), 0)


def test_what_glints_have_lost_goes_back_to_them() -> None:
    """Unless their factor is far from 1: then one sample decided, and one factor is for all."""
    denoised = np.ones((8, 8, 3), np.float32)
    denoised[2, 3] = 100
    raw = denoised.copy()
    raw[2, 3] = 130
    np.testing.assert_allclose(with_mean_of(denoised, raw), raw, rtol=1e-6)
    raw[2, 3] = 200
    scaled = with_mean_of(denoised, raw)
    assert scaled.mean(dtype=np.float64) == pytest.approx(raw.mean(dtype=np.float64), rel=1e-6)
    np.testing.assert_allclose(scaled / denoised, scaled[0, 0, 0], rtol=1e-6)


def test_the_floor_of_a_kept_glint_is_its_noise() -> None:
    """The denoiser takes a glint of 50 away, and the picture keeps it: 0.1 of noise are left."""
    rng = np.random.default_rng(3)
    truth = np.ones((32, 32, 3), np.float32)
    denoised = truth.copy()
    truth[5, 9] = 50
    noise = np.where(truth > 1, rng.normal(0, 0.1, (2, *truth.shape)), 0).astype(np.float32)
    halves = [((truth + of_half)[None], denoised[None]) for of_half in noise]
    hits = np.ones((32, 32), bool)
    lost = _floor_db(halves, hits)
    kept = _floor_db(keep_in_halves(halves, np.full((32, 32), 0.05)), hits)
    # log10(51 / 2) in one of 1024 pixels, counted as error, surprise and standard error: 3 dB each.
    assert lost < 27.2
    # What is left, 0.1 / sqrt(2) of 51 and 2, is some 40 dB lower.
    assert kept > 55


def _floor_db(halves: Sequence[tuple[Pictures, Pictures]], hits: NDArray[np.bool_]) -> float:
    a, b = (Half(raw_rgb=raw[0], denoised_rgb=denoised[0]) for raw, denoised in halves)
    return measure_floor(a, b, hits).log_db


def test_the_standard_error_is_that_between_passes() -> None:
    """The slow twin keeps every pass and takes the weighted variance of their mean."""
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    tracer = load_tracer(scene, max_depth=4, rr_depth=2)
    camera = Camera(
        c2w=np.asarray(scene.c2w[0], np.float64), fov_deg=float(scene.fov_deg[0]), resolution=16
    )
    asked: list[tuple[int, int]] = []
    samples = HalfSamples([tracer], camera, 3, first_spp=32, max_spp=256)
    add = type(samples._sums[0][0]).add

    def remembered(part: object, *, seed: int, spp: int, chosen: Chosen = None) -> None:
        asked.append((seed, spp))
        add(part, seed=seed, spp=spp, chosen=chosen)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(samples._sums[0][0]), "add", remembered)
        for _ in samples.passes_to(128):
            pass
        few = samples.standard_error()
        assert few is not None and np.isinf(few).all(), "8 passes are too few"
        for _ in samples.passes_to(256):
            pass
    assert len(asked) == LEAST_PASSES
    greys = np.stack(
        [tracer.radiance(camera, seed=seed, spp=spp).mean(axis=-1) for seed, spp in asked]
    ).astype(np.float64)
    weights = np.array([spp for _, spp in asked], np.float64)
    mean = np.tensordot(weights / weights.sum(), greys, 1)
    variance = np.tensordot(weights, np.square(greys - mean), 1) / (len(asked) - 1) / weights.sum()
    found = samples.standard_error()
    assert found is not None
    # Differences of sums lose 7 of 16 digits: 1e-4 of the pixel's value is far below its noise.
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-3, atol=1e-4 * mean.max())


@pytest.mark.parametrize(("max_spp", "per_light"), [(32, False), (256, True)])
def test_a_view_is_as_bright_as_its_samples_at_every_cap(max_spp: int, per_light: bool) -> None:
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    settings = RenderSettings(
        resolution=16, noise_floor_db=80.0, min_spp=32, max_spp=max_spp, per_light=per_light
    )
    # Tiles are chosen by denoised pictures: without the denoiser others would get more samples.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TileChoice, "passes", lambda self, samples, mean_spp: None)
        view = _view(scene, settings)
        raw = _view(scene, dataclasses.replace(settings, denoiser="off"))
    # Pictures of single lights are rounded to half floats, by up to 1 part in 2048 each.
    tolerance = 5e-4 if per_light else 1e-6
    assert view.radiance_rgb.mean(dtype=np.float64) == pytest.approx(
        raw.radiance_rgb.mean(dtype=np.float64), rel=tolerance
    )


def _view(scene: Scene, settings: RenderSettings) -> RenderedView:
    return SceneRenderer(scene, settings).render_view(scene.c2w[0], float(scene.fov_deg[0]), 7)
