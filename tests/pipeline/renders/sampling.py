"""Pictures with their own standard errors, for tests that compare estimates, and a closed form."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.renders.pictures import (
    NUMPY,
    Halves,
    estimates,
    floors_of,
    join_halves,
    metric_counts,
)
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import PixelCamera, load_tracer, pixel_camera
from storage.records.sample import PictureErrors
from storage.records.scene import Scene

SIGMAS = 5.0
"""How many standard errors an honest estimate may be off: 1 in 2 million for one value, so that a
test of some thousand values fails once in a thousand seeds, and the seeds here are fixed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Means of independent passes with the standard error of each."""

    mean: NDArray[np.float64]
    error: NDArray[np.float64]
    freedom: float = np.inf
    """Degrees of freedom of the errors: one less than the passes."""


def camera_of(scene: Scene, resolution: int, view: int = 0) -> PixelCamera:
    return pixel_camera(scene.c2w[view], scene.fov_deg[view], resolution)


def view_settings(spp: int, **changes: Any) -> RenderSettings:
    """Return settings of 32 pixels and so many samples, whose target of 99 dB no view reaches."""
    plain = {"resolution": 32, "noise_floor_db": 99.0, "min_spp": spp, "max_spp": spp}
    return RenderSettings(**{**plain, **changes})


def render_view(
    scene: Scene, settings: RenderSettings, seed: int = 0, light_seed: int | None = None
) -> RenderedView:
    """Return the first view of a scene, as the stage makes it."""
    renderer = SceneRenderer(scene, settings, light_seed=light_seed)
    return renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)


def render_blocks(
    scene: Scene,
    *,
    resolution: int = 32,
    block: int = 4,
    passes: int = 16,
    max_depth: int = 10,
    rr_depth: int = 5,
    first_seed: int = 0,
    tracer: Any = None,
) -> Estimate:
    """Return the means of `block` x `block` pixels, [R / block, R / block, 3]."""
    traced = tracer or load_tracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    pictures = render_passes(
        traced, scene, resolution=resolution, passes=passes, first_seed=first_seed
    )
    return blocks_of(pictures, block)


def render_passes(
    tracer: Any, scene: Scene, *, resolution: int = 32, passes: int, first_seed: int = 0
) -> NDArray[np.float64]:
    """Return independent pictures of 64 samples, [passes, R, R, 3]."""
    camera, seeds = camera_of(scene, resolution), range(first_seed, first_seed + passes)
    return np.array([tracer.radiance(camera, seed=seed, spp=64) for seed in seeds], np.float64)


def blocks_of(pictures: NDArray[np.float64], block: int) -> Estimate:
    """Return the means of `block` x `block` pixels of independent pictures."""
    cells, passes = block_means(pictures, block), len(pictures)
    error = cells.std(axis=0, ddof=1) / np.sqrt(passes)
    return Estimate(mean=cells.mean(axis=0), error=error, freedom=passes - 1)


def block_means(pictures: NDArray, block: int) -> NDArray[np.float64]:
    """Return pictures [..., R, R, 3] as means of `block` x `block` pixels."""
    *more, size, _, _ = pictures.shape
    cut = pictures.reshape(*more, size // block, block, size // block, block, 3)
    means: NDArray[np.float64] = cut.astype(np.float64).mean(axis=(-4, -2))
    return means


def assert_same_light(a: NDArray[np.float64], b: NDArray[np.float64], *, name: str = "") -> None:
    """Compare independent pictures of 32 x 32 pixels in blocks, and as a whole."""
    for block in (4, 32):
        assert_agree(blocks_of(a, block), blocks_of(b, block), name=f"{name} by {block} pixels")


def assert_agree(a: Estimate, b: Estimate, *, slack: float = 0.0, name: str = "") -> None:
    """Compare two estimates by their standard errors; `slack` is a relative model error.

    Errors of few passes are themselves uncertain: more of them are allowed, so that one value in a
    hundred thousand is off. `name` is the case, where a test compares several.
    """
    freedoms = [each.freedom for each in (a, b) if np.any(each.error)]
    assert min(freedoms, default=np.inf) >= 7, "too few passes to compare"
    few = sum(freedoms)
    sigmas = max(SIGMAS, float(stats.t.isf(5e-6, few))) if few else SIGMAS
    error = np.hypot(a.error, b.error)
    allowed = sigmas * error + slack * np.abs(b.mean) + 1e-7
    excess = np.abs(a.mean - b.mean) / allowed
    off = f"off by {excess.max():.2f} of what is allowed at {excess.argmax()}"
    assert excess.max() < 1, f"{name}: {off}" if name else off


def assert_honest(ours: Estimate, theirs: Estimate, most: float = 1.3, bias: float = 0.35) -> None:
    """Compare what is lit in standard errors: they spread by about 1, around 0.

    Errors estimated from 16 passes each: the scores spread by 1.04 if both are unbiased, and a bias
    of a third of the noise in every block would show in the mean of some 100 scores.
    """
    score = scores(ours, theirs)
    assert 0.8 < np.sqrt(np.mean(score**2)) < most
    assert len(score) > 90 and abs(score.mean()) < bias


def scores(ours: Estimate, theirs: Estimate) -> NDArray[np.float64]:
    """Return the differences of what is lit, in standard errors."""
    lit = ours.mean > 0.01 * ours.mean.max()
    return (ours.mean - theirs.mean)[lit] / np.hypot(ours.error, theirs.error)[lit]


class Half(NamedTuple):
    """One half of the samples of a view, [R, R, 3], raw and denoised."""

    raw_rgb: NDArray[np.float32]
    denoised_rgb: NDArray[np.float32]


def halves_of(a: Half, b: Half) -> Halves:
    return join_halves(a.raw_rgb, b.raw_rgb, a.denoised_rgb, b.denoised_rgb, NUMPY)


def floor_of(a: Half, b: Half, hits: NDArray[np.bool_]) -> PictureErrors:
    """Return the floor of the picture made from both halves."""
    is_filtered = not np.array_equal(*a)
    rows, nothing = estimates(halves_of(a, b), hits, NUMPY, is_filtered), np.zeros(hits.shape)
    errors, surprises = zip(*rows, strict=True)
    row = NUMPY.one_row([], [nothing] * 3 + list(errors), [*surprises, nothing], [])
    adds, most = np.split(row.reshape(10, -1), [6])
    (floor,) = floors_of(adds, most, metric_counts(hits))
    return floor


def exact(mean: NDArray[np.float64]) -> Estimate:
    return Estimate(mean=mean, error=np.zeros_like(mean))


def lambert_irradiance(
    points: NDArray, normal: NDArray, polygon: NDArray, radiance: float
) -> NDArray:
    """Lambert's formula for a polygon that is wholly above the horizon of every point."""
    spokes = polygon[None] - points[:, None]
    spokes /= np.linalg.norm(spokes, axis=-1, keepdims=True)
    total = np.zeros(len(points))
    for corner in range(len(polygon)):
        a, b = spokes[:, corner], spokes[:, (corner + 1) % len(polygon)]
        edge = np.cross(a, b)
        edge /= np.linalg.norm(edge, axis=-1, keepdims=True)
        angle = np.arccos(np.clip((a * b).sum(-1), -1, 1))
        total += angle * (edge @ normal)
    return np.abs(total) * radiance / 2
