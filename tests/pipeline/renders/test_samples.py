"""How many samples, where they go, when they end, and what error is stated of them."""

from collections.abc import Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.renders.calibrated_error import first_spp
from pipeline.renders.noise_floor import Curve
from pipeline.renders.pictures import NUMPY, means, pixel_errors, read_sums
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.samples import (
    TILE_PX,
    DualBuffer,
    TileChoice,
    expected_spp,
    gaps_db,
    next_spp,
    passes_of_tiles,
    slope_db,
    tile_means,
)
from pipeline.renders.settings import RenderSettings, measured_settings, target_overrides
from pipeline.renders.tracer import Chosen, PixelCamera, load_tracer
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.metrics import MAX_DB, psnr_linear_db, psnr_log_db
from storage.records.scene import Scene
from tests.oracle.plugin_tracer import HostSum
from tests.pipeline.renders.sampling import Half, camera_of, floor_of, halves_of, view_settings
from tests.pipeline.renders.scene_kit import lit_by_a_mirror, sampled_like_scene

CAMERA = PixelCamera(c2w=np.eye(4), fov_deg=40.0, resolution=32)
PX = 32
PASS = 64
EVERYWHERE = np.ones((PX, PX), bool)


class HostTracer:
    """A stand-in for a tracer, whose passes are in numpy's memory."""

    def pass_sum(self, camera: PixelCamera) -> HostSum:
        return HostSum(self, camera)


class Recorder(HostTracer):
    """Writes down what it is asked, and its light is the number of samples."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []

    def radiance(
        self, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        self.asked.append((spp, seed))
        picture = np.full((camera.resolution, camera.resolution, 3), spp, np.float32)
        return picture if chosen is None else picture * chosen[..., None]


def test_passes_are_the_largest_that_fit_and_weigh_by_their_samples() -> None:
    for least_spp, spp, max_spp, of_a_half in (
        (128, 128, 512, [64]),
        (32, 32, 4096, [16]),
        (32, 160, 160, [16, 16, 16, 16, 16]),
        (8, 32, 64, [4, 4, 4, 4]),
        (8, 64, 64, [4, 4, 4, 4, 16]),
        (32, 256, 4096, [16, 16, 16, 16, 64]),
    ):
        tracer = Recorder()
        samples = DualBuffer([tracer], CAMERA, 0, first_spp=least_spp, max_spp=max_spp)  # type: ignore[list-item]
        for _ in samples.passes_to(spp):
            pass
        assert samples.spp == spp
        assert [size for size, _ in tracer.asked] == [size for size in of_a_half for _ in range(2)]
        assert len({seed for _, seed in tracer.asked}) == len(tracer.asked), "no two are equal"
    expected = (4 * 16 * 16 + 64 * 64) / 128
    both, halves = mean_of(samples), half_means_of(samples)
    assert both.max() == both.min() == expected
    assert [float(half.mean()) for half in halves] == [expected, expected]


def mean_of(samples: DualBuffer) -> NDArray[np.float32]:
    ((picture,),) = means(read_sums(samples), NUMPY, of_both=True)
    return np.asarray(picture)


def half_means_of(samples: DualBuffer) -> list[NDArray[np.float32]]:
    return [picture for (picture,) in means(read_sums(samples), NUMPY, of_both=False)]


def test_light_paths_are_those_of_other_views_and_of_no_other_half_or_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Halves share nothing, or the stated error would not see what they share."""
    asked = list[tuple[int, int | None]]()
    monkeypatch.setattr(
        HostSum, "add", lambda _, *, seed, light_seed, **rest: asked.append((seed, light_seed))
    )

    def sampled(seed: int, light_seed: int | None) -> list[tuple[int, int | None]]:
        asked.clear()
        tracers: Any = [Recorder()]
        buffer = DualBuffer(
            tracers, CAMERA, seed, first_spp=32, max_spp=4096, light_seed=light_seed
        )
        for _ in (*buffer.passes_to(128), *buffer.passes_over([np.full((PX, PX), 2)] * 2)):
            pass
        return asked.copy()

    first, second = sampled(1, 9), sampled(2, 9)
    lights = [light for _, light in first]
    assert lights == [light for _, light in second]
    assert len({*lights, *(seed for seed, _ in first + second)}) == 3 * len(first)
    assert {light for _, light in sampled(1, None)} == {None}


