"""`PathTracer`: renders scenes by path tracing, in a child process with limits.

This process requests one pass of samples after another, so that it can report progress, show
intermediate pictures, and stop between two passes.
"""

import dataclasses
import itertools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, Result, with_retries
from pipeline.renders.mitsuba_variant import Variant, activate, environment
from pipeline.renders.preview import PreviewSettings, load_preview
from pipeline.renders.renderer import RenderedView, SceneRenderer, few_samples_remark, set_threads
from pipeline.renders.settings import RenderSettings
from storage.errors import Rejected, Unrenderable
from storage.machine import available_cores
from storage.records.material import PUBLISHED_COLUMNS, columns_in_use
from storage.records.scene import Scene
from storage.renderer import Camera, Fact, Image, OnProgress, Sampling, ignore_progress
from storage.settings.described import settings_record

MOST_SCENES = 2
"""Number of scenes that a child keeps loaded; others are sent to it again."""

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=1 << 30)
"""A call loads a scene or renders one pass of samples; the child keeps its state, so it is replaced
only if it dies."""

_numbers = itertools.count()
"""Numbers of the loaded scenes of this process."""


class RenderChild:
    """Child that traces one picture at a time, for any number of path tracers and threads."""

    def __init__(self, variant: Variant, threads: int | None = None) -> None:
        """Configure the child, which starts when it is first needed.

        Args:
            variant: Mitsuba variant and denoiser device.
            threads: CPU threads of renderer and denoiser; None for one for each core.
        """
        self.variant = variant
        self.threads = threads or available_cores()
        limits = dataclasses.replace(
            _LIMITS, memory_bytes=variant.address_space(_LIMITS.memory_bytes)
        )
        args = (variant, self.threads)
        self._child = IsolatedChild(limits=limits, factory=RenderWorker, args=args)
        self._one_at_a_time = threading.Lock()

    def call(self, name: str, work: Callable[[IsolatedChild], Result]) -> Result:
        """Do work in the child, again in a fresh one where that may help.

        Raises:
            Unrenderable: there is no picture of `name`, or the child failed.
        """
        try:
            with self._one_at_a_time:
                return with_retries(lambda: work(self._child))
        except Rejected as rejection:
            raise Unrenderable(
                f"{name} cannot be rendered ({rejection}); expected a scene with surfaces, "
                "lights with an area, and radiance that half floats can hold."
            ) from rejection
        except ChildFailed as failure:
            raise Unrenderable(
                f"{name}: rendering failed ({failure}); try a smaller resolution, and see "
                "`trilight doctor`."
            ) from failure

    def close(self) -> None:
        """End the child, for all path tracers that share it."""
        self._child.close()


@dataclass(eq=False)
class PathTracer:
    """Path tracing to a stated error or with fixed samples; equal arguments give equal pictures."""

    child: RenderChild
    """Child that traces; other path tracers may share it."""
    settings: RenderSettings | PreviewSettings
    _: KW_ONLY
    seed: int = 0
    """Seed of the samples of every picture, from 0."""
    name: str = "mitsuba"
    shows_looks: bool = False
    """True to yield intermediate pictures on the way to a stated error."""

    @property
    def resolution(self) -> int:
        """Width in pixels."""
        return self.settings.resolution

    @property
    def notes(self) -> Sequence[str]:
        """Why another device was not chosen, where there is a reason."""
        note = self.child.variant.note
        return (f"{note}; see trilight doctor",) if note else ()

    @property
    def identity(self) -> Mapping[str, Any]:
        """Everything but scene and camera that decides a picture, as JSON values."""
        return {
            "seed": str(self.seed),  # the integers of an EXR header end at 2^31
            "settings": settings_record(self.settings),
            "environment": environment(self.child.variant),
        }

    def load(self, scene: Scene, name: str) -> "SceneInChild":
        """Load a scene; raises Unrenderable where it cannot be rendered."""
        return SceneInChild(self, scene, name)

    def close(self) -> None:
        """End the child."""
        self.child.close()


