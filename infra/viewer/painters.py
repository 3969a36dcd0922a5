"""Renderers that a page offers: path tracers, networks, passes, and the picture in the file."""

import dataclasses
import importlib.util
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from infra.viewer.picture_options import PictureOptions
from pipeline.documents.scene_passes import PASS_VIEWS, PassView
from pipeline.generation.progressive_tracer import ProgressiveTracer
from pipeline.renders.preview import usual_filter
from pipeline.renders.results import GrowingPicture
from pipeline.renders.settings import FIRST_SPP, NoiseTargets, RenderSettings, one_picture
from storage.conventions import HALF_FLOAT_MAX
from storage.errors import TrilightError
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene
from storage.renderer import Sampling

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer, PreparedScene

SAMPLES_PREFIX = "samples-"
SAMPLES = (1, 4, 16, 64)
"""Samples per pixel of the previews, beside the progressive picture."""

MOST_SPP = 4096
"""Maximum number of samples per pixel."""

_LIGHTS_PER_PASS = 8

_numbers = itertools.count()
"""Numbers of the scenes of this process."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedImage:
    """Picture, which may be an intermediate one."""

    radiance_rgb: NDArray[np.float32] | None
    """[R, R, 3] linear radiance; None where the picture shows a pass."""
    pixels: NDArray[np.uint8] | None = None
    """[R, R, 3] or [R, R] display pixels of a pass."""
    core_s: float | None
    """CPU seconds of the picture, without the scene's preparation; None where it was stored."""
    scene_core_s: float | None = None
    """CPU seconds of the scene's preparation; None where they are unknown."""
    spp: int | None = None
    """Samples per pixel; None where no path is sampled."""
    floor_db: float | None = None
    """Stated error as psnr_log_db; None without one."""
    says: str = ""
    """Remark on the picture for the page; may be empty."""
    notes: Sequence[str] = field(default_factory=tuple)
    """Warnings about the scene with this engine."""


Show = Callable[[RenderedImage | Sampling], None]
"""Callback for each state of a picture; it raises where the picture is cancelled."""


class Painter(Protocol):
    """Renderer of the page."""

    title: str
    """Title on the page, such as `Path traced`."""
    means: str
    """Description on the page, one sentence."""

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        """Render the picture through `show`; raises TrilightError where there is none."""


class TracedPainter:
    """Path tracing, of all light or of direct light only."""

    def __init__(self, tracer: ProgressiveTracer, scene_number: int, *, direct: bool) -> None:
        """Store the path tracer, and the scene's number, which is unique in this process."""
        self._tracer = tracer
        self._number = scene_number
        self._direct = direct
        self.title = "Direct light" if direct else "Path traced"
        self.means = (
            "Lamp, surface, camera: traced without any further bounce."
            if direct
            else "All light, traced until the measured error reaches its goal."
        )

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        settings = _traced_settings(options)
        if self._direct:
            settings = dataclasses.replace(settings, max_depth=2)

        def on_step(step: Sampling) -> None:
            show(_image_of_step(step) if isinstance(step, GrowingPicture) else step)

        camera = (options.camera.c2w, options.camera.fov_deg)
        self._tracer.render(scene, (self._number, options.scene_key), camera, settings, on_step)


class SamplesPainter:
    """Few samples per pixel with one denoise; shares the loaded scene of `TracedPainter`."""

    def __init__(self, tracer: ProgressiveTracer, scene_number: int, spp: int) -> None:
        """Store the path tracer, the scene's number, and the samples per pixel."""
        self._tracer = tracer
        self._number = scene_number
        self.spp = spp
        self.title = f"{spp} sample{'s' if spp > 1 else ''}, filtered"
        self.means = (
            f"{spp} path{'s' if spp > 1 else ''} a pixel, then Open Image Denoise "
            f"({usual_filter(spp)})."
        )

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        def on_step(step: Sampling) -> None:
            show(_image_of_step(step) if isinstance(step, GrowingPicture) else step)

        camera = (options.camera.c2w, options.camera.fov_deg)
        key = (self._number, options.scene_key)
        settings = _traced_settings(options)
        self._tracer.render(scene, key, camera, settings, on_step, preview_spp=self.spp)


def _traced_settings(options: PictureOptions) -> RenderSettings:
    return one_picture(
        resolution=options.resolution,
        max_spp=MOST_SPP,
        noise_targets=NoiseTargets(log_db=options.error_db),
    )


def _image_of_step(look: GrowingPicture) -> RenderedImage:
    floor_db = None if look.floor is None else look.floor.log_db
    few = "a preview: its error is not measured" if floor_db is None else ""
    if floor_db is not None and look.spp < FIRST_SPP:
        few = f"below {FIRST_SPP} samples the stated error may flatter"
    return RenderedImage(
        radiance_rgb=look.radiance_rgb,
        core_s=look.core_s,
        spp=look.spp,
        floor_db=floor_db,
        says=few,
    )


