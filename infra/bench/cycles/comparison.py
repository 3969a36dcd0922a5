"""Cycles and our renderer on the same views: what each picture took, and how far off it is.

Two references are rendered with other samples, because neither is neutral: one by our renderer,
which favours ours, and the best picture of Cycles, which favours Cycles. Where the two renderers
differ in the light that they transport, each is only as close to the other's as that difference.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.cycles.child import described_scene, our_picture, sampled_scene
from infra.bench.cycles.cycles_picture import Request, cycles_picture
from pipeline.isolation import IsolatedChild
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.scene import Scene

CYCLES, OURS = "cycles", "trilight"
_REFERENCE_SEED = 1_000_003


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is rendered, of every scene."""

    resolution: int
    """Width and height in pixels."""
    cycles_spp: tuple[int, ...]
    """Samples per pixel of Cycles' pictures, all denoised; the largest is a reference as well."""
    our_spp: tuple[int, ...]
    """Of ours: multiples of 128."""
    reference_spp: int
    """Of the picture by our renderer that errors are measured to."""
    threads: int
    """Of either renderer."""


@dataclass(frozen=True, kw_only=True)
class NamedScene:
    """A scene that a child can make again."""

    name: str
    """What the table calls it."""
    make: Callable[[IsolatedChild], Scene] = field(repr=False)
    """Makes it in a child."""
    publishable: bool
    """Whether pictures of it may be published: it holds built-in objects only."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One picture that was timed and judged."""

    renderer: str
    """`cycles` or `trilight`."""
    spp: int
    """Samples per pixel."""
    render_s: float
    """Seconds on the clock, without what comes before the first sample."""
    core_s: float
    """Core-seconds: what to compare on a machine that has other work."""
    log_db: float
    """psnr_log_db to the reference of our renderer."""
    linear_db: float
    """psnr_linear_db to the same."""
    log_db_to_cycles: float | None
    """psnr_log_db to the best picture of Cycles; None for that picture itself."""
    linear_db_to_cycles: float | None
    """psnr_linear_db to the same."""


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """All pictures of one scene."""

    name: str
    """Of the scene."""
    num_triangles: int
    """Of the scene, emitters included."""
    shots: tuple[Shot, ...]
    """Cycles and ours in turns."""


def described(root: Path, name: str) -> NamedScene:
    """Return a scene of a folder of RenderFormer files."""
    return NamedScene(
        name=Path(name).stem,
        make=lambda child: child.call(described_scene, root, name),
        publishable=False,
    )


def sampled(scene_index: int) -> NamedScene:
    """Return a scene that the build `smoke` would compose of the child's objects."""
    return NamedScene(
        name=f"sampled {scene_index}",
        make=lambda child: child.call(sampled_scene, scene_index),
        publishable=True,
    )


def num_pictures(plan: Plan) -> int:
    """Return how many pictures of every scene are rendered."""
    return len(plan.cycles_spp) + len(plan.our_spp) + 1


def compare_scene(
    named: NamedScene, plan: Plan, child: IsolatedChild, picture_done: Callable[[], None]
) -> SceneResult:
    """Render one scene's first view with both renderers, in turns.

    Args:
        named: the scene.
        plan: what to render.
        child: set up with pipeline.flows.make_scene.set_up_child and `plan.threads`.
        picture_done: called after every picture that counts.

    Raises:
        TrilightError: Blender cannot be had, or the scene cannot be made.
    """
    scene = named.make(child)
    taken: list[_Taken] = []
    for step in range(max(len(plan.cycles_spp), len(plan.our_spp))):
        for spp in plan.cycles_spp[step : step + 1]:
            taken.append(_by_cycles(scene, plan, spp))
            picture_done()
        for spp in plan.our_spp[step : step + 1]:
            taken.append(_by_us(scene, plan, child, spp, seed=spp))
            picture_done()
    reference = _by_us(scene, plan, child, plan.reference_spp, seed=_REFERENCE_SEED)
    picture_done()
    best = max((one for one in taken if one.renderer == CYCLES), key=lambda one: one.spp)
    return SceneResult(
        name=named.name,
        num_triangles=scene.num_triangles,
        shots=tuple(_judged(one, reference.radiance_rgb, best) for one in taken),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Taken:
    renderer: str
    spp: int
    radiance_rgb: NDArray[np.float32]
    render_s: float
    core_s: float


def _by_cycles(scene: Scene, plan: Plan, spp: int) -> _Taken:
    request = Request(
        resolution=plan.resolution, spp=spp, denoise=True, seed=spp, threads=plan.threads
    )
    picture = cycles_picture(scene, 0, request)
    return _Taken(
        renderer=CYCLES,
        spp=spp,
        radiance_rgb=picture.radiance_rgb,
        render_s=picture.render_s,
        core_s=picture.core_s,
    )


def _by_us(scene: Scene, plan: Plan, child: IsolatedChild, spp: int, seed: int) -> _Taken:
    picture = child.call(our_picture, scene, 0, plan.resolution, spp, seed)
    return _Taken(
        renderer=OURS,
        spp=spp,
        radiance_rgb=picture.radiance_rgb,
        render_s=picture.render_s,
        core_s=picture.core_s,
    )


def _judged(one: _Taken, reference: NDArray[np.float32], best: _Taken) -> Shot:
    itself = one is best
    return Shot(
        renderer=one.renderer,
        spp=one.spp,
        render_s=one.render_s,
        core_s=one.core_s,
        log_db=psnr_log_db(one.radiance_rgb, reference),
        linear_db=psnr_linear_db(one.radiance_rgb, reference),
        log_db_to_cycles=None if itself else psnr_log_db(one.radiance_rgb, best.radiance_rgb),
        linear_db_to_cycles=None if itself else psnr_linear_db(one.radiance_rgb, best.radiance_rgb),
    )


def ratio_at_equal_samples(result: SceneResult, spp: int) -> float | None:
    """Return core-seconds of Cycles by ours, or None where one has no picture of `spp`."""
    seconds = {shot.renderer: shot.core_s for shot in result.shots if shot.spp == spp}
    return seconds[CYCLES] / seconds[OURS] if len(seconds) == 2 else None


def ratio_at_equal_error(result: SceneResult, spp: int) -> float | None:
    """Return core-seconds of Cycles at `spp` by the cheapest of ours that is no further off.

    Errors are psnr_log_db to our reference, which favours ours. None where no picture is so good.
    """
    theirs = next(shot for shot in result.shots if (shot.renderer, shot.spp) == (CYCLES, spp))
    enough = [
        shot.core_s
        for shot in result.shots
        if shot.renderer == OURS and shot.log_db >= theirs.log_db
    ]
    return theirs.core_s / min(enough) if enough else None
