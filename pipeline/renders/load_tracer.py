"""Chooses the tracer for the variant that runs."""

from pipeline.renders.tracer import Tracer
from storage.records.scene import Scene


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the fastest tracer of the variant that `activate` has set, with the scene loaded."""
    import mitsuba  # not before `activate`, which says where compiled kernels are kept

    if mitsuba.variant() != "scalar_rgb":
        from pipeline.renders.vector_tracer import VectorTracer

        return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    from pipeline.renders.plugin_tracer import PluginTracer

    return PluginTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
