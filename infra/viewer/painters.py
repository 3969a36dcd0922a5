"""The ways to a picture that a page offers: tracers, networks, passes, and what a file holds."""

import dataclasses
import importlib.util
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from infra.viewer.wanted import Wanted
from pipeline.documents.scene_passes import SHOWN_PASSES, ShownPass
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.preview import usual_filter
from pipeline.renders.results import GrowingPicture, Sampling
from pipeline.renders.settings import FIRST_SPP, RenderSettings, one_picture
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer, PreparedScene

SAMPLES_PREFIX = "samples-"
SAMPLES = (1, 4, 16, 64)
"""Samples a pixel of the tracer's rungs below the picture that grows."""

MOST_SPP = 4096
"""Cap of a tracer's samples."""

_LIGHTS_PER_PASS = 8

_numbers = itertools.count()
"""Of the scenes of this process."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Painted:
    """A picture, or one on its way to become better."""

    radiance_rgb: NDArray[np.float32] | None
    """[R, R, 3] linear radiance; None where it shows something else."""
    pixels: NDArray[np.uint8] | None = None
    """[R, R, 3] or [R, R] as it is shown, where it shows something else."""
    core_s: float | None
    """Core-seconds that it took, the scene's own preparation aside; None where it was stored."""
    scene_core_s: float | None = None
    """Core-seconds that the scene took before its first picture, where that is known."""
    spp: int | None = None
    """Samples per pixel."""
    floor_db: float | None = None
    """Its stated error as psnr_log_db, where it has one."""
    says: str = ""
    """What a person should know of it."""
    notes: Sequence[str] = field(default_factory=tuple)
    """The same of the scene with this engine."""


Show = Callable[[Painted | Sampling], None]
"""Receives each state of a picture; raises where nobody wants it any more."""


class Painter(Protocol):
    """One way to a picture."""

    title: str
    """For the page."""
    means: str
    """A sentence that says what it does."""

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        """Show the picture; raises TrilightError where there is none."""


class TracedPainter:
    """Path tracing, of all light or of that which comes straight from lamps."""

    def __init__(self, tracer: ProgressiveTracer, scene_number: int, *, direct: bool) -> None:
        """Take what traces, and a number that no other scene of this process has."""
        self._tracer = tracer
        self._number = scene_number
        self._direct = direct
        self.title = "Direct light" if direct else "Path traced"
        self.means = (
            "Lamp, surface, camera: traced without any further bounce."
            if direct
            else "All light, traced until the measured error reaches its goal."
        )

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        settings = _traced_settings(wanted)
        if self._direct:
            settings = dataclasses.replace(settings, max_depth=2)

        def shown(step: Sampling) -> None:
            show(_traced(step) if isinstance(step, GrowingPicture) else step)

        camera = (wanted.camera.c2w, wanted.camera.fov_deg)
        self._tracer.paint(scene, (self._number, wanted.scene_key), camera, settings, shown)


class SamplesPainter:
    """Few samples a pixel with one denoise; the loaded scene is that of `TracedPainter`."""

    def __init__(self, tracer: ProgressiveTracer, scene_number: int, spp: int) -> None:
        """Take what `TracedPainter` takes, and the samples."""
        self._tracer = tracer
        self._number = scene_number
        self.spp = spp
        self.title = f"{spp} sample{'s' if spp > 1 else ''}, filtered"
        self.means = (
            f"{spp} path{'s' if spp > 1 else ''} a pixel, then Open Image Denoise "
            f"({usual_filter(spp)})."
        )

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        def shown(step: Sampling) -> None:
            show(_traced(step) if isinstance(step, GrowingPicture) else step)

        camera = (wanted.camera.c2w, wanted.camera.fov_deg)
        key = (self._number, wanted.scene_key)
        settings = _traced_settings(wanted)
        self._tracer.paint(scene, key, camera, settings, shown, preview_spp=self.spp)


def _traced_settings(wanted: Wanted) -> RenderSettings:
    return one_picture(
        resolution=wanted.resolution, max_spp=MOST_SPP, noise_floor_db=wanted.error_db
    )


def _traced(look: GrowingPicture) -> Painted:
    floor_db = None if look.floor is None else look.floor.log_db
    few = "a preview: its error is not measured" if floor_db is None else ""
    if floor_db is not None and look.spp < FIRST_SPP:
        few = f"below {FIRST_SPP} samples the stated error may flatter"
    return Painted(
        radiance_rgb=look.radiance_rgb,
        core_s=look.core_s,
        spp=look.spp,
        floor_db=floor_db,
        says=few,
    )


