"""`load_tracer`: a scene for `VectorTracer`, whose module imports Mitsuba, and cameras of it.

The tests have another tracer, Mitsuba's stock path integrator (tests/oracle): an independent twin
that estimates the same integral.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.renders.settings import RenderSettings
from storage.errors import Rejected
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene

if TYPE_CHECKING:
    from pipeline.renders.vector_tracer import VectorTracer


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelCamera:
    """A square picture's camera, as storage.conventions means it."""

    c2w: NDArray[np.float64]
    """[4, 4] camera to world; looks along -Z with +Y up."""
    fov_deg: float
    """Full field of view, equal in width and height."""
    resolution: int
    """Width and height in pixels."""


def pixel_camera(c2w: ArrayLike, fov_deg: float, resolution: int) -> PixelCamera:
    """Return the camera of a pose and an angle of any number type."""
    pose = np.asarray(c2w, np.float64)
    return PixelCamera(c2w=pose, fov_deg=float(fov_deg), resolution=resolution)


Chosen = NDArray[np.bool_] | None
"""[R, R] the pixels of a pass, one at least; None means all of them."""


def split_triangles(scene: Scene) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the triangle rows of surfaces and those of emitters."""
    emits = scene.triangle_emits
    return np.flatnonzero(~emits), np.flatnonzero(emits)


SIZES_AS_THEY_ARE_M = (0.1, 10.0)
"""Scenes between these sizes are traced as they are; all presets' scenes are."""


def load_tracer(
    scene: Scene,
    *,
    max_depth: int = RenderSettings.max_depth,
    rr_depth: int = RenderSettings.rr_depth,
) -> "VectorTracer":
    """Return the tracer of a scene; call after `activate`.

    Textures of one value are the constants that they are: they cost nothing.

    Raises:
        Rejected: "unlit_scene"; "no_surfaces" where all triangles emit: pictures would be black.
    """
    from pipeline.renders.vector_tracer import VectorTracer  # imports mitsuba

    if scene.triangle_emits.all():
        raise Rejected("no_surfaces", f"all {scene.num_triangles} triangles are emitters")
    scale = choose_tracing_scale(scene)
    scene = without_constant_textures(scene)
    if scale != 1:
        scene = dataclasses.replace(
            scene, vertex_positions=scene.vertex_positions * np.float32(scale)
        )
    return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth, scale=scale)


def choose_tracing_scale(scene: Scene) -> float:
    """Return what lengths are multiplied by for tracing: 1, or a power of two (exact in floats).

    Mitsuba moves the origins of rays off surfaces by lengths that suit a scene of a metre. In a
    scene of a millimetre they would pass through walls, and the stated error would not show it.
    Radiance knows no length, so a tiny or huge scene is traced at the size of about a metre. Size
    is the diagonal of what is seen: emitters and cameras may be far away.
    """
    surfaces, _ = split_triangles(scene)
    corners = scene.vertex_positions[np.unique(scene.faces[surfaces])].astype(np.float64)
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    smallest, largest = SIZES_AS_THEY_ARE_M
    return 1.0 if size == 0 or smallest <= size <= largest else 2.0 ** -round(math.log2(size))