GOOD: dict[str, Any] = {
    "resolution": 64, "noise_floor_db": 40.0, "min_spp": 128, "max_spp": 512,
}  # fmt: skip


def test_settings_that_do_not_fit_together_are_refused() -> None:
    """What a field alone may be is held by tests/extremes/test_ranges.py."""
    for name, value, expected in (
        ("resolution", 60, "a multiple of 8"),
        ("min_spp", 640, "min <= max"),
        ("min_spp", 100, "multiples of 8"),
        ("max_spp", 130, "multiples of 8"),
        ("aux_spp", 32, "one of"),
        ("noise_floor_db", None, "one of noise_floor_db, .* to be a number"),
    ):
        with pytest.raises(TrilightError, match=f"{name}.* {value}.*; expected {expected}"):
            RenderSettings(**{**GOOD, name: value})


def test_a_narrow_picture_has_more_samples_before_the_first_look() -> None:
    for resolution, max_spp, first in ((512, 4096, 64), (128, 4096, 64), (64, 4096, 128),
                                       (96, 4096, 128), (8, 64, 64)):  # fmt: skip
        settings = {**GOOD, "resolution": resolution, "min_spp": 64, "max_spp": max_spp}
        assert first_spp(RenderSettings(**settings)) == first, (resolution, max_spp)
    for resolution, first in ((512, 32), (256, 32), (128, 64), (64, 128)):
        settings = {**GOOD, "resolution": resolution, "min_spp": 32, "min_spp_px": 256}
        assert first_spp(RenderSettings(**settings)) == first, resolution


def test_targets_go_by_the_name_of_their_metric() -> None:
    for targets, expected in (
        ({}, {"psnr_log_db": 40.0}),
        ({"noise_floor_linear_db": 35.0}, {"psnr_linear_db": 35.0}),
        ({"noise_floor_db": 44.0, "noise_floor_objects_db": 43.0},
         {"psnr_log_db": 44.0, "object_psnr_log_db": 43.0}),
    ):  # fmt: skip
        assert measured_settings(64, targets).targets_db == expected
        assert RenderSettings(**{**GOOD, **target_overrides(targets)}).targets_db == expected


def log_goal(target_db: float, step: int, max_spp: int) -> dict[str, Any]:
    return {"targets_db": {"psnr_log_db": target_db}, "step": step, "max_spp": max_spp}


def following_spp(measured: list[tuple[int, dict[str, float]]], goal: dict[str, Any]) -> int:
    return next_spp(measured[-1][0], expected_spp(measured, **goal), goal["step"])


def logs(*measured: tuple[int, float]) -> list[tuple[int, dict[str, float]]]:
    return [(spp, {"psnr_log_db": floor_db}) for spp, floor_db in measured]


@given(st.integers(1, 62), st.floats(1e-6, 60), st.floats(1e-6, 60), st.sampled_from([8, 32, 128]))
def test_samples_grow_in_whole_steps_up_to_the_cap(
    steps: int, gap_db: float, wider_gap_db: float, step: int
) -> None:
    spp, cap = steps * step, 64 * step
    chosen = following_spp(logs((spp, 0.0)), log_goal(gap_db, step, cap))
    assert chosen % step == 0
    assert spp < chosen <= cap
    assert chosen <= max(2 * spp, spp + step)
    if wider_gap_db >= gap_db:
        assert chosen <= following_spp(logs((spp, 0.0)), log_goal(wider_gap_db, step, cap))


def test_samples_go_by_what_a_doubling_buys() -> None:
    """1.2 dB at first, and then what the last two floors say, of which 0.6 to 3 are believed."""
    first, fast = logs((128, 0.0)), logs((128, 40.0), (256, 42.0))
    slow = logs((128, 40.0), (512, 42.0))
    for measured, target_db, following, in_all in (
        (first, 1.2, 256, 256),
        (first, 4.8, 256, 2048),
        (first, 1e9, 256, 4096),
        (logs((3072, 0.0)), 99.0, 4096, 4096),
        (fast, 44.0, 512, 512),
        (slow, 43.0, 1024, 1024),
        (slow, 44.0, 1024, 2048),
    ):
        goal = log_goal(target_db, 128, 4096)
        assert following_spp(measured, goal) == following
        assert expected_spp(measured, **goal) == in_all
    assert (slope_db(fast, "psnr_log_db"), slope_db(slow, "psnr_log_db")) == (2.0, 1.0)
    assert slope_db(logs((128, 40.0), (256, 39.0)), "psnr_log_db") == 0.6
    assert slope_db(logs((128, 40.0), (256, 50.0)), "psnr_log_db") == 3.0


