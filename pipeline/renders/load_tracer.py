"""Chooses the tracer for the variant that runs."""

from pipeline.renders.tracer import Tracer
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the fastest tracer of the variant that `activate` has set, with the scene loaded.

    Textures of one value are the constants that they are: they cost nothing.
    """
    scene = without_constant_textures(scene)
    import mitsuba  # not before `activate`, which says where compiled kernels are kept

    if mitsuba.variant() != "scalar_rgb":
        from pipeline.renders.vector_tracer import VectorTracer

        return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    from pipeline.renders.plugin_tracer import PluginTracer

    return PluginTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
