"""Loads a scene into the tracer, without importing Mitsuba before it is activated."""

from pipeline.renders.tracer import Tracer
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the tracer of a scene; call after `activate`.

    Textures of one value are the constants that they are: they cost nothing.
    """
    from pipeline.renders.vector_tracer import VectorTracer  # imports mitsuba

    scene = without_constant_textures(scene)
    return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