TWICE = [
    (128, {"psnr_log_db": 40.0, "psnr_linear_db": 30.0, "object_psnr_log_db": 38.0}),
    (256, {"psnr_log_db": 42.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0}),
]


def test_the_target_that_needs_most_samples_governs() -> None:
    missed = {"psnr_log_db": 42.0, "psnr_linear_db": 35.0}
    assert gaps_db(missed, TWICE[-1][1]) == {"psnr_linear_db": 4.0}
    assert gaps_db({"psnr_log_db": 41.0}, TWICE[-1][1]) == {}
    # 2 dB a doubling of the log floor, 1 dB of both others
    both = {"psnr_log_db": 45.0, "psnr_linear_db": 33.0}
    assert expected_spp(TWICE, both, step=128, max_spp=8192) == 1024  # two doublings: of 3 dB 1.5
    alone = {"psnr_log_db": 46.0}
    assert expected_spp(TWICE, alone, step=128, max_spp=8192) == 1024
    reached = {"psnr_log_db": 44.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0}
    for targets_db in ({"psnr_log_db": 44.0}, reached):  # what is reached costs nothing
        goal: dict[str, Any] = {"targets_db": targets_db, "step": 128, "max_spp": 8192}
        assert expected_spp(TWICE, **goal) == following_spp(TWICE, goal) == 512


NOISE = 0.05


def truth() -> NDArray[np.float32]:
    """Return a picture with stripes of one pixel, which a blur takes away."""
    stripes = 0.5 + 0.3 * (np.arange(PX) % 2)
    return np.broadcast_to(stripes[:, None, None], (PX, PX, 3)).astype(np.float32)


def blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a denoiser's picture: means over three rows, with the same bias in any half."""
    mean = (np.roll(picture, 1, axis=0) + picture + np.roll(picture, -1, axis=0)) / 3
    return np.asarray(mean, np.float32)


def half(rng: np.random.Generator) -> Half:
    raw = truth() + rng.normal(scale=NOISE, size=(PX, PX, 3)).astype(np.float32)
    return Half(raw_rgb=raw, denoised_rgb=blurred(raw))


def errors(a: Half, b: Half, curve: Curve) -> tuple[Any, Any]:
    return pixel_errors(halves_of(a, b), curve, NUMPY, is_filtered=True)


def test_on_average_the_estimate_is_the_error_of_the_mean_of_both_halves() -> None:
    """In linear light the law is exact: stripes lose two thirds, of the noise a sixth remains."""
    rng = np.random.default_rng(0)
    pairs = [(half(rng), half(rng)) for _ in range(200)]
    estimates = [errors(a, b, lambda radiance: radiance)[0].mean() for a, b in pairs]
    exact = (2 / 3 * 0.3) ** 2 + NOISE**2 / 6
    spread = np.std(estimates) / np.sqrt(len(estimates))
    assert abs(np.mean(estimates) - exact) < 4 * spread < 0.01 * exact
    found = np.mean([errors(a, b, log10_radiance)[0].mean() for a, b in pairs[:50]])
    means = [0.5 * (a.denoised_rgb + b.denoised_rgb) for a, b in pairs[:50]]
    wanted = np.mean([10 ** (-psnr_log_db(mean, truth()) / 10) for mean in means])
    # The secant goes through the raw mean, whose noise of 0.035 bends it by some per cent.
    assert found == pytest.approx(wanted, rel=0.05)


