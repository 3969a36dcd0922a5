"""Chooses the tracer for the variant that runs."""

from pipeline.renders.tracer import Tracer
from storage.errors import TrilightError
from storage.records.scene import Scene


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the fastest tracer of the variant that `activate` has set, with the scene loaded.

    Raises:
        TrilightError: the scene has textures, which no tracer knows yet: its picture would be that
            of another scene.
    """
    if scene.textures:
        raise TrilightError(
            "scene: it has textures; expected none, since renderers do not know them yet. "
            "`trilight convert` writes it without them, in a form that has none."
        )
    import mitsuba  # not before `activate`, which says where compiled kernels are kept

    if mitsuba.variant() != "scalar_rgb":
        from pipeline.renders.vector_tracer import VectorTracer

        return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    from pipeline.renders.plugin_tracer import PluginTracer

    return PluginTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
