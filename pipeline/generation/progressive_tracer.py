"""`ProgressiveTracer`: renders pictures that improve while they are shown, in a child with limits.

Unlike pipeline.generation.path_tracer it passes on each intermediate picture, can be canceled, and
changes scene, camera, width and depth between two pictures.
"""

import threading
from collections.abc import Callable, Generator, Hashable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.generation.path_tracer import set_up_renderer
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, with_retries
from pipeline.renders.progressive import ProgressiveRenderer
from pipeline.renders.results import GrowingPicture, Sampling
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=600, calls_per_child=1 << 30)

MOST_SCENES = 2
"""Number of pairs of a scene and settings that the child keeps loaded."""


class ProgressiveTracer:
    """Renders one picture at a time, for all threads; the child starts with the first picture."""

    def __init__(self, *, variant: Variant, threads: int) -> None:
        """Configure the child: Mitsuba's variant, and the number of CPU threads."""
        self._child = IsolatedChild(
            limits=replace(_LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes)),
            setup=set_up_renderer,
            setup_args=(variant, threads),
        )
        self._one_at_a_time = threading.Lock()

    def render(
        self,
        scene: Scene,
        key: Hashable,
        camera: tuple[NDArray[np.float32], float],
        settings: RenderSettings,
        on_look: Callable[[Sampling], None],
        *,
        preview_spp: int | None = None,
    ) -> None:
        """Render one picture; the callback receives intermediate pictures and progress.

        Args:
            scene: a scene that passes `Scene.check`.
            key: key of the scene, equal for equal scenes.
            camera: pose [4, 4] and full field of view in degrees.
            settings: target quality of the picture.
            on_look: receives each step; may raise, which ends the picture.
            preview_spp: samples of a preview that is rendered instead of the progressive picture.

        Raises:
            TrilightError: the scene cannot be rendered.
        """
        try:
            with self._one_at_a_time:
                begin = ((key, settings), camera, preview_spp)
                with_retries(lambda: self._render(scene, begin, on_look))
        except Rejected as rejection:
            raise TrilightError(
                f"the scene cannot be rendered ({rejection}); expected surfaces, lights with an "
                "area, and radiance that half floats can hold."
            ) from rejection
        except ChildFailed as failure:
            raise TrilightError(
                f"rendering failed ({failure}); choose fewer pixels, and see `trilight doctor`."
            ) from failure

    def close(self) -> None:
        """End the child."""
        self._child.close()

    def _render(self, scene: Scene, begin: "_Begin", on_look: Callable[[Sampling], None]) -> None:
        if not self._child.call(_begin, None, *begin):
            self._child.call(_begin, scene, *begin)
        while (step := self._child.call(_advance)) is not None:
            on_look(step)


_Camera = tuple[NDArray[np.float32], float]
_Begin = tuple[tuple[Hashable, RenderSettings], _Camera, int | None]
"""Scene key with its settings, camera, and samples of a preview."""


class _ChildState:
    """State of the child between two calls."""

    steps: Generator[Sampling, None, GrowingPicture]

    def __init__(self) -> None:
        self.loaded: dict[Hashable, ProgressiveRenderer] = {}
        self.ended = True


_state = _ChildState()


def _begin(
    scene: Scene | None,
    key: tuple[Hashable, RenderSettings],
    camera: _Camera,
    preview_spp: int | None,
) -> bool:
    """Begin a picture; return False if no scene is given and it is no longer loaded."""
    renderer = _state.loaded.pop(key, None)
    if renderer is None:
        if scene is None:
            return False
        while len(_state.loaded) >= MOST_SCENES:
            del _state.loaded[next(iter(_state.loaded))]
        renderer = ProgressiveRenderer(scene, key[1])
    _state.loaded[key] = renderer
    _state.ended = False
    if preview_spp is None:
        _state.steps = renderer.view_steps(*camera, 0)
    else:
        _state.steps = renderer.preview_steps(*camera, 0, preview_spp)
    return True


def _advance() -> Sampling | GrowingPicture | None:
    """Return the next step; None after the last one."""
    if _state.ended:
        return None
    try:
        return next(_state.steps)
    except StopIteration as end:
        _state.ended = True
        last: GrowingPicture = end.value
        return last
