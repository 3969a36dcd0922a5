"""Chooses the tracer for the variant that runs."""

from pipeline.renders.tracer import Tracer
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.records.scene_maps import has_maps


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the fastest tracer of the variant that `activate` has set, with the scene loaded.

    Raises:
        TrilightError: the scene has textures or an environment, which no tracer knows yet: their
            picture would be that of another scene.
    """
    if has_maps(scene):
        raise TrilightError(
            "scene: it has textures or an environment; expected neither, since renderers do not "
            "know them yet. `trilight convert` writes it without them, in a form that has none."
        )
    import mitsuba  # not before `activate`, which says where compiled kernels are kept

    if mitsuba.variant() != "scalar_rgb":
        from pipeline.renders.vector_tracer import VectorTracer

        return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
    from pipeline.renders.plugin_tracer import PluginTracer

    return PluginTracer(scene, max_depth=max_depth, rr_depth=rr_depth)