class NetworkPainter:
    """A network; loaded with its first picture, and ready for more cameras of the last scene."""

    def __init__(self, checkpoint: str, title: str, means: str) -> None:
        self.title = title
        self.means = means
        self.checkpoint = checkpoint
        self._renderer: NeuralRenderer | None = None
        self._prepared: tuple[str, PreparedScene, float] | None = None

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        renderer = self._loaded()
        renderer.require_resolution(wanted.resolution)
        if self._prepared is None or self._prepared[0] != wanted.scene_key:
            began_s = time.process_time()
            prepared = renderer.prepare(scene, lights_per_pass=_LIGHTS_PER_PASS)
            self._prepared = (wanted.scene_key, prepared, time.process_time() - began_s)
        _, prepared, scene_core_s = self._prepared
        began_s = time.process_time()
        camera = wanted.camera
        picture = renderer.view(prepared, camera.c2w, camera.fov_deg, wanted.resolution)
        show(
            Painted(
                radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX),
                core_s=time.process_time() - began_s,
                scene_core_s=scene_core_s,
                notes=(*prepared.notes, *renderer.resolution_notes(wanted.resolution)),
            )
        )

    def _loaded(self) -> "NeuralRenderer":
        if self._renderer is None:
            from model.neural_renderer import NeuralRenderer
            from train.loop.checkpoints import network_of_run

            self._renderer = NeuralRenderer.load(self.checkpoint, finders=[network_of_run])
        return self._renderer


class PassPainter:
    """What the pixels see: a function of scene and camera, without any light."""

    def __init__(self, shown: ShownPass) -> None:
        self.title = shown.title.capitalize()
        self.means = "What the pixels see, without light."
        self._shown = shown

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        (name,) = pass_names([self._shown.word])
        pose = wanted.camera.c2w[None]
        angle = np.array([wanted.camera.fov_deg], np.float32)
        began_s = time.process_time()
        seen = view_passes(
            scene.with_cameras(pose, angle), [name], view=0, resolution=wanted.resolution
        )[name]
        core_s = time.process_time() - began_s
        met = np.isfinite(seen).any() if seen.dtype.kind == "f" else bool((seen >= 0).any())
        says = self._shown.caption(seen).partition(", in the")[0] if met else "nothing is met"
        pixels = self._shown.pixels(seen)
        show(Painted(radiance_rgb=None, pixels=pixels, core_s=core_s, says=says))


class TargetPainter:
    """The picture that a dataset or an HDF5 file holds of one of the scene's own cameras."""

    title = "Target"
    means = "The picture that the file holds of this camera."

    def __init__(self, radiance_rgb: NDArray[np.float32], floors_db: Sequence[float]) -> None:
        """Take the pictures [V, R, R, 3] and their stated errors, which may be none."""
        self._pictures = radiance_rgb
        self._floors_db = floors_db

    @property
    def width_px(self) -> int:
        """Width of the pictures."""
        return int(self._pictures.shape[1])

    def paint(self, scene: Scene, wanted: Wanted, show: Show) -> None:
        if wanted.view is None or wanted.view >= len(self._pictures):
            raise TrilightError(
                "The file holds pictures of the scene's own cameras alone; choose one of them."
            )
        if wanted.edits:
            raise TrilightError("The file's picture shows the scene without your changes.")
        floor_db = self._floors_db[wanted.view] if self._floors_db else None
        picture = self._pictures[wanted.view]
        show(Painted(radiance_rgb=picture, core_s=None, floor_db=floor_db, says="as it was stored"))


def render_words(painter: Painter, wanted: Wanted) -> list[str]:
    """Return the options by which `trilight render` goes the way of a painter; else it traces."""
    if isinstance(painter, NetworkPainter):
        return ["--engine", "neural", "--checkpoint", painter.checkpoint]
    if isinstance(painter, SamplesPainter):
        return ["--spp", str(painter.spp)]
    return ["--noise-floor", f"{wanted.error_db:g}"]


def painters_of(
    tracer: ProgressiveTracer, target: TargetPainter | None, checkpoint: str | None
) -> Mapping[str, Painter]:
    """Return the ways to pictures by name, in the order of the page.

    Args:
        tracer: for what is traced.
        target: of the file, if it holds pictures.
        checkpoint: a network of the user's own.
    """
    number = next(_numbers)
    found: dict[str, Painter] = {"traced": TracedPainter(tracer, number, direct=False)}
    if importlib.util.find_spec("torch") is not None:
        if checkpoint is not None:
            found["network"] = NetworkPainter(
                checkpoint, "Your network", "The network that --checkpoint names."
            )
        found["hits"] = NetworkPainter(
            "builtin:", "Network, hits", "First hits and direct light are traced, the rest learned."
        )
        found["tokens"] = NetworkPainter(
            "builtin:tokens", "Network, tokens", "RenderFormer's way: nothing is traced."
        )
    for spp in SAMPLES:
        found[f"{SAMPLES_PREFIX}{spp}"] = SamplesPainter(tracer, number, spp)
    found["direct"] = TracedPainter(tracer, number, direct=True)
    if target is not None:
        found["target"] = target
    return found | {f"pass-{shown.word}": PassPainter(shown) for shown in SHOWN_PASSES}
