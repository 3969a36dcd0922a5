"""Pictures that become better while somebody looks at them, in a child process with limits.

Unlike pipeline.making.path_tracer it hands on each look, gives up where it is told to, and changes
scene, camera, width and depth between two pictures.
"""

import threading
from collections.abc import Callable, Generator, Hashable

import numpy as np
from numpy.typing import NDArray

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, with_retries
from pipeline.making.path_tracer import set_up_renderer
from pipeline.renders.progressive import ProgressiveRenderer
from pipeline.renders.results import GrowingPicture, Sampling
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=600, calls_per_child=1 << 30)

MOST_SCENES = 2
"""Scenes and settings that the child keeps loaded."""


class ProgressiveTracer:
    """Renders one picture at a time, whoever asks; the child starts with the first."""

    def __init__(self, *, variant: Variant, threads: int) -> None:
        """Remember how to start; `variant` is what Mitsuba runs on."""
        self._child = IsolatedChild(
            limits=_LIMITS, setup=set_up_renderer, setup_args=(variant, threads)
        )
        self._one_at_a_time = threading.Lock()

    def paint(
        self,
        scene: Scene,
        key: Hashable,
        camera: tuple[NDArray[np.float32], float],
        settings: RenderSettings,
        shown: Callable[[Sampling], None],
        *,
        preview_spp: int | None = None,
    ) -> None:
        """Make one picture; `shown` receives its looks, and between them how far it is.

        Args:
            scene: passes `Scene.check`.
            key: equal for equal scenes.
            camera: pose [4, 4] and full field of view in degrees.
            settings: how good the picture is to become.
            shown: may raise, which ends the picture.
            preview_spp: samples of a preview, which is made in place of the picture that grows.

        Raises:
            TrilightError: it cannot be rendered.
        """
        try:
            with self._one_at_a_time:
                begin = ((key, settings), camera, preview_spp)
                with_retries(lambda: self._paint(scene, begin, shown))
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

    def _paint(self, scene: Scene, begin: "_Begin", shown: Callable[[Sampling], None]) -> None:
        if not self._child.call(_begin, None, *begin):
            self._child.call(_begin, scene, *begin)
        while (step := self._child.call(_advance)) is not None:
            shown(step)


_Camera = tuple[NDArray[np.float32], float]
_Begin = tuple[tuple[Hashable, RenderSettings], _Camera, int | None]
"""Scene with its settings, camera, and samples of a preview."""


class _ChildOfLooks:
    """What the child holds between two calls."""

    steps: Generator[Sampling, None, GrowingPicture]

    def __init__(self) -> None:
        self.loaded: dict[Hashable, ProgressiveRenderer] = {}
        self.ended = True


_state = _ChildOfLooks()


def _begin(
    scene: Scene | None,
    key: tuple[Hashable, RenderSettings],
    camera: _Camera,
    preview_spp: int | None,
) -> bool:
    """Begin a picture; return whether the scene, if it is not given, is still loaded."""
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
    """Return the next step; None after the last."""
    if _state.ended:
        return None
    try:
        return next(_state.steps)
    except StopIteration as end:
        _state.ended = True
        last: GrowingPicture = end.value
        return last
