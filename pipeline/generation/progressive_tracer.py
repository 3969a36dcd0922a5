"""`ProgressiveTracer`: renders pictures that improve while they are shown, in a child with limits.

Unlike pipeline.generation.path_tracer it passes on each intermediate picture, can be canceled, and
changes scene, camera, width and depth between two pictures.
"""

import threading
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, with_retries
from pipeline.renders.progressive import ProgressiveRenderer
from pipeline.renders.renderer import set_threads
from pipeline.renders.results import GrowingPicture, with_result
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, activate
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene
from storage.renderer import Sampling

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=600, calls_per_child=1 << 30)

MOST_SCENES = 2
"""Number of pairs of a scene and settings that the child keeps loaded."""


class ProgressiveTracer:
    """Renders one picture at a time, for all threads; the child starts with the first picture."""

    def __init__(self, *, variant: Variant, threads: int) -> None:
        """Configure the child: Mitsuba's variant, and the number of CPU threads."""
        limits = replace(_LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes))
        self._child = IsolatedChild(limits=limits, factory=_ChildRenderer, args=(variant, threads))
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
        if not self._child.call_method(_ChildRenderer.begin, None, *begin):
            self._child.call_method(_ChildRenderer.begin, scene, *begin)
        while (step := self._child.call_method(_ChildRenderer.advance)) is not None:
            on_look(step)


_Camera = tuple[NDArray[np.float32], float]
_Begin = tuple[tuple[Hashable, RenderSettings], _Camera, int | None]
"""Scene key with its settings, camera, and samples of a preview."""


class _ChildRenderer:
    """Object that the child holds: the loaded scenes, and the picture that is rendered."""

    def __init__(self, variant: Variant, threads: int) -> None:
        activate(variant)
        set_threads(threads)
        self._loaded: dict[Hashable, ProgressiveRenderer] = {}
        self._steps: Iterator[Sampling | GrowingPicture] = iter(())

    def begin(
        self,
        scene: Scene | None,
        key: tuple[Hashable, RenderSettings],
        camera: _Camera,
        preview_spp: int | None,
    ) -> bool:
        """Begin a picture; return False if no scene is given and it is no longer loaded."""
        renderer = self._loaded.pop(key, None)
        if renderer is None:
            if scene is None:
                return False
            while len(self._loaded) >= MOST_SCENES:
                del self._loaded[next(iter(self._loaded))]
            renderer = ProgressiveRenderer(scene, key[1])
        self._loaded[key] = renderer
        if preview_spp is None:
            self._steps = with_result(renderer.view_steps(*camera, 0))
        else:
            self._steps = with_result(renderer.preview_steps(*camera, 0, preview_spp))
        return True

    def advance(self) -> Sampling | GrowingPicture | None:
        """Return the next step; None after the last one."""
        return next(self._steps, None)
