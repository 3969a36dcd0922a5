"""Pictures with their own standard errors, for tests that compare estimates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.tracer import Tracer
from storage.records.scene import Scene

SIGMAS = 5.0
"""How many standard errors an honest estimate may be off: 1 in 2 million for one value, so that a
test of some thousand values fails once in a thousand seeds, and the seeds here are fixed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Means of independent passes with the standard error of each."""

    mean: NDArray[np.float64]
    error: NDArray[np.float64]


def camera_of(scene: Scene, resolution: int, view: int = 0) -> Camera:
    return Camera(
        c2w=scene.c2w[view].astype(np.float64),
        fov_deg=float(scene.fov_deg[view]),
        resolution=resolution,
    )


def render_blocks(
    scene: Scene,
    *,
    resolution: int = 32,
    block: int = 4,
    passes: int = 16,
    max_depth: int = 10,
    rr_depth: int = 5,
    first_seed: int = 0,
    tracer: Tracer | None = None,
) -> Estimate:
    """Return the means of `block` x `block` pixels, [R / block, R / block, 3]."""
    traced = tracer or load_tracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    camera = camera_of(scene, resolution)
    count = resolution // block
    pictures = [traced.radiance(camera, seed=first_seed + k, spp=64) for k in range(passes)]
    cells = np.array(pictures, np.float64).reshape(passes, count, block, count, block, 3)
    blocks = cells.mean(axis=(2, 4))
    return Estimate(mean=blocks.mean(axis=0), error=blocks.std(axis=0, ddof=1) / np.sqrt(passes))


def assert_agree(a: Estimate, b: Estimate, *, slack: float = 0.0) -> None:
    """Compare two estimates by their standard errors; `slack` is a relative model error."""
    error = np.hypot(a.error, b.error)
    allowed = SIGMAS * error + slack * np.abs(b.mean) + 1e-7
    excess = np.abs(a.mean - b.mean) / allowed
    assert excess.max() < 1, f"off by {excess.max():.2f} of what is allowed at {excess.argmax()}"


def exact(mean: NDArray[np.float64]) -> Estimate:
    return Estimate(mean=mean, error=np.zeros_like(mean))
