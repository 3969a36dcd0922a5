"""Open Image Denoise as we call it; converged highlights stay, and no picture loses light."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import variant_probe
from pipeline.renders.host_pictures import (
    Half,
    HostMeans,
    Pictures,
    estimate_error,
    keep_converged,
    keep_in_halves,
    with_mean_of,
)
from pipeline.renders.samples import DualBuffer, TileChoice
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import load_tracer
from pipeline.renders.view_pictures import LEAST_PASSES
from storage import denoiser
from storage.denoiser import Features, denoise, load_oidn, set_denoiser_device
from tests.pipeline.renders.sampling import camera_of, render_view
from tests.pipeline.renders.scene_kit import sampled_like_scene


def _noisy_step() -> tuple[NDArray[np.float32], NDArray[np.float32], Features]:
    rng = np.random.default_rng(0)
    clean = np.zeros((48, 48, 3), np.float32)
    clean[8:, :24], clean[8:, 24:] = 0.2, 3.0
    noisy = (clean * rng.gamma(4.0, 0.25, clean.shape)).astype(np.float32)
    normal = np.where(clean > 0, np.array([0, 0, 1], np.float32), np.float32(0))
    albedo = np.clip(clean, 0, 1).astype(np.float32)
    return clean, noisy, Features(albedo=albedo, normal=normal)


def test_noise_goes_edges_stay_and_what_has_no_light_stays_black() -> None:
    """The filter alone would paint what it sees of the albedo."""
    clean, noisy, features = _noisy_step()
    for quality in ("high", "fast"):
        picture = denoise(noisy, features, quality)
        assert np.abs(picture - clean).mean() < 0.25 * np.abs(noisy - clean).mean()
        np.testing.assert_array_equal(picture[:8], 0)
        np.testing.assert_array_equal(denoise(np.zeros_like(noisy), features, quality), 0)
    # a pixel is background only if neither features nor samples saw anything there
    nothing = Features(albedo=np.zeros_like(noisy), normal=np.zeros_like(noisy))
    assert (denoise(noisy, nothing, "high")[8:] > 0).all()


def test_threads_filter_at_the_same_time() -> None:
    """Each has its own memory: a shared one would mix their pictures."""
    _, noisy, features = _noisy_step()
    pictures = [noisy * np.float32(scale) for scale in (0.5, 1, 2, 4)] * 4
    expected = [denoise(each, features, "fast", 1) for each in pictures]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: denoise(each, features, "fast", 1), pictures))
    np.testing.assert_array_equal(found, expected)


class _Card:
    """Open Image Denoise on a machine with a card, which the processor stands for."""

    def __init__(self, supported: bool, error: str | None = None, brightens: float = 1.0) -> None:
        self._oidn = load_oidn()
        self.opened = list[int]()
        card = self

        class Device(self._oidn.Device):  # type: ignore[name-defined]
            def __init__(self, kind: int) -> None:
                card.opened.append(kind)
                self.is_card = kind == card._oidn.OIDN_DEVICE_TYPE_CUDA
                super().__init__(card._oidn.OIDN_DEVICE_TYPE_CPU)

            def set_int(self, name: str, value: int) -> None:
                assert not self.is_card, f"a card has no {name}"
                super().set_int(name, value)

            def set_bool(self, name: str, value: bool) -> None:
                assert not self.is_card, f"a card has no {name}"
                super().set_bool(name, value)

            def get_error(self) -> str | None:
                return error if self.is_card and error else super().get_error()

            @staticmethod
            def is_cuda_available(device_id: int = 0) -> bool:
                return supported

        class Filter(self._oidn.Filter):  # type: ignore[name-defined]
            def set_image(self, name: str, data: object, *rest: object, **named: object) -> None:
                assert isinstance(data, card._oidn.Buffer), "a card does not see numpy's memory"
                super().set_image(name, data, *rest, **named)

        class Buffer(self._oidn.Buffer):  # type: ignore[name-defined]
            def read(self, offset: int, size: int, picture: NDArray[np.float32]) -> None:
                super().read(offset, size, picture)
                # One half alone: the mean brightness of a picture is that of its samples anyway.
                picture[: len(picture) // 2] *= brightens if self._device.is_card else 1

        self.Device, self.Filter, self.Buffer = Device, Filter, Buffer

    def __getattr__(self, name: str) -> object:
        return getattr(self._oidn, name)


@pytest.fixture
def put_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[_Card], None]]:
    """Put a card in; afterwards it is out, and no filter of it is left."""

    def put(card: _Card) -> None:
        monkeypatch.setattr(denoiser, "load_oidn", lambda: card)
        denoiser._filter.cache_clear()

    yield put
    set_denoiser_device("CPU")
    denoiser._filter.cache_clear()


def test_the_card_is_used_where_it_is_chosen(put_in: Callable[[_Card], None]) -> None:
    _, noisy, features = _noisy_step()
    on_processor = denoise(noisy, features, "high")
    card = _Card(supported=True)
    put_in(card)
    set_denoiser_device("CUDA")
    np.testing.assert_array_equal(denoise(noisy, features, "high"), on_processor)
    assert card.opened == [load_oidn().OIDN_DEVICE_TYPE_CUDA]


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("card", "said"),
    [
        ({"supported": True}, ""),
        ({"supported": False}, "Open Image Denoise does not support the graphics card"),
        ({"supported": True, "error": "no memory"}, "Open Image Denoise: no memory (on CUDA)"),
        ({"supported": True, "brightens": np.nan}, "Open Image Denoise gives another picture"),
    ],
)
def test_a_card_that_cannot_denoise_is_not_used(
    card: dict[str, Any], said: str, put_in: Callable[[_Card], None]
) -> None:
    put_in(_Card(**card))
    problem = variant_probe.denoiser_problem()
    assert problem.startswith(said) and bool(problem) == bool(said)


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
    for name, (value, errors, kept) in PIXELS.items():
        raw = denoised.copy()
        raw[1, 2] = value
        standard_error = np.full((4, 4), abs(value - 1) / errors)
        (picture,) = keep_converged(denoised[None], raw[None], standard_error)
        np.testing.assert_array_equal(picture, raw if kept else denoised, err_msg=name)
    # a dark pixel beside one that is still noisy is not kept
    raw[1, 2] = 0.1
    standard_error = np.full((4, 4), 0.01)
    standard_error[2, 3] = 1.0  # a third of it, in the mean square of nine pixels, is 0.33
    (picture,) = keep_converged(denoised[None], raw[None], standard_error)
    np.testing.assert_array_equal(picture, denoised)


def test_the_mean_is_that_of_the_samples_and_glints_get_back_what_they_lost() -> None:
    """Unless their factor is far from 1: then one sample decided, and one factor is for all."""
    rng = np.random.default_rng(0)
    noise, black = rng.uniform(size=(8, 8, 3)).astype(np.float32), np.zeros((8, 8, 3), np.float32)
    np.testing.assert_array_equal(with_mean_of(black, black), 0)
    glint, more, most = (np.ones((8, 8, 3), np.float32) for _ in range(3))
    glint[2, 3], more[2, 3], most[2, 3] = 100, 130, 200
    np.testing.assert_allclose(with_mean_of(glint, more), more, rtol=1e-6)
    for denoised, raw in ((0.9 * noise, noise[::-1]), (glint, most)):
        scaled = with_mean_of(denoised, raw)
        assert scaled.mean(dtype=np.float64) == pytest.approx(raw.mean(dtype=np.float64), rel=1e-6)
        factors = scaled / denoised
        np.testing.assert_allclose(factors, factors[0, 0, 0], rtol=1e-6)


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
    return estimate_error(a, b, hits).log_db


def test_the_standard_error_is_that_between_passes() -> None:
    """The slow twin keeps every pass and takes the weighted variance of their mean."""
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    tracer, camera = load_tracer(scene, max_depth=4, rr_depth=2), camera_of(scene, 16)
    asked: list[tuple[int, int]] = []
    samples = DualBuffer([tracer], camera, 3, first_spp=32, max_spp=256)
    for (total,) in samples.sums:

        def remembered(*, seed: int, spp: int, add: Any = total.add, **rest: Any) -> None:
            asked.append((seed, spp))
            add(seed=seed, spp=spp, **rest)

        total.add = remembered  # type: ignore[method-assign]
    for _ in samples.passes_to(128):
        pass
    few = HostMeans(samples).standard_error()
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
    found = HostMeans(samples).standard_error()
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
        view = render_view(scene, settings, 7)
        raw = render_view(scene, dataclasses.replace(settings, denoiser="off"), 7)
    # Pictures of single lights are rounded to half floats, by up to 1 part in 2048 each.
    tolerance = 5e-4 if per_light else 1e-6
    assert view.radiance_rgb.mean(dtype=np.float64) == pytest.approx(
        raw.radiance_rgb.mean(dtype=np.float64), rel=tolerance
    )
