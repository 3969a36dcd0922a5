"""Flicker against raw halves: what stays where it is does not count, nor does the halves' noise."""

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.sides.judged_pictures import Reference
from infra.bench.sides.orbits import film, true_flicker_db, with_orbit
from infra.bench.sides.rung_pictures import View
from storage.conventions import log10_radiance, radiance_from_log10
from storage.metrics import flicker_log_db
from storage.records.scene import Scene
from tests.train.toy import toy_scene

FRAMES, PX = 12, 32


def truth() -> NDArray[np.float64]:
    """Return frames in which a ramp moves."""
    ramp = np.linspace(0.05, 0.9, PX * PX * 3).reshape(PX, PX, 3)
    return np.stack([np.roll(ramp, frame, axis=1) for frame in range(FRAMES)])


def halves(rng: np.random.Generator, spread: float) -> list[Reference]:
    def noisy(frame: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(frame + rng.normal(0, spread, frame.shape), 0)

    return [Reference(a_rgb=noisy(frame), b_rgb=noisy(frame)) for frame in truth()]


def shown(error_log10: NDArray[np.float64]) -> NDArray[np.float32]:
    return radiance_from_log10(log10_radiance(truth()) + error_log10).astype(np.float32)


def test_noise_that_jumps_flickers_3_db_worse_than_it_errs_whatever_the_references() -> None:
    rng = np.random.default_rng(0)
    error = rng.normal(0, 0.02, (FRAMES, PX, PX, 3))
    error_db = -20 * np.log10(0.02)
    for spread in (0.0, 0.02, 0.1):
        found, open_db = true_flicker_db(shown(error), halves(rng, spread))
        # 34,000 changes, whose noise is up to four times themselves: a few tenths of a dB
        assert found == pytest.approx(error_db - 10 * np.log10(2), abs=0.1 + 8 * spread)
        assert open_db < 0.05 + 8 * spread
    plain = [
        flicker_log_db(error[frame], error[frame + 1]) for frame in range(FRAMES - 1)
    ]  # of the errors themselves
    assert np.mean(plain) == pytest.approx(error_db - 10 * np.log10(2), abs=0.1)


def test_an_error_that_stays_on_the_screen_is_calm() -> None:
    rng = np.random.default_rng(1)
    pattern = np.broadcast_to(rng.normal(0, 0.05, (PX, PX, 3)), (FRAMES, PX, PX, 3))
    assert true_flicker_db(shown(pattern), halves(rng, 0.0))[0] == pytest.approx(100, abs=1e-9)
    assert true_flicker_db(shown(pattern), halves(rng, 0.02))[0] > 45  # it errs by 26 dB
    moving = np.stack([np.roll(pattern[0], frame, axis=1) for frame in range(FRAMES)])
    assert true_flicker_db(shown(moving), halves(rng, 0.0))[0] < 30


def test_a_film_is_of_the_cameras_of_an_orbit_and_its_first_view_is_not_timed() -> None:
    scene = with_orbit(toy_scene(0), 5, 20.0)
    assert len(scene.c2w) == 5
    steps = np.linalg.norm(np.diff(scene.c2w[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-4)  # float32 positions
    asked: list[NDArray[np.float32]] = []

    def rung(loaded: Scene) -> View:
        def view(c2w: NDArray[np.float32], fov_deg: float) -> NDArray[np.float32]:
            asked.append(c2w)
            return np.full((8, 8, 3), c2w[0, 3], np.float32)

        return view

    found = film(rung, scene)
    assert len(asked) == 6, "once to warm up"
    np.testing.assert_array_equal(found.frames_rgb[:, 0, 0, 0], scene.c2w[:, 0, 3])
    assert found.view_s >= 0
