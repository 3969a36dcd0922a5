"""Open Image Denoise as we call it, and the statement by six measures."""

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import calibrated_error, variant_probe
from pipeline.renders.calibrated_error import (
    MEASURES,
    METRICS,
    CalibratedStatement,
    MetricStatement,
    first_spp,
    load_statement,
    measures_of_totals,
    versions_of_pictures,
)
from pipeline.renders.noise_floor import ErrorMeasures
from pipeline.renders.pictures import (
    NUMPY,
    converged_mask,
    error_measures,
    keep,
    keep_in_halves,
    read_sums,
    squared_error,
)
from pipeline.renders.samples import DualBuffer, TileChoice
from pipeline.renders.settings import Arithmetic
from pipeline.renders.tracer import load_tracer
from pipeline.renders.view_pictures import LEAST_PASSES, with_mean_of
from storage import denoiser
from storage.denoiser import Features, denoise, load_oidn, set_denoiser_device
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.renders.sampling import (
    Half,
    camera_of,
    floor_of,
    halves_of,
    render_view,
    view_settings,
)
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.pipeline.renders.test_renderer import lit_scene


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


def test_threads_filter_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has its own memory: a shared one would mix their pictures."""
    monkeypatch.setattr("storage.denoiser._threads", 1)
    _, noisy, features = _noisy_step()
    pictures = [noisy * np.float32(scale) for scale in (0.5, 1, 2, 4)] * 4
    expected = [denoise(each, features, "fast") for each in pictures]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda each: denoise(each, features, "fast"), pictures))
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
        picture = _kept(denoised, raw, standard_error)
        np.testing.assert_array_equal(picture, raw if kept else denoised, err_msg=name)
    # a dark pixel beside one that is still noisy is not kept
    raw[1, 2] = 0.1
    standard_error = np.full((4, 4), 0.01)
    standard_error[2, 3] = 1.0  # a third of it, in the mean square of nine pixels, is 0.33
    np.testing.assert_array_equal(_kept(denoised, raw, standard_error), denoised)


def _kept(denoised: NDArray, raw: NDArray, standard_error: NDArray) -> NDArray:
    mask = converged_mask([denoised], [raw], standard_error**2, NUMPY)
    return np.asarray(keep(mask, [raw], [denoised], NUMPY)[0])


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
    raws = [[truth + of_half] for of_half in noise]
    filtered = [[denoised], [denoised]]
    lost = _floor_db(raws, filtered)
    kept = _floor_db(raws, keep_in_halves(raws, filtered, np.full((32, 32), 0.05**2), NUMPY))
    # log10(51 / 2) in one of 1024 pixels, counted as error, surprise and standard error: 3 dB each.
    assert lost < 27.2
    # What is left, 0.1 / sqrt(2) of 51 and 2, is some 40 dB lower.
    assert kept > 55


def _floor_db(raws: Sequence[Sequence[NDArray]], denoised: Sequence[Sequence[NDArray]]) -> float:
    a, b = (Half(*raw, *each) for raw, each in zip(raws, denoised, strict=True))
    return floor_of(a, b, np.ones((32, 32), bool)).noise_floor_db


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
    few = squared_error(read_sums(samples), NUMPY)
    assert np.isinf(few).all(), "8 passes are too few"
    for _ in samples.passes_to(256):
        pass
    assert len(asked) == LEAST_PASSES
    pictures = [tracer.radiance(camera, seed=seed, spp=spp) for seed, spp in asked]
    greys = np.stack([picture.mean(axis=-1) for picture in pictures]).astype(np.float64)
    weights = np.array([spp for _, spp in asked], np.float64)
    mean = np.tensordot(weights / weights.sum(), greys, 1)
    variance = np.tensordot(weights, np.square(greys - mean), 1) / (len(asked) - 1) / weights.sum()
    found = np.sqrt(squared_error(read_sums(samples), NUMPY))
    # Differences of sums lose 7 of 16 digits: 1e-4 of the pixel's value is far below its noise.
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-3, atol=1e-4 * mean.max())


@pytest.mark.parametrize(("max_spp", "per_light"), [(32, False), (256, True)])
def test_a_view_is_as_bright_as_its_samples_at_every_cap(max_spp: int, per_light: bool) -> None:
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    settings = view_settings(32, resolution=16, max_spp=max_spp, per_light=per_light)
    # Tiles are chosen by denoised pictures: without the denoiser others would get more samples.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TileChoice, "passes", lambda self, samples, mean_spp: None)
        view = render_view(scene, settings, 7)
        raw = render_view(scene, dataclasses.replace(settings, denoiser="off"), 7)
    shown, sampled = (each.radiance_rgb.mean(dtype=np.float64) for each in (view, raw))
    # Pictures of single lights are rounded to half floats, by up to 1 part in 2048 each.
    assert shown == pytest.approx(sampled, rel=5e-4 if per_light else 1e-6)


WEIGHTS = dict.fromkeys((*MEASURES, "hits", "samples", "width"), 0.2)
METRIC = MetricStatement(
    intercept=1.0,
    weights=WEIGHTS,
    bound={"narrow": -3.0, "medium": -2.5, "wide": -2.0},
    expected={"narrow": 0.5, "medium": 0.4, "wide": 0.25},
    judged={},
)
STATEMENT = CalibratedStatement(
    rows="rows.jsonl",
    rows_sha256="0" * 64,
    layouts=1,
    versions=versions_of_pictures(),
    spp=(32, 256),
    widths=(32, 256),
    metrics=dict.fromkeys(METRICS, METRIC),
)
SETTINGS = view_settings(32, max_spp=256, min_mean_radiance=0.0, stated_error="calibrated")


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, ErrorMeasures]]:
    """Measures of every look that is stated, by metric."""
    found: list[dict[str, ErrorMeasures]] = []
    state = CalibratedStatement.state

    def noted(self: CalibratedStatement, measures: dict[str, ErrorMeasures], *rest: int) -> object:
        found.append(measures)
        return state(self, measures, *rest)

    monkeypatch.setattr(CalibratedStatement, "state", noted)
    monkeypatch.setattr(calibrated_error, "load_statement", lambda: STATEMENT)
    return found


@pytest.mark.usefixtures("llvm")
def test_the_device_measures_what_numpy_measures(
    measured: list[dict[str, ErrorMeasures]],
) -> None:
    views = [
        render_view(lit_scene(), dataclasses.replace(SETTINGS, arithmetic=arithmetic), 3)
        for arithmetic in ("numpy", "device")
    ]
    half = len(measured) // 2
    assert half > 1
    first = dataclasses.astuple(measured[0]["log"])
    expected = 2.05e-6, 3.77e-7, 1.49e-6, 3.46e-7, 3.98e-8, 0.0467, 0.645
    # other processors trace other samples; another picture is a new calibration
    np.testing.assert_allclose(first, expected, rtol=0.3, err_msg="raise calibrated_error._CODE")
    for numpys, ours in zip(measured[:half], measured[half:], strict=True):
        for metric in METRICS:
            oracle, found = (dataclasses.astuple(each[metric]) for each in (numpys, ours))
            assert min(oracle[:4]) > 0
            np.testing.assert_allclose(found, oracle, rtol=1e-3, err_msg=metric)
    for one in views:
        assert one.expected_error is not None
        apart = one.expected_error.noise_floor_db - one.noise_floor_db
        assert apart == pytest.approx(3.5), "the shifts of narrow pictures"


@for_each(
    "changes",
    [
        {"stated_error": "bound"},
        {"per_light": True},
        {"split": True},
        {"denoiser": "fast"},
        {"min_spp": 512, "max_spp": 512},
        {"min_spp": 8, "max_spp": 16},
        {"resolution": 24},
    ],
)
@pytest.mark.usefixtures("llvm")
def test_what_was_not_calibrated_has_the_bound(
    measured: list[dict[str, ErrorMeasures]], changes: dict[str, Any]
) -> None:
    settings = dataclasses.replace(SETTINGS, **changes)
    bound = dataclasses.replace(settings, stated_error="bound")
    found, before = (render_view(lit_scene(), each, 3) for each in (settings, bound))
    assert found.expected_error is None and not measured
    assert found.noise_floor_db == before.noise_floor_db


@pytest.mark.usefixtures("measured")
def test_a_bound_in_its_place_is_measured_later() -> None:
    cases: list[tuple[dict[str, Any], int]] = [
        ({}, 32), ({"stated_error": "bound"}, 32), ({"per_light": True}, 64), ({"split": True}, 64),
        ({"denoiser": "fast"}, 64), ({"resolution": 512}, 64), ({"resolution": 128}, 64),
        ({"split": True, "max_spp": 32}, 32),
    ]  # fmt: skip
    for changes, spp in cases:
        asked: dict[str, Any] = {"resolution": 256, "min_spp_px": 256, **changes}
        settings = dataclasses.replace(SETTINGS, **asked)
        assert first_spp(settings) == spp, changes


@for_each("arithmetic", ["numpy", "device"])
@pytest.mark.usefixtures("llvm")
def test_far_from_its_targets_a_view_goes_on_by_its_halves(
    measured: list[dict[str, ErrorMeasures]], arithmetic: Arithmetic
) -> None:
    """A target that nothing reaches, then one that is reached at once."""
    measured.clear()
    each_look = dataclasses.replace(SETTINGS, arithmetic=arithmetic)
    near = dataclasses.replace(each_look, picture_within_db=2.0)
    found, expected = (render_view(lit_scene(), settings, 3) for settings in (near, each_look))
    assert len(measured) == 1 + 2, "at the cap alone, and at 128 and 256 samples"
    assert found.noise_floor_db == expected.noise_floor_db
    np.testing.assert_array_equal(found.radiance_rgb, expected.radiance_rgb)
    measured.clear()
    view = render_view(lit_scene(), dataclasses.replace(near, noise_floor_db=1.0), 3)
    assert len(measured) == 1 and view.spp == first_spp(near) and not view.at_cap


def test_other_versions_and_damage(tmp_path: Path) -> None:
    record = dataclasses.asdict(STATEMENT)

    def stored(name: str, **changes: object) -> Path:
        path = tmp_path / name
        path.write_text(json.dumps(record | changes))
        return path

    assert load_statement(stored("same")) == STATEMENT
    assert load_statement(stored("other", versions={**record["versions"], "denoiser": "0"})) is None
    with pytest.raises(TrilightError, match="layouts"):
        load_statement(stored("damaged", layouts="many"))


def test_the_included_statement_is_of_these_pictures() -> None:
    """If it fails: raise no number here; measure and fit again (calibrated_error names how)."""
    statement = load_statement()
    assert statement is not None, versions_of_pictures()
    for metric in METRICS:
        found = statement.metrics[metric]
        assert min(found.weights[name] for name in MEASURES) >= 0, "an error that grows lowers it"
        assert all(found.bound[group] < found.expected[group] for group in found.bound)


def test_the_unbiased_measures_are_the_true_errors() -> None:
    """Of a denoiser that halves the noise and adds a bias, on average over many pixels."""
    rng = np.random.default_rng(0)
    px = 512
    truth = np.full((px, px, 3), 0.5)
    bias = np.kron(rng.choice([-0.02, 0.02], (px // 8, px // 8, 1)), np.ones((8, 8, 3)))

    def denoise(raw: np.ndarray) -> np.ndarray:
        return truth + bias + 0.5 * (raw - truth)

    raws = [truth + rng.normal(0, 0.05, truth.shape) for _ in range(2)]
    a, b = (
        Half(raw_rgb=raw.astype(np.float32), denoised_rgb=denoise(raw).astype(np.float32))
        for raw in raws
    )
    picture = denoise((raws[0] + raws[1]) / 2).astype(np.float32).astype(np.float64)
    everywhere = np.ones((px, px), bool)
    totals, surprises = error_measures(halves_of(a, b), picture, everywhere, NUMPY)
    found = measures_of_totals(totals.reshape(3, 6)[1], surprises[1].max(), px * px, 1.0)
    noise = 0.25 * 0.05**2 / 2
    assert found.agreement == pytest.approx(noise, rel=0.02)
    assert found.estimate == pytest.approx(0.02**2 + noise, rel=0.05)
    assert found.sure == pytest.approx(0.02**2 + noise / 64, rel=0.05), "averaged over blocks"
    assert found.block_agreement == pytest.approx(1 / 64, rel=0.05)
    assert found.move == pytest.approx(0, abs=1e-12)
