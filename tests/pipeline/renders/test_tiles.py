"""Tiles: where samples go, that the means stay unbiased, and the choice against slow twins."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.renders.camera import PixelCamera
from pipeline.renders.frozen_arithmetic.halves import Half
from pipeline.renders.frozen_arithmetic.host_pictures import HostMeans, LogChanges
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import SceneRenderer, set_threads
from pipeline.renders.samples import DualBuffer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tiles import TILE_PX, TileChoice, passes_of_tiles
from pipeline.renders.tracer import Chosen, Tracer
from tests.oracle.plugin_tracer import HostSum
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.pipeline.renders.test_renderer import digest, lit_scene

PASS = 64
CAMERA = PixelCamera(c2w=np.eye(4), fov_deg=40.0, resolution=32)
EVERYWHERE = np.ones((32, 32), bool)


class RareLight:
    """A tracer in which a pass finds a flash in a tile now and then; no two tiles are as dim."""

    FLASH = 20.0
    ODDS = 0.03

    def __init__(self) -> None:
        self.dim = np.repeat(np.linspace(0.1, 1, 32 // TILE_PX), TILE_PX)

    def pass_sum(self, camera: PixelCamera) -> HostSum:
        return HostSum(self, camera)  # type: ignore[arg-type]

    def radiance(
        self, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        rng, across = np.random.default_rng(seed), camera.resolution // TILE_PX
        found = rng.random((across, across)) < self.ODDS * spp / PASS
        flash = found.repeat(TILE_PX, 0).repeat(TILE_PX, 1) * self.FLASH * PASS / spp
        noise = rng.exponential(self.dim, (camera.resolution, camera.resolution))
        grey = (noise + flash) * (True if chosen is None else chosen)
        return grey[..., None].repeat(3, axis=-1).astype(np.float32)


def _halves(samples: DualBuffer) -> list[Half]:
    raws = [raw[0] for raw in HostMeans(samples).half_means()]
    return [Half(raw_rgb=raw, denoised_rgb=raw) for raw in raws]


def _adapted(
    tracer: object,
    seed: int,
    measured_at: Sequence[int],
    counted: NDArray[np.bool_] = EVERYWHERE,
) -> DualBuffer:
    samples = DualBuffer([tracer], CAMERA, seed, first_spp=32, max_spp=4096)  # type: ignore[list-item]
    samples.count_over(counted)
    tiles, changes = TileChoice(counted), LogChanges()
    for spp in measured_at:
        more = tiles.passes(samples, spp) if samples.spp else None
        for _ in samples.passes_to(spp) if more is None else samples.passes_over(more):
            pass
        tiles.learn(changes.since(_halves(samples)), samples, "off")
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
        means.append(HostMeans(samples).mean().mean())
        spread.append(samples.spp_of(0).max() > samples.spp_of(0).min())
    assert np.mean(spread) > 0.9, "the samples are spread unevenly"
    error = np.std(means, ddof=1) / np.sqrt(len(means))
    assert error < 0.02 * truth, "a bias of 8 % would show"
    assert abs(np.mean(means) - truth) < 4 * error


@pytest.mark.parametrize(
    ("resolution", "max_spp", "num_views", "most"),
    [(16, 256, 10, 0.02), pytest.param(32, 512, 16, 0.01, marks=pytest.mark.slow("statistics"))],
)
def test_a_scene_keeps_its_light_over_many_views(
    resolution: int, max_spp: int, num_views: int, most: float
) -> None:
    """With the denoiser, which keeps the mean; no tiles are chosen below 512 samples."""
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    settings = RenderSettings(
        resolution=resolution, noise_floor_db=90.0, min_spp=32, max_spp=max_spp,
        min_mean_radiance=0.0,
    )  # fmt: skip
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
    class Noisy(RareLight):
        ODDS = 0.0

    counted = np.ones((32, 32), bool)
    counted[:, 24:] = False
    samples = _adapted(Noisy(), 1, [32, 128, 512], counted)
    of_column = (samples.spp_of(0) + samples.spp_of(1)).mean(axis=0)[::TILE_PX]
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


def _scene_tracer(resolution: int = 32) -> tuple[Tracer, PixelCamera]:
    scene = sampled_like_scene(np.random.default_rng(5), num_views=1)
    return load_tracer(scene, max_depth=6, rr_depth=2), camera_of(scene, resolution)


def test_a_pass_over_some_pixels_agrees_with_passes_over_all() -> None:
    """The slow twin traces the whole picture. Each pixel is off by less than 5.5 of its standard
    errors, and the mean square of the scores is 1: they go by 15 degrees of freedom each."""
    tracer, camera = _scene_tracer(16)
    chosen = np.random.default_rng(0).random((16, 16)) < 0.6
    pairs = [
        (
            tracer.radiance(camera, seed=n, spp=64, chosen=chosen).mean(axis=-1),
            tracer.radiance(camera, seed=500 + n, spp=64).mean(axis=-1),
        )
        for n in range(32)
    ]
    some, all_ = (np.array(pictures, np.float64) for pictures in zip(*pairs, strict=True))
    assert (some[:, ~chosen] == 0).all()
    error = np.sqrt((some.var(axis=0, ddof=1) + all_.var(axis=0, ddof=1)) / 32)
    lit = chosen & (error > 0)
    score = (some.mean(axis=0) - all_.mean(axis=0))[lit] / error[lit]
    assert lit.sum() > 100
    assert np.abs(score).max() < 5.5
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.4


def test_all_pixels_chosen_are_the_whole_picture_in_every_bit() -> None:
    tracer, camera = _scene_tracer()
    np.testing.assert_array_equal(
        tracer.radiance(camera, seed=3, spp=16, chosen=EVERYWHERE),
        tracer.radiance(camera, seed=3, spp=16),
    )


def test_sums_over_chosen_pixels_are_those_of_the_passes() -> None:
    tracer, camera = _scene_tracer()
    rng = np.random.default_rng(2)
    fast, slow = tracer.pass_sum(camera), HostSum(tracer, camera)
    for seed, share in enumerate((0.2, 1.1, 0.5)):
        chosen = rng.random((32, 32)) < share
        for part in (fast, slow):
            part.add(seed=seed, spp=16, chosen=chosen)
    np.testing.assert_array_equal(fast.read(), slow.read())
    # Squares of float32 means are the same; the grey mean is summed in another order.
    np.testing.assert_allclose(fast.read_squares(), slow.read_squares(), rtol=1e-12)


def test_chosen_tiles_give_the_same_bits_on_any_number_of_threads() -> None:
    scene = lit_scene()
    view_of = scene.c2w[0], float(scene.fov_deg[0])
    for per_light in (False, True):
        settings = RenderSettings(
            resolution=32, noise_floor_db=90.0, min_spp=32, max_spp=512, per_light=per_light
        )
        digests = []
        for threads in (1, 2):
            set_threads(threads)
            renderer = SceneRenderer(scene, settings)
            view = renderer.render_view(*view_of, 1)
            digests.append(digest(view))
            assert view.at_cap and 512 < view.spp <= 528, "without a choice it is 512"
        assert digests[0] == digests[1], f"per light: {per_light}"
    alike = dataclasses.replace(settings, max_spp=128)
    assert digest(SceneRenderer(scene, alike).render_view(*view_of, 1)) != digests[0]
