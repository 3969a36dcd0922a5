"""`PathTracer`: renders scenes by path tracing, in a child process with limits.

This process requests one pass of samples after another, so that it can report progress.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.generation.environment import environment
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, Result, with_retries
from pipeline.renders.preview import Preview, PreviewRenderer, PreviewSettings
from pipeline.renders.renderer import SceneRenderer, set_threads
from pipeline.renders.results import RenderedView, with_result
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, activate
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene
from storage.renderer import Sampling
from storage.settings.described import settings_record

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=1 << 30)
"""The first call sends the scene, each other one renders one pass of samples; the child keeps its
state, so it is replaced only if it dies."""


class PathTracer:
    """Renders one scene after another; equal arguments give equal pictures."""

    def __init__(
        self,
        settings: RenderSettings | PreviewSettings,
        *,
        seed: int,
        variant: Variant,
        threads: int,
        on_samples: Callable[[Sampling], None],
    ) -> None:
        """Configure the tracer; the child starts later.

        Args:
            settings: target quality, or the number of samples of a preview.
            seed: seed of the samples of every picture, from 0.
            variant: Mitsuba variant and denoiser device.
            threads: number of CPU threads of renderer and denoiser.
            sampled: called after each pass of samples.
        """
        self._settings = settings
        self._seed = seed
        self._on_samples = on_samples
        self.identity: Mapping[str, Any] = {
            "seed": str(seed),  # the integers of an EXR header end at 2^31
            "settings": settings_record(settings),
            "environment": environment(variant),
        }
        """Everything beside scene and camera that decides a picture, as JSON values."""
        self._is_open = False
        limits = replace(_LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes))
        self._child = IsolatedChild(limits=limits, factory=_ChildRenderer, args=(variant, threads))

    def wake(self, name: str) -> None:
        """Start the child and load the renderer, if needed; raises TrilightError as `open`."""
        self._call(name, lambda: self._child.call_method(_ChildRenderer.wait))

    def open(self, scene: Scene, name: str) -> None:
        """Load the scene that the following calls render.

        Args:
            scene: a scene that passes `Scene.check`.
            name: name of the scene, for messages.

        Raises:
            TrilightError: it cannot be rendered.
        """
        self._scene = scene
        self._call(name, self._open)

    def render(self, c2w: NDArray[np.float32], fov_deg: float, name: str) -> RenderedView:
        """Render the picture of one camera to the quality that the settings state.

        Args:
            c2w: [4, 4] camera to world.
            fov_deg: full field of view in degrees.
            name: name of the picture, for messages.

        Raises:
            TrilightError: the picture cannot be rendered.
        """
        view = self._call(name, lambda: self._picture(c2w, fov_deg))
        assert isinstance(view, RenderedView)
        return view

    def preview(self, c2w: NDArray[np.float32], fov_deg: float, name: str) -> Preview:
        """Render the preview of one camera, if the settings are a preview's; as `render`."""
        view = self._call(name, lambda: self._picture(c2w, fov_deg))
        assert isinstance(view, Preview)
        return view

    def close(self) -> None:
        """End the child."""
        self._child.close()

    def _open(self) -> None:
        self._is_open = False
        self._child.call_method(_ChildRenderer.open, self._scene, self._settings)
        self._is_open = True

    def _picture(self, c2w: NDArray[np.float32], fov_deg: float) -> RenderedView | Preview:
        if not self._is_open:  # a child that died took the scene and the samples with it
            self._open()
        try:
            self._child.call_method(_ChildRenderer.begin_view, c2w, fov_deg, self._seed)
            while isinstance(step := self._child.call_method(_ChildRenderer.advance), Sampling):
                self._on_samples(step)
        except ChildFailed:
            self._is_open = False
            raise
        rendered: RenderedView | Preview = step
        return rendered

    def _call(self, name: str, step: Callable[[], Result]) -> Result:
        try:
            return with_retries(step)
        except Rejected as rejection:
            raise TrilightError(
                f"{name} cannot be rendered ({rejection}); expected a scene with surfaces, "
                "lights with an area, and radiance that half floats can hold."
            ) from rejection
        except ChildFailed as failure:
            raise TrilightError(
                f"{name}: rendering failed ({failure}); try a smaller --resolution, and see "
                "`trilight doctor`."
            ) from failure


class _ChildRenderer:
    """Object that the child holds: a scene and the view that is rendered of it."""

    def __init__(self, variant: Variant, threads: int) -> None:
        activate(variant)
        set_threads(threads)
        self._renderer: SceneRenderer | PreviewRenderer | None = None
        self._steps: Iterator[Sampling | RenderedView | Preview] = iter(())

    def wait(self) -> None:
        """Do nothing: a call forces the child to start."""

    def open(self, scene: Scene, settings: RenderSettings | PreviewSettings) -> None:
        if isinstance(settings, PreviewSettings):
            self._renderer = PreviewRenderer(scene, settings)
        else:
            self._renderer = SceneRenderer(scene, settings)

    def begin_view(self, c2w: NDArray[np.float32], fov_deg: float, seed: int) -> None:
        assert self._renderer is not None, "`open` comes first"
        self._steps = with_result(self._renderer.view_steps(c2w, fov_deg, seed))

    def advance(self) -> Sampling | RenderedView | Preview:
        """Return the next step, last the picture."""
        return next(self._steps)