class NetworkPainter:
    """Network, loaded with its first picture; it keeps the last scene for further cameras."""

    def __init__(self, checkpoint: str, title: str, means: str) -> None:
        self.title = title
        self.means = means
        self.checkpoint = checkpoint
        self._renderer: NeuralRenderer | None = None
        self._prepared: tuple[str, PreparedScene, float] | None = None

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        renderer = self._load()
        renderer.require_resolution(options.resolution)
        if self._prepared is None or self._prepared[0] != options.scene_key:
            began_s = time.process_time()
            prepared = renderer.prepare(scene, lights_per_pass=_LIGHTS_PER_PASS)
            self._prepared = (options.scene_key, prepared, time.process_time() - began_s)
        _, prepared, scene_core_s = self._prepared
        began_s = time.process_time()
        camera = options.camera
        picture = renderer.view(prepared, camera.c2w, camera.fov_deg, options.resolution)
        show(
            RenderedImage(
                radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX),
                core_s=time.process_time() - began_s,
                scene_core_s=scene_core_s,
                notes=(*prepared.notes, *renderer.resolution_notes(options.resolution)),
            )
        )

    def _load(self) -> "NeuralRenderer":
        if self._renderer is None:
            from model.neural_renderer import NeuralRenderer

            self._renderer = NeuralRenderer.load(self.checkpoint)
        return self._renderer


class PassPainter:
    """Pass of the visible surfaces, such as depth: a function of scene and camera without light."""

    def __init__(self, shown_pass: PassView) -> None:
        self.title = shown_pass.title.capitalize()
        self.means = "What the pixels see, without light."
        self._shown = shown_pass

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        (name,) = pass_names([self._shown.word])
        pose = options.camera.c2w[None]
        angle = np.array([options.camera.fov_deg], np.float32)
        began_s = time.process_time()
        values = view_passes(
            scene.with_cameras(pose, angle), [name], view=0, resolution=options.resolution
        )[name]
        core_s = time.process_time() - began_s
        has_hits = (
            np.isfinite(values).any() if values.dtype.kind == "f" else bool((values >= 0).any())
        )
        says = (
            self._shown.caption(values).partition(", in the")[0] if has_hits else "nothing is met"
        )
        pixels = self._shown.pixels(values)
        show(RenderedImage(radiance_rgb=None, pixels=pixels, core_s=core_s, says=says))


class TargetPainter:
    """Picture that a dataset or an HDF5 file holds of one of the scene's cameras."""

    title = "Target"
    means = "The picture that the file holds of this camera."

    def __init__(self, radiance_rgb: NDArray[np.float32], floors_db: Sequence[float]) -> None:
        """Store the pictures [V, R, R, 3] and their stated errors, which may be empty."""
        self._pictures = radiance_rgb
        self._floors_db = floors_db

    @property
    def width_px(self) -> int:
        """Width of the pictures in pixels."""
        return int(self._pictures.shape[1])

    def paint(self, scene: Scene, options: PictureOptions, show: Show) -> None:
        if options.view is None or options.view >= len(self._pictures):
            raise TrilightError(
                "The file holds pictures of the scene's own cameras alone; choose one of them."
            )
        if options.edits:
            raise TrilightError("The file's picture shows the scene without your changes.")
        floor_db = self._floors_db[options.view] if self._floors_db else None
        picture = self._pictures[options.view]
        show(
            RenderedImage(
                radiance_rgb=picture, core_s=None, floor_db=floor_db, says="as it was stored"
            )
        )


def render_words(painter: Painter, options: PictureOptions) -> list[str]:
    """Return the options of `trilight render` for the same picture; by default path tracing."""
    if isinstance(painter, NetworkPainter):
        return ["--engine", "neural", "--checkpoint", painter.checkpoint]
    if isinstance(painter, SamplesPainter):
        return ["--spp", str(painter.spp)]
    return ["--noise-floor", f"{options.error_db:g}"]


def painters_of(
    tracer: ProgressiveTracer, target: TargetPainter | None, checkpoint: str | None
) -> Mapping[str, Painter]:
    """Return the renderers by name, in the order of the page.

    Args:
        tracer: path tracer of this page.
        target: pictures of the file; None where it holds none.
        checkpoint: network of the user; may be None.
    """
    number = next(_numbers)
    painters: dict[str, Painter] = {"traced": TracedPainter(tracer, number, direct=False)}
    if importlib.util.find_spec("torch") is not None:
        if checkpoint is not None:
            painters["network"] = NetworkPainter(
                checkpoint, "Your network", "The network that --checkpoint names."
            )
        painters["hits"] = NetworkPainter(
            "builtin:", "Network, hits", "First hits and direct light are traced, the rest learned."
        )
        painters["tokens"] = NetworkPainter(
            "builtin:tokens", "Network, tokens", "RenderFormer's way: nothing is traced."
        )
    for spp in SAMPLES:
        painters[f"{SAMPLES_PREFIX}{spp}"] = SamplesPainter(tracer, number, spp)
    painters["direct"] = TracedPainter(tracer, number, direct=True)
    if target is not None:
        painters["target"] = target
    return painters | {
        f"pass-{shown_pass.word}": PassPainter(shown_pass) for shown_pass in PASS_VIEWS
    }
