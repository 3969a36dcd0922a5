"""How many samples: settings, passes in halves, the measured floor, and when sampling ends."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from infra.render.quality import ToStatedError
from pipeline.renders.camera import PixelCamera
from pipeline.renders.frozen_arithmetic.halves import (
    Half,
    estimate_error,
    squared_error,
    surprises,
)
from pipeline.renders.frozen_arithmetic.host_pictures import HostMeans
from pipeline.renders.samples import DualBuffer
from pipeline.renders.settings import NoiseTargets, RenderSettings
from pipeline.renders.stopping import Goal, expected_spp, gaps_db, next_spp, slope_db
from pipeline.renders.tracer import Chosen
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.metrics import MAX_DB, psnr_linear_db, psnr_log_db
from tests.oracle.plugin_tracer import HostSum

CAMERA = PixelCamera(c2w=np.eye(4), fov_deg=40.0, resolution=8)


class Recorder:
    """A tracer that writes down what it is asked, and whose light is the number of samples."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []

    def pass_sum(self, camera: PixelCamera) -> HostSum:
        return HostSum(self, camera)  # type: ignore[arg-type]

    def radiance(
        self, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        self.asked.append((spp, seed))
        picture = np.full((camera.resolution, camera.resolution, 3), spp, np.float32)
        return picture if chosen is None else picture * chosen[..., None]


def _passes(first_spp: int, spp: int, max_spp: int) -> tuple[DualBuffer, list[tuple[int, int]]]:
    tracer = Recorder()
    samples = DualBuffer([tracer], CAMERA, 0, first_spp=first_spp, max_spp=max_spp)  # type: ignore[list-item]
    for _ in samples.passes_to(spp):
        pass
    return samples, tracer.asked


def test_passes_are_the_largest_that_fit() -> None:
    for first_spp, spp, max_spp, of_a_half in (
        (128, 128, 512, [64]),
        (32, 32, 4096, [16]),
        (32, 256, 4096, [16, 16, 16, 16, 64]),
        (32, 160, 160, [16, 16, 16, 16, 16]),
        (8, 32, 64, [4, 4, 4, 4]),
        (8, 64, 64, [4, 4, 4, 4, 16]),
    ):
        samples, asked = _passes(first_spp, spp, max_spp)
        assert samples.spp == spp
        assert [size for size, _ in asked[::2]] == of_a_half
        assert [size for size, _ in asked[1::2]] == of_a_half


def test_the_mean_weighs_passes_by_their_samples() -> None:
    samples, asked = _passes(32, 256, 4096)
    assert len({seed for _, seed in asked}) == len(asked), "no two passes have the same seed"
    expected = (4 * 16 * 16 + 64 * 64) / 128
    means = HostMeans(samples)
    assert means.mean().max() == means.mean().min() == expected
    assert [float(half.mean()) for half in means.half_means()] == [expected, expected]


GOOD: dict[str, Any] = {
    "resolution": 64, "noise_floor_db": 40.0, "min_spp": 128, "max_spp": 512,
}  # fmt: skip
FLOORS = ("noise_floor_db", "noise_floor_linear_db", "noise_floor_objects_db")


BAD: dict[str, tuple[Any, ...]] = {
    "resolution": (0, 60, 2056),
    "min_spp": (0, 640, 100),
    "max_spp": (130,),
    "aux_spp": (32,),
    "max_depth": (0,),
    "rr_depth": (0,),
    "denoiser": ("best",),
    "min_mean_radiance": (-1.0,),
    **dict.fromkeys(FLOORS, (0.0, -3.0, 101.0, float("nan"), "loud")),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_settings_name_themselves(name: str) -> None:
    for value in BAD[name]:
        with pytest.raises(TrilightError, match=f"{name}.*{value}") as caught:
            RenderSettings(**{**GOOD, name: value})
        assert "\n" not in str(caught.value)


def test_a_narrow_picture_has_more_samples_before_the_first_look() -> None:
    for resolution, max_spp, first in (
        (512, 4096, 64),
        (256, 4096, 64),
        (128, 4096, 64),
        (64, 4096, 128),
        (96, 4096, 128),
        (8, 64, 64),
    ):
        settings = {**GOOD, "resolution": resolution, "min_spp": 64, "max_spp": max_spp}
        assert RenderSettings(**settings).first_spp == first, (resolution, max_spp)


def test_one_target_is_enough_and_one_is_needed() -> None:
    alone = RenderSettings(**{**GOOD, "noise_floor_db": None, "noise_floor_linear_db": 30.0})
    assert alone.targets_db == {"psnr_linear_db": 30.0}
    assert RenderSettings(**GOOD, noise_floor_objects_db=38.0).targets_db == {
        "psnr_log_db": 40.0,
        "object_psnr_log_db": 38.0,
    }
    with pytest.raises(TrilightError, match="noise_floor_db is None; expected one of"):
        RenderSettings(**{**GOOD, "noise_floor_db": None})
    for targets, expected in (
        (NoiseTargets(), {"psnr_log_db": 40.0}),
        (NoiseTargets(linear_db=35.0), {"psnr_linear_db": 35.0}),
        (NoiseTargets(log_db=44.0, objects_db=43.0),
         {"psnr_log_db": 44.0, "object_psnr_log_db": 43.0}),
    ):  # fmt: skip
        assert ToStatedError(targets=targets).settings(64).targets_db == expected


def log_goal(target_db: float, step: int, max_spp: int) -> Goal:
    return Goal(targets_db={"psnr_log_db": target_db}, step=step, max_spp=max_spp)


def logs(*measured: tuple[int, float]) -> list[tuple[int, dict[str, float]]]:
    return [(spp, {"psnr_log_db": floor_db}) for spp, floor_db in measured]


@given(st.integers(1, 62), st.floats(1e-6, 60), st.floats(1e-6, 60), st.sampled_from([8, 32, 128]))
def test_samples_grow_in_whole_steps_up_to_the_cap(
    steps: int, gap_db: float, wider_gap_db: float, step: int
) -> None:
    spp, cap = steps * step, 64 * step
    chosen = next_spp(logs((spp, 0.0)), log_goal(gap_db, step, cap))
    assert chosen % step == 0
    assert spp < chosen <= cap
    assert chosen <= max(2 * spp, spp + step)
    if wider_gap_db >= gap_db:
        assert chosen <= next_spp(logs((spp, 0.0)), log_goal(wider_gap_db, step, cap))


def test_a_gap_of_one_slope_doubles_the_samples() -> None:
    first = logs((128, 0.0))
    assert next_spp(first, log_goal(1.2, 128, 4096)) == 256
    assert next_spp(first, log_goal(2.4, 128, 4096)) == 256
    assert next_spp(first, log_goal(99.0, 128, 4096)) == 256
    assert next_spp(logs((512, 0.0)), log_goal(99.0, 128, 640)) == 640
    assert expected_spp(first, log_goal(1.2, 128, 4096)) == 256
    assert expected_spp(first, log_goal(4.8, 128, 4096)) == 2048, "past the next step"
    assert next_spp(first, log_goal(4.8, 128, 4096)) == 256
    assert expected_spp(first, log_goal(1e9, 128, 4096)) == 4096


def test_two_floors_say_what_the_next_doubling_buys() -> None:
    fast = logs((128, 40.0), (256, 42.0))
    assert slope_db(fast, "psnr_log_db") == 2.0
    assert next_spp(fast, log_goal(44.0, 128, 4096)) == 512
    slow = logs((128, 40.0), (512, 42.0))
    assert slope_db(slow, "psnr_log_db") == 1.0
    assert next_spp(slow, log_goal(43.0, 128, 4096)) == 1024
    assert expected_spp(slow, log_goal(44.0, 128, 4096)) == 2048


def test_a_floor_that_fell_is_not_believed_to_fall_on() -> None:
    fell = slope_db(logs((128, 40.0), (256, 39.0)), "psnr_log_db")
    assert 0 < fell < slope_db(logs((128, 40.0), (256, 50.0)), "psnr_log_db") <= 3.0


TWICE = [
    (128, {"psnr_log_db": 40.0, "psnr_linear_db": 30.0, "object_psnr_log_db": 38.0}),
    (256, {"psnr_log_db": 42.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0}),
]


def test_the_target_that_needs_most_samples_governs() -> None:
    missed = {"psnr_log_db": 42.0, "psnr_linear_db": 35.0}
    assert gaps_db(missed, TWICE[-1][1]) == {"psnr_linear_db": 4.0}
    assert gaps_db({"psnr_log_db": 41.0}, TWICE[-1][1]) == {}
    # 2 dB a doubling of the log floor, 1 dB of both others
    both = Goal(targets_db={"psnr_log_db": 45.0, "psnr_linear_db": 33.0}, step=128, max_spp=8192)
    assert expected_spp(TWICE, both) == 1024  # two doublings: the gap of 3 dB takes 1.5
    alone = Goal(targets_db={"psnr_log_db": 46.0}, step=128, max_spp=8192)
    assert expected_spp(TWICE, alone) == 1024
    reached = {"psnr_log_db": 44.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0}
    for targets_db in ({"psnr_log_db": 44.0}, reached):  # what is reached costs nothing
        goal = Goal(targets_db=targets_db, step=128, max_spp=8192)
        assert expected_spp(TWICE, goal) == next_spp(TWICE, goal) == 512


PX = 32
NOISE = 0.05
EVERYWHERE = np.ones((PX, PX), bool)


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


def linear(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    return radiance


def test_on_average_it_is_the_error_of_the_mean_of_both_halves() -> None:
    """In linear light the law is exact: stripes lose two thirds, of the noise a sixth remains."""
    rng = np.random.default_rng(0)
    estimates = [squared_error(half(rng), half(rng), linear).mean() for _ in range(200)]
    exact = (2 / 3 * 0.3) ** 2 + NOISE**2 / 6
    spread = np.std(estimates) / np.sqrt(len(estimates))
    assert abs(np.mean(estimates) - exact) < 4 * spread < 0.01 * exact


def test_in_a_curve_it_is_the_error_in_that_curve() -> None:
    rng = np.random.default_rng(1)
    pairs = [(half(rng), half(rng)) for _ in range(50)]
    found = np.mean([squared_error(a, b, log10_radiance).mean() for a, b in pairs])
    means = [0.5 * (a.denoised_rgb + b.denoised_rgb) for a, b in pairs]
    wanted = np.mean([10 ** (-psnr_log_db(mean, truth()) / 10) for mean in means])
    # The secant goes through the raw mean, whose noise of 0.035 bends it by some per cent.
    assert found == pytest.approx(wanted, rel=0.05)


def test_a_bias_that_both_halves_share_is_stated() -> None:
    rng = np.random.default_rng(2)
    flat = np.full((PX, PX, 3), truth().mean(), np.float32)
    a, b = (Half(raw_rgb=half(rng).raw_rgb, denoised_rgb=flat) for _ in range(2))
    assert psnr_log_db(a.denoised_rgb, b.denoised_rgb) == MAX_DB, "the halves agree exactly"
    floor = estimate_error(a, b, EVERYWHERE)
    # The allowances take off what one standard error and one pixel's surprise are: under 1 dB here.
    assert psnr_log_db(flat, truth()) - 1 < floor.log_db < psnr_log_db(flat, truth())
    assert psnr_linear_db(flat, truth()) - 1 < floor.linear_db < psnr_linear_db(flat, truth())


def test_rare_light_that_one_half_found_is_allowed_for() -> None:
    calm = truth()
    raw = calm.copy()
    raw[3, 4] = 20.0
    found, missed = (Half(raw_rgb=picture, denoised_rgb=calm) for picture in (raw, calm))
    mean = 0.5 * (raw[3, 4] + calm[3, 4])
    surprise = np.square(log10_radiance(mean) - log10_radiance(calm[3, 4])).mean()
    assert surprises(found, missed, log10_radiance).max() == pytest.approx(surprise)
    floor = estimate_error(found, missed, EVERYWHERE)
    # What one half alone has cancels in the estimate: the allowance is all that is stated.
    assert floor.log_db == pytest.approx(-10 * np.log10(surprise / PX**2), abs=0.1)
    both = estimate_error(found, found, EVERYWHERE)
    assert both.log_db < floor.log_db - 3, "light that both found is an error, and still a surprise"


def test_raw_halves_state_the_error_of_one() -> None:
    rng = np.random.default_rng(6)
    raw = [truth() + rng.normal(0, 0.02, (PX, PX, 3)).astype(np.float32) for _ in range(2)]
    halves = [Half(raw_rgb=picture, denoised_rgb=picture) for picture in raw]
    exact = psnr_log_db(raw[0], truth())
    # One standard error of 64 blocks more: 0.2 dB.
    assert estimate_error(halves[0], halves[1], EVERYWHERE).log_db == pytest.approx(exact, abs=0.4)


def test_pictures_without_error_or_without_geometry_state_the_cap() -> None:
    calm = Half(raw_rgb=truth(), denoised_rgb=truth())
    assert estimate_error(calm, calm, EVERYWHERE).log_db == MAX_DB
    rng = np.random.default_rng(4)
    a, b = half(rng), half(rng)
    assert estimate_error(a, b, ~EVERYWHERE).object_log_db == MAX_DB
    assert estimate_error(a, b, EVERYWHERE) == estimate_error(b, a, EVERYWHERE)


def test_an_empty_background_earns_nothing() -> None:
    rng = np.random.default_rng(5)
    hits = np.zeros((2 * PX, 2 * PX), bool)
    hits[:PX, :PX] = True
    inner = (half(rng), half(rng))
    framed = (_framed(inner[0]), _framed(inner[1]))
    alone, floor = estimate_error(*inner, EVERYWHERE), estimate_error(*framed, hits)
    assert floor.object_log_db == pytest.approx(alone.log_db, abs=1e-9)
    assert floor.log_db > alone.log_db + 3, "three quarters of the pixels are exact"


def _framed(inner: Half) -> Half:
    wide = ((0, PX), (0, PX), (0, 0))
    return Half(raw_rgb=np.pad(inner.raw_rgb, wide), denoised_rgb=np.pad(inner.denoised_rgb, wide))