def test_a_bias_that_both_halves_share_is_stated() -> None:
    rng = np.random.default_rng(2)
    flat = np.full((PX, PX, 3), truth().mean(), np.float32)
    a, b = (Half(raw_rgb=half(rng).raw_rgb, denoised_rgb=flat) for _ in range(2))
    assert psnr_log_db(a.denoised_rgb, b.denoised_rgb) == MAX_DB, "the halves agree exactly"
    floor = floor_of(a, b, EVERYWHERE)
    # The allowances take off what one standard error and one pixel's surprise are: under 1 dB here.
    assert psnr_log_db(flat, truth()) - 1 < floor.noise_floor_db < psnr_log_db(flat, truth())
    assert (
        psnr_linear_db(flat, truth()) - 1
        < floor.noise_floor_linear_db
        < psnr_linear_db(flat, truth())
    )


def test_rare_light_that_one_half_found_is_allowed_for() -> None:
    calm = truth()
    raw = calm.copy()
    raw[3, 4] = 20.0
    found, missed = (Half(raw_rgb=picture, denoised_rgb=calm) for picture in (raw, calm))
    mean = 0.5 * (raw[3, 4] + calm[3, 4])
    surprise = np.square(log10_radiance(mean) - log10_radiance(calm[3, 4])).mean()
    assert errors(found, missed, log10_radiance)[1].max() == pytest.approx(surprise)
    floor = floor_of(found, missed, EVERYWHERE)
    # What one half alone has cancels in the estimate: the allowance is all that is stated.
    assert floor.noise_floor_db == pytest.approx(-10 * np.log10(surprise / PX**2), abs=0.1)
    both = floor_of(found, found, EVERYWHERE)
    assert both.noise_floor_db < floor.noise_floor_db - 3, (
        "light that both found is an error, and still a surprise"
    )


def test_raw_halves_state_the_error_of_one_and_none_or_no_geometry_the_cap() -> None:
    rng = np.random.default_rng(6)
    raw = [truth() + rng.normal(0, 0.02, (PX, PX, 3)).astype(np.float32) for _ in range(2)]
    a, b, calm = (Half(raw_rgb=picture, denoised_rgb=picture) for picture in (*raw, truth()))
    exact = psnr_log_db(raw[0], truth())
    # One standard error of 64 blocks more: 0.2 dB.
    assert floor_of(a, b, EVERYWHERE).noise_floor_db == pytest.approx(exact, abs=0.4)
    assert floor_of(calm, calm, EVERYWHERE).noise_floor_db == MAX_DB
    a, b = half(rng), half(rng)
    assert floor_of(a, b, ~EVERYWHERE).object_noise_floor_db == MAX_DB
    assert floor_of(a, b, EVERYWHERE) == floor_of(b, a, EVERYWHERE)


def test_an_empty_background_earns_nothing() -> None:
    rng = np.random.default_rng(5)
    hits, wide = np.zeros((2 * PX, 2 * PX), bool), ((0, PX), (0, PX), (0, 0))
    hits[:PX, :PX] = True
    inner = half(rng), half(rng)
    framed, other = (
        Half(raw_rgb=np.pad(each.raw_rgb, wide), denoised_rgb=np.pad(each.denoised_rgb, wide))
        for each in inner
    )
    alone, floor = floor_of(*inner, EVERYWHERE), floor_of(framed, other, hits)
    assert floor.object_noise_floor_db == pytest.approx(alone.noise_floor_db, abs=1e-9)
    assert floor.noise_floor_db > alone.noise_floor_db + 3, "three quarters of the pixels are exact"


