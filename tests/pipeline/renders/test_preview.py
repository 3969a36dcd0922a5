"""Previews: any number of samples from one, unbiased before the denoiser, and no stated error."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.preview import Preview, PreviewRenderer, PreviewSettings
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import SIGMAS
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.scenes_by_hand import tiny_scene


def made(scene: Scene, spp: int, seed: int = 0, **changes: Any) -> Preview:
    return shown(loaded(scene, spp, **changes), scene, spp, seed)


def loaded(scene: Scene, spp: int, **changes: Any) -> PreviewRenderer:
    settings = PreviewSettings(**{"resolution": 32, "spp": spp, "denoiser": "off", **changes})
    return PreviewRenderer(scene, settings)


def shown(renderer: PreviewRenderer, scene: Scene, spp: int, seed: int) -> Preview:
    steps = renderer.view_steps(scene.c2w[0], float(scene.fov_deg[0]), seed)
    told = []
    while True:
        try:
            told.append(next(steps))
        except StopIteration as end:
            found: Preview = end.value
            assert told[-1].spp == found.spp == spp
            assert all(step.missing_db is None for step in told)
            return found


def picture(scene: Scene, spp: int, seed: int = 0, **changes: Any) -> NDArray[np.float32]:
    return made(scene, spp, seed, **changes).radiance_rgb


@pytest.mark.parametrize("spp", [1, 7, 85])
def test_any_number_of_samples_is_a_picture(spp: int) -> None:
    scene = tiny_scene()
    for denoiser in ("off", "fast", "high"):
        found = picture(scene, spp, denoiser=denoiser)
        assert found.shape == (32, 32, 3) and found.dtype == np.float32
        assert np.isfinite(found).all() and (found >= 0).all() and found.max() > 0
    np.testing.assert_array_equal(found, picture(scene, spp, denoiser="high"))
    assert not np.array_equal(picture(scene, spp), picture(scene, spp, seed=1))


def test_few_samples_have_the_light_of_many() -> None:
    """The mean over seeds is that of 1024 samples, in blocks, within five standard errors."""
    scene = sampled_like_scene(np.random.default_rng(3), num_views=1)

    def blocks(spp: int, seeds: range) -> NDArray[np.float64]:
        renderer = loaded(scene, spp, resolution=16)
        pictures = [shown(renderer, scene, spp, seed).radiance_rgb for seed in seeds]
        return np.array(pictures, np.float64).reshape(-1, 4, 4, 4, 4, 3).mean(axis=(2, 4, 5))

    many = blocks(64, range(1000, 1016))
    for spp in (1, 5):
        few = blocks(spp, range(40))
        error = np.sqrt(few.var(axis=0, ddof=1) / len(few) + many.var(axis=0, ddof=1) / len(many))
        off = np.abs(few.mean(axis=0) - many.mean(axis=0))
        assert (off <= SIGMAS * error + 1e-6).all(), spp  # black blocks have no spread


def test_more_samples_and_a_denoiser_come_nearer() -> None:
    scene = sampled_like_scene(np.random.default_rng(3), num_views=1)
    truth = picture(scene, 512, 99)

    def error(spp: int, denoiser: str) -> float:
        found = picture(scene, spp, denoiser=denoiser)
        return float(np.square(np.log1p(found) - np.log1p(truth)).mean())

    assert error(64, "off") < error(4, "off") < error(1, "off")
    # found 2.5 times nearer; half of that is left for luck
    assert error(1, "fast") < error(1, "off") / 1.25


def test_what_cannot_be_a_preview_is_refused() -> None:
    with pytest.raises(TrilightError, match="spp is 0; expected a whole number from 1 to 4096"):
        PreviewSettings(resolution=32, spp=0)
    with pytest.raises(TrilightError, match="resolution is 36; expected a multiple of 8"):
        PreviewSettings(resolution=36, spp=1)
    scene = tiny_scene()
    lamps = scene.materials.copy()
    lamps[:, 7:10] = 1.0
    with pytest.raises(Rejected, match="no_surfaces"):
        made(tiny_scene(materials=lamps), 1)


@pytest.mark.parametrize("emission", [1e6, 1e20, 3e35])
def test_light_that_no_file_holds_is_refused_and_not_hidden(emission: float) -> None:
    """From about 5e36 on the denoiser would return black."""
    bright = tiny_scene()
    bright.materials[:, 7:10] *= emission
    for denoiser in ("off", "fast"):
        with pytest.raises(Rejected, match="radiance_overflow|nonfinite_radiance"):
            made(bright, 4, denoiser=denoiser)
