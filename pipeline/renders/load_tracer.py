"""Loads a scene into the tracer, without importing Mitsuba before it is activated."""

import dataclasses
import math

import numpy as np

from pipeline.renders.tracer import Tracer, split_triangles
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene

SIZES_AS_THEY_ARE_M = (0.1, 10.0)
"""Scenes between these sizes are traced as they are; all presets' scenes are."""


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the tracer of a scene; call after `activate`.

    Textures of one value are the constants that they are: they cost nothing.
    """
    from pipeline.renders.vector_tracer import VectorTracer  # imports mitsuba

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