class SceneInChild:
    """Scene in a render child; it is sent again where the child no longer has it."""

    def __init__(self, tracer: PathTracer, scene: Scene, name: str) -> None:
        self._child = tracer.child
        self._seed = tracer.seed
        self._arguments = (next(_numbers), scene, tracer.settings, tracer.shows_looks)
        self._name = name
        unread = ", ".join(columns_in_use(scene.materials, PUBLISHED_COLUMNS))
        self.notes = (f"the path tracer does not read {unread}",) if unread else ()
        self._child.call(name, lambda each: each.call_method(RenderWorker.wait))
        began = time.perf_counter()
        self.cpu_seconds: float | None = self._child.call(name, self._load)
        self.seconds = time.perf_counter() - began

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        """Return the picture of a camera; raises Unrenderable where there is none."""
        picture = self.render_view(camera, on_progress)
        return picture if isinstance(picture, Image) else image_of(picture)

    def render_view(
        self, camera: Camera, on_progress: OnProgress = ignore_progress
    ) -> RenderedView | Image:
        """Do what `render` does, and return the picture with all that the path tracer measured."""
        view = (self._arguments[0], camera.c2w, camera.fov_deg, self._seed)

        def trace(child: IsolatedChild) -> RenderedView | Image:
            if not child.call_method(RenderWorker.begin_view, *view):
                self._load(child)
                child.call_method(RenderWorker.begin_view, *view)
            while isinstance(step := child.call_method(RenderWorker.advance), Sampling):
                on_progress(step.image or step)
            return step

        return self._child.call(f"{self._name}, {camera.name}", trace)

    def _load(self, child: IsolatedChild) -> float:
        return child.call_method(RenderWorker.load, *self._arguments)


class RenderWorker:
    """Object that the child holds: the loaded scenes, and the view that is rendered."""

    def __init__(self, variant: Variant, threads: int) -> None:
        activate(variant)
        set_threads(threads)
        self._loaded = OrderedDict[int, Callable[..., Iterator[Sampling | RenderedView | Image]]]()
        self._steps: Iterator[Sampling | RenderedView | Image] = iter(())

    def wait(self) -> None:
        """Do nothing: a call forces the child to start."""

    def load(
        self,
        number: int,
        scene: Scene,
        settings: RenderSettings | PreviewSettings,
        shows_looks: bool,
    ) -> float:
        """Load a scene as a number, and return the CPU seconds of that."""
        while len(self._loaded) >= MOST_SCENES:
            self._loaded.popitem(last=False)
        began_s = time.process_time()
        if isinstance(settings, PreviewSettings):
            self._loaded[number] = load_preview(scene, settings)
        else:
            renderer = SceneRenderer(scene, settings, shows_looks=shows_looks)
            self._loaded[number] = renderer.view_steps
        return time.process_time() - began_s

    def begin_view(self, number: int, c2w: Any, fov_deg: float, seed: int) -> bool:
        """Begin a view; return False if its scene is not loaded."""
        if number not in self._loaded:
            return False
        self._loaded.move_to_end(number)
        self._steps = self._loaded[number](c2w, fov_deg, seed)
        return True

    def advance(self) -> Sampling | RenderedView | Image:
        """Return the next step, last the picture."""
        step = next(self._steps)
        if not isinstance(step, Sampling):
            self._steps = iter(())  # frees the samples
        return step


def image_of(view: RenderedView) -> Image:
    """Return a picture of the path tracer with its facts."""
    facts: dict[str, Fact] = {"spp": view.spp, **view.rounded}
    if view.expected_error is not None:
        expected = view.expected_error.rounded.items()
        facts |= {name.replace("noise_floor", "expected_error"): db for name, db in expected}
    facts["at_cap"] = int(view.at_cap)
    facts["mean_radiance"] = float(f"{view.radiance_rgb.mean(dtype='float64'):.6g}")
    for part, floor in (view.part_floors or {}).items():
        facts |= {f"{part}.{name}": error_db for name, error_db in floor.rounded.items()}
    return Image(
        radiance_rgb=view.radiance_rgb,
        samples=view.spp,
        stated_error_db=view.noise_floor_db,
        cpu_seconds=view.core_s,
        facts=facts,
        layers_rgb=view.parts_rgb or {},
        remark=few_samples_remark(view.spp) if view.expected_error is None else "",
    )
