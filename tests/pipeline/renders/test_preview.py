"""Previews of any number of samples, the parts that price them, and pictures that grow."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pipeline.renders import preview
from pipeline.renders.preview import (
    FIRST_LOOKS_SPP,
    PreviewSettings,
    all_parts,
    load_preview,
    preview_parts,
    timed_parts,
    usual_filter,
)
from pipeline.renders.renderer import RenderedView, SceneRenderer, run_to_end
from pipeline.renders.settings import Filtered
from pipeline.renders.tracer import PixelCamera
from storage.denoiser import Features
from storage.errors import Rejected, TrilightError
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from storage.renderer import Image, Sampling
from tests.pipeline.renders.sampling import Estimate, assert_agree, blocks_of, view_settings
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.scenes_by_hand import tiny_scene

Steps = Callable[[ArrayLike, float, int], Iterator[Sampling | Image]]


def loaded(scene: Scene, spp: int, **changes: Any) -> Steps:
    settings = PreviewSettings(**{"resolution": 32, "spp": spp, "denoiser": "off", **changes})
    return load_preview(scene, settings)


def picture(view_steps: Steps, scene: Scene, seed: int = 0) -> NDArray[np.float32]:
    steps = view_steps(scene.c2w[0], float(scene.fov_deg[0]), seed)
    *told, found = steps
    assert isinstance(found, Image) and found.stated_error_db is None
    assert isinstance(told[-1], Sampling) and told[-1].spp == found.samples
    assert all(isinstance(step, Sampling) and step.missing_db is None for step in told)
    return found.radiance_rgb


@pytest.mark.parametrize("spp", [1, 7, 85])
def test_any_number_of_samples_is_a_picture(spp: int) -> None:
    scene = tiny_scene()
    for denoiser in ("off", "fast", "high"):
        view_steps = loaded(scene, spp, denoiser=denoiser)
        found = picture(view_steps, scene)
        assert found.shape == (32, 32, 3) and found.dtype == np.float32
        assert np.isfinite(found).all() and (found >= 0).all() and found.max() > 0
        np.testing.assert_array_equal(found, picture(view_steps, scene))
        assert not np.array_equal(found, picture(view_steps, scene, seed=1))


def test_few_samples_have_the_light_of_many() -> None:
    """The mean over seeds is that of 1024 samples, in blocks, within five standard errors."""
    scene = sampled_like_scene(np.random.default_rng(3), num_views=1)

    def blocks(spp: int, seeds: range) -> Estimate:
        view_steps = loaded(scene, spp, resolution=16)
        return blocks_of(np.array([picture(view_steps, scene, seed) for seed in seeds]), 4)

    many = blocks(64, range(1000, 1016))
    for spp in (1, 5):
        assert_agree(blocks(spp, range(40)), many, name=f"{spp} samples")


def test_what_cannot_be_a_preview_is_refused() -> None:
    with pytest.raises(TrilightError, match="spp is 0; expected a whole number from 1 to 4096"):
        PreviewSettings(resolution=32, spp=0)
    with pytest.raises(TrilightError, match="resolution is 36; expected a multiple of 8"):
        PreviewSettings(resolution=36, spp=1)
    lamps = tiny_scene().materials.copy()
    lamps[:, 7:10] = 1.0
    with pytest.raises(Rejected, match="no_surfaces"):
        loaded(tiny_scene(materials=lamps), 1)
    for emission in (1e6, 1e20, 3e35):  # from about 5e36 on the denoiser would return black
        bright = tiny_scene()
        bright.materials[:, 7:10] *= emission
        for denoiser in ("off", "fast"):
            with pytest.raises(Rejected, match="radiance_overflow|nonfinite_radiance"):
                picture(loaded(bright, 4, denoiser=denoiser), bright)


class CountingTracer:
    """Makes flat pictures, and remembers by the names of parts what it was asked for."""

    def __init__(self) -> None:
        self.asked: Counter[str] = Counter()

    def radiance(self, camera: PixelCamera, *, seed: int, spp: int) -> Any:
        self.asked[f"pass of {spp}"] += 1
        return np.ones((camera.resolution, camera.resolution, 3), np.float32)

    def features(self, camera: PixelCamera, *, spp: int) -> Features:
        self.asked[f"guides of {spp}"] += 1
        flat = np.ones((camera.resolution, camera.resolution, 3), np.float32)
        return Features(albedo=flat, normal=flat)


@pytest.mark.parametrize("denoiser", ["off", "fast", "high"])
def test_a_preview_is_made_of_its_parts(
    denoiser: Filtered, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracer, scene = CountingTracer(), tiny_scene()
    monkeypatch.setattr(preview, "load_tracer", lambda scene, **depths: tracer)

    def filtered(picture: Any, features: Features, quality: str) -> Any:
        tracer.asked[quality] += 1
        return picture

    monkeypatch.setattr(preview, "denoise", filtered)
    for spp in (1, 2, 3, 15, 16, 63, 64, 85, 1024, 4096):
        tracer.asked.clear()
        settings = PreviewSettings(resolution=8, spp=spp, denoiser=denoiser)
        run_to_end(load_preview(scene, settings)(scene.c2w[0], 40.0, 0))
        assert tracer.asked == preview_parts(spp, denoiser), spp
        assert set(tracer.asked) <= set(all_parts())


def test_each_part_is_timed_in_its_order() -> None:
    """A clock that ticks once a look gives each part one tick, since each is timed between two."""
    ticks = iter(range(10_000))
    found = timed_parts(tiny_scene(), 16, lambda: float(next(ticks)))
    assert set(found) == set(all_parts())
    assert set(found.values()) == {1.0}
    parts = preview_parts(8, "fast")  # two passes, guides and the filter
    assert sum(count * found[name] for name, count in parts.items()) == 4


GROWING = view_settings(16, max_spp=256, min_mean_radiance=0.0)


def test_the_first_looks_are_previews_and_the_last_picture_is_the_measured_one() -> None:
    scene = tiny_scene()
    view = run_to_end(SceneRenderer(scene, GROWING).view_steps(scene.c2w[0], 45.0, 7))
    *steps, last = SceneRenderer(scene, GROWING, shows_looks=True).view_steps(scene.c2w[0], 45.0, 7)
    assert isinstance(last, RenderedView) and last.noise_floor_db == view.noise_floor_db
    np.testing.assert_array_equal(last.radiance_rgb, view.radiance_rgb)
    assert all(isinstance(step, Sampling) for step in steps)
    seen = [step.image for step in steps if isinstance(step, Sampling) and step.image]
    few = len(FIRST_LOOKS_SPP)
    for look, spp in zip(seen[:few], FIRST_LOOKS_SPP, strict=True):
        view_steps = loaded(scene, spp, denoiser=usual_filter(spp))
        alone = run_to_end(view_steps(scene.c2w[0], 45.0, 7))
        np.testing.assert_array_equal(look.radiance_rgb, alone.radiance_rgb)
        assert (look.samples, look.stated_error_db) == (spp, None) and (look.cpu_seconds or 0) > 0
    measured = seen[few:]
    counts = [look.samples or 0 for look in measured]
    assert counts and counts == sorted(set(counts))
    assert all(look.stated_error_db is not None for look in measured)
    errors_db = [psnr_log_db(look.radiance_rgb, view.radiance_rgb) for look in seen]
    assert errors_db[few] > errors_db[0] + 3
    spent = [*(look.cpu_seconds or 0 for look in measured), last.core_s]
    assert spent == sorted(spent)