class RareLight(HostTracer):
    """A pass finds a flash in a tile now and then; no two tiles are as dim."""

    FLASH = 20.0
    ODDS = 0.03

    def __init__(self) -> None:
        self.dim = np.repeat(np.linspace(0.1, 1, 32 // TILE_PX), TILE_PX)

    def radiance(
        self, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        rng, across = np.random.default_rng(seed), camera.resolution // TILE_PX
        found = rng.random((across, across)) < self.ODDS * spp / PASS
        flash = found.repeat(TILE_PX, 0).repeat(TILE_PX, 1) * self.FLASH * PASS / spp
        noise = rng.exponential(self.dim, (camera.resolution, camera.resolution))
        grey = (noise + flash) * (True if chosen is None else chosen)
        return grey[..., None].repeat(3, axis=-1).astype(np.float32)


def _adapted(
    tracer: object, seed: int, measured_at: Sequence[int], counted: NDArray[np.bool_] = EVERYWHERE
) -> DualBuffer:
    samples = DualBuffer([tracer], CAMERA, seed, first_spp=32, max_spp=4096)  # type: ignore[list-item]
    samples.counted = counted
    tiles, before = TileChoice(counted), np.zeros((2, 1, 1, 1))
    for spp in measured_at:
        more = tiles.passes(samples, spp) if samples.spp else None
        for _ in samples.passes_to(spp) if more is None else samples.passes_over(more):
            pass
        logs = log10_radiance(np.array(half_means_of(samples), np.float64))
        changes = [tile_means(each.mean(axis=-1)) for each in np.square(logs - before)]
        tiles.learn(changes, samples, "off")
        before = logs
    return samples


@pytest.mark.slow("statistics")
def test_the_mean_stays_unbiased_where_tiles_are_chosen_by_rare_light() -> None:
    """Where a half chose for itself, tiles that found a flash would be diluted: 8 % were missing.

    The means of 1000 seeds; four of their own standard errors are 1 in 16,000.
    """
    truth = RareLight.FLASH * RareLight.ODDS + RareLight().dim.mean()
    means, spread = [], []
    for seed in range(1000):
        samples = _adapted(RareLight(), seed, [32, 128, 512])
        means.append(mean_of(samples).mean())
        spread.append(samples.spp_by_half[0].max() > samples.spp_by_half[0].min())
    assert np.mean(spread) > 0.9, "the samples are spread unevenly"
    error = np.std(means, ddof=1) / np.sqrt(len(means))
    assert error < 0.02 * truth, "a bias of 8 % would show"
    assert abs(np.mean(means) - truth) < 4 * error


NOISY = sampled_like_scene(np.random.default_rng(5), num_views=1)


@pytest.mark.parametrize(
    ("scene", "resolution", "max_spp", "num_views", "most"),
    [(NOISY, 16, 256, 10, 0.02),
     pytest.param(NOISY, 32, 512, 16, 0.01, marks=pytest.mark.slow("statistics")),
     pytest.param(lit_by_a_mirror(0.3), 32, 512, 24, 0.02, marks=pytest.mark.slow("statistics"))],
    ids=["alike", "tiles", "guided"],
)  # fmt: skip
def test_a_scene_keeps_its_light_over_many_views(
    scene: Scene, resolution: int, max_spp: int, num_views: int, most: float
) -> None:
    """With the denoiser, which keeps the mean; no tiles are chosen below 512 samples."""
    settings = view_settings(32, resolution=resolution, max_spp=max_spp, min_mean_radiance=0.0)
    renderer, camera = SceneRenderer(scene, settings), camera_of(scene, resolution)
    adaptive = [
        renderer.render_view(camera.c2w, camera.fov_deg, seed).radiance_rgb.mean(dtype=np.float64)
        for seed in range(num_views)
    ]
    tracer = load_tracer(scene, max_depth=settings.max_depth, rr_depth=settings.rr_depth)
    plain = [
        tracer.radiance(camera, seed=10_000 + n, spp=64).mean(dtype=np.float64)
        for n in range(4 * num_views)
    ]
    error = np.hypot(*(np.std(means, ddof=1) / np.sqrt(len(means)) for means in (adaptive, plain)))
    assert error < most * np.mean(plain)
    assert abs(np.mean(adaptive) - np.mean(plain)) < 4 * error  # 1 in 16,000


def test_noisy_tiles_get_more_and_what_shows_nothing_gets_no_more() -> None:
    tracer, counted = RareLight(), np.ones((32, 32), bool)
    tracer.ODDS, counted[:, 24:] = 0.0, False
    samples = _adapted(tracer, 1, [32, 128, 512], counted)
    of_column = samples.spp_by_half.sum(axis=0).mean(axis=0)[::TILE_PX]
    assert of_column[0] < of_column[1] < of_column[2], "the noise grows to the right"
    assert of_column[3] == 128, "as many as before tiles were chosen"
    assert 512 <= samples.spp <= 512 + 2 * PASS


@given(
    variance=hnp.arrays(np.float64, (3, 3), elements=st.floats(0, 10)),
    passes=hnp.arrays(np.int64, (3, 3), elements=st.integers(1, 6)),
    weight=hnp.arrays(np.float64, (3, 3), elements=st.sampled_from([0.0, 0.25, 1.0])),
    more=st.integers(PASS, 12 * PASS).map(lambda spp: spp + 0.37),  # off the caps of tiles
)
def test_the_choice_is_that_of_handing_out_passes_one_by_one(
    variance: NDArray[np.float64],
    passes: NDArray[np.int64],
    weight: NDArray[np.float64],
    more: float,
) -> None:
    """The slow twin gives the next pass to the tile that has least for its share.

    It may stop among tiles whose turn comes at the same time; the choice serves all of them.
    """
    if not weight.any():
        weight[0, 0] = 1.0
    spp = passes * PASS
    found = passes_of_tiles(variance, spp, weight, more)
    mean = (weight * spp).sum() / weight.sum()
    usual = (variance * weight).sum() / weight.sum()
    share = np.cbrt(variance + 1e-3 * usual) if usual else np.ones((3, 3))
    given_out = np.zeros((3, 3), np.int64)
    while (weight * (spp + PASS * given_out)).sum() / weight.sum() < mean + more - 1e-6:
        now = spp + PASS * given_out
        open_ = (weight > 0) & (now + PASS <= 2 * (mean + more))
        key = np.where(open_, (now + PASS / 2) / np.maximum(share, 1e-300), np.inf)
        given_out[np.unravel_index(key.argmin(), key.shape)] += 1
    assert (found[weight == 0] == 0).all()
    assert ((found == given_out) | (found == given_out + 1)).all()


def one_pass(
    tracer: Any, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
) -> NDArray[np.float32]:
    """Return `VectorTracer.radiance` of some pixels; 0 in the others."""
    samples = tracer.pass_sum(camera)
    samples.add(seed=seed, spp=spp, chosen=chosen)
    picture = samples.read()[0] / spp
    return np.asarray(picture.astype(np.float32))


def test_a_pass_over_some_pixels_agrees_with_passes_over_all() -> None:
    """The slow twin traces the whole picture. Each pixel is off by less than 5.5 of its standard
    errors, and the mean square of the scores is 1: they go by 15 degrees of freedom each."""
    tracer, camera = load_tracer(NOISY, max_depth=6, rr_depth=2), camera_of(NOISY, 16)
    chosen = np.random.default_rng(0).random((16, 16)) < 0.6
    some, all_ = (
        np.array([one_pass(tracer, camera, seed=seed, spp=64, chosen=pixels) for seed in seeds])
        .astype(np.float64).mean(axis=-1)
        for seeds, pixels in ((range(32), chosen), (range(500, 532), None))
    )  # fmt: skip
    assert (some[:, ~chosen] == 0).all()
    error = np.sqrt((some.var(axis=0, ddof=1) + all_.var(axis=0, ddof=1)) / 32)
    lit = chosen & (error > 0)
    score = (some.mean(axis=0) - all_.mean(axis=0))[lit] / error[lit]
    assert lit.sum() > 100
    assert np.abs(score).max() < 5.5
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.4
    all_pixels = one_pass(tracer, camera, seed=3, spp=16, chosen=np.ones_like(chosen))
    np.testing.assert_array_equal(all_pixels, tracer.radiance(camera, seed=3, spp=16))


def test_sums_over_chosen_pixels_are_those_of_the_passes() -> None:
    tracer, camera = load_tracer(NOISY, max_depth=6, rr_depth=2), camera_of(NOISY, 32)
    rng = np.random.default_rng(2)
    passes = SimpleNamespace(radiance=partial(one_pass, tracer))
    fast, slow = tracer.pass_sum(camera), HostSum(passes, camera)
    for seed, share in enumerate((0.2, 1.1, 0.5)):
        chosen = rng.random((32, 32)) < share
        for part in (fast, slow):
            part.add(seed=seed, spp=16, chosen=chosen)
    (picture, squares, *counts), (expected, slow_squares, *slow_counts) = fast.read(), slow.read()
    np.testing.assert_array_equal(picture, expected)
    np.testing.assert_array_equal(counts, slow_counts)
    # Squares of float32 means are the same; the grey mean is summed in another order.
    np.testing.assert_allclose(squares, slow_squares, rtol=1e-12)
