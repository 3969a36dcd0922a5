"""Renderers that a page offers, and the queue that renders the pictures of one scene.

Renderers are path tracers, networks, passes, and the pictures in the file. The queue renders one
picture at a time, and a new request cancels the current one. Finished pictures are kept for a
while, so that switching back to one costs nothing. Pictures of one scene, camera and width are
compared with the best of them: the one stored in the file, else the path traced one.
"""

import functools
import importlib.util
import itertools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from infra.render.networks import NetworkRenderer, RendererHere, SceneHere
from infra.render.path_tracer import PathTracer, RenderChild
from infra.viewer.picture_options import PictureOptions, apply_edits
from pipeline.documents.scene_page import PASS_VIEWS, PassView
from pipeline.exchange.formats import LoadedScene
from pipeline.renders.preview import PreviewSettings, samples_text, usual_filter
from pipeline.renders.settings import RenderSettings, measured_settings
from storage.errors import TrilightError, Unrenderable
from storage.metrics import psnr_log_db
from storage.records.passes import pass_names, view_passes
from storage.records.scene import Scene
from storage.renderer import Camera, Image, ReadyScene, Renderer, Sampling
from train.evaluation.sheet import ERROR_WHITE

if TYPE_CHECKING:
    from model.inference import NeuralRenderer

SAMPLES = (1, 4, 16, 64)
"""Samples per pixel of the previews, beside the progressive picture."""

_DIRECT_DEPTH = 2


@dataclass(frozen=True, kw_only=True)
class PageRenderer:
    """Renderer as a page offers it, at the width and to the error that a request names."""

    title: str
    """Title on the page, such as `Path traced`."""
    means: str
    """Description on the page, one sentence."""
    make: Callable[[PictureOptions], Renderer]
    words: Sequence[str] = ()
    """Options of `trilight render` for the same picture; without them, path tracing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PassImage(Image):
    """Pass of the visible surfaces, which is no light: its radiance is 0."""

    pixels: NDArray[np.uint8]
    """[R, R, 3] or [R, R] display pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PassRenderer(RendererHere):
    """Pass of the visible surfaces, such as depth: a function of scene and camera without light."""

    pass_view: PassView
    resolution: int

    @property
    def name(self) -> str:
        """Word of the pass."""
        return self.pass_view.word

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Return the scene as it is."""
        return SceneHere(render_image=functools.partial(self._render, scene))

    def _render(self, scene: Scene, camera: Camera) -> Image:
        (name,) = pass_names([self.pass_view.word])
        angle = np.array([camera.fov_deg], np.float32)
        began_s = time.process_time()
        values = view_passes(
            scene.with_cameras(camera.c2w[None], angle), [name], view=0, resolution=self.resolution
        )[name]
        core_s = time.process_time() - began_s
        pixels, caption = self.pass_view.show(values)
        return PassImage(
            radiance_rgb=np.zeros((*pixels.shape[:2], 3), np.float32),
            pixels=pixels,
            cpu_seconds=core_s,
            remark=caption.partition(", in the")[0],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredPictures(RendererHere):
    """Pictures that a dataset or an HDF5 file holds of the scene's own cameras."""

    scene: Scene
    radiance_rgb: NDArray[np.float32]
    """[V, R, R, 3] linear radiance."""
    errors_db: Sequence[float] = ()
    """Stated errors as psnr_log_db; may be empty."""
    name: str = "target"

    @property
    def resolution(self) -> int:
        """Width of the pictures in pixels."""
        return int(self.radiance_rgb.shape[1])

    def load(self, scene: Scene, name: str) -> SceneHere:
        """Return the pictures; raises Unrenderable for another scene than theirs."""
        if scene is not self.scene:
            raise Unrenderable("The file's image shows the scene without your changes.")
        return SceneHere(render_image=self._look_up)

    def _look_up(self, camera: Camera) -> Image:
        if camera.view is None or camera.view >= len(self.radiance_rgb):
            raise Unrenderable(
                "The file holds images of the scene's own cameras alone; choose one of them."
            )
        return Image(
            radiance_rgb=self.radiance_rgb[camera.view],
            stated_error_db=self.errors_db[camera.view] if self.errors_db else None,
            cpu_seconds=None,
            remark="as it was stored",
        )


def page_renderers(
    loaded: LoadedScene, child: RenderChild, checkpoint: str | None, errors_db: Sequence[float] = ()
) -> Mapping[str, PageRenderer]:
    """Return the renderers of a scene by name, in the order of the page.

    Args:
        errors_db: stated errors of the pictures in the file as psnr_log_db; may be empty.
    """
    offered = {
        "traced": PageRenderer(
            title="Path traced",
            means="All light, traced until the stated error reaches its goal.",
            make=lambda options: _path_tracer(child, options),
        )
    }
    if importlib.util.find_spec("torch") is not None:
        if checkpoint is not None:
            offered["network"] = network_on_page(
                checkpoint, "Your network", "The network that --checkpoint names."
            )
        offered["hits"] = network_on_page(
            "builtin:", "Network, hits", "First hits and direct light are traced, the rest learned."
        )
        offered["tokens"] = network_on_page(
            "builtin:tokens", "Network, tokens", "RenderFormer's way: nothing is traced."
        )
    for spp in SAMPLES:
        offered[f"samples-{spp}"] = samples_on_page(child, spp)
    offered["direct"] = PageRenderer(
        title="Direct light",
        means="Light, surface, camera: traced without any further bounce.",
        make=lambda options: _path_tracer(child, options, max_depth=_DIRECT_DEPTH),
    )
    targets_rgb = loaded.radiance_rgb
    if targets_rgb is not None and len(targets_rgb):
        target = StoredPictures(scene=loaded.scene, radiance_rgb=targets_rgb, errors_db=errors_db)
        offered["target"] = PageRenderer(
            title="Target",
            means="The image that the file holds of this camera.",
            make=lambda options: target,
        )
    return offered | {
        f"pass-{pass_view.word}": _pass_on_page(pass_view) for pass_view in PASS_VIEWS
    }


def _path_tracer(
    child: RenderChild, options: PictureOptions, max_depth: int = RenderSettings.max_depth
) -> PathTracer:
    targets = {"noise_floor_db": options.error_db}
    settings = measured_settings(options.resolution, targets, max_depth=max_depth)
    return PathTracer(child, settings, shows_looks=True)


def samples_on_page(child: RenderChild, spp: int) -> PageRenderer:
    """Return a preview of a number of samples per pixel with one denoise."""
    denoiser = usual_filter(spp)
    return PageRenderer(
        title=f"{samples_text(spp)}, filtered",
        means=f"{spp} path{'s' if spp > 1 else ''} a pixel, then Open Image Denoise ({denoiser}).",
        make=lambda options: PathTracer(
            child, PreviewSettings(resolution=options.resolution, spp=spp, denoiser=denoiser)
        ),
        words=("--spp", str(spp)),
    )


def network_on_page(checkpoint: str, title: str, means: str) -> PageRenderer:
    """Return a network, which is read with its first picture."""

    @functools.cache
    def network() -> "NeuralRenderer":
        from model.inference import NeuralRenderer

        return NeuralRenderer.load(checkpoint)

    return PageRenderer(
        title=title,
        means=means,
        make=lambda options: NetworkRenderer(
            checkpoint=checkpoint,
            resolution=options.resolution,
            opened=network(),
        ),
        words=("--engine", "neural", "--checkpoint", checkpoint),
    )


def _pass_on_page(pass_view: PassView) -> PageRenderer:
    return PageRenderer(
        title=pass_view.title.capitalize(),
        means="What the pixels see, without light.",
        make=lambda options: PassRenderer(pass_view=pass_view, resolution=options.resolution),
    )


MOST_KEPT = 32
"""Maximum number of pictures that are kept; one of 1024 pixels takes 13 MB."""

PATIENCE_S = 20.0
"""Seconds that a response waits for an update."""

LAST_PICTURE_S = 15.0
"""Seconds that `join` waits for the current picture."""

_REFERENCES = ("target", "traced")

State = Literal["waiting", "working", "done", "failed", "cancelled"]


class _Superseded(Exception):
    """Ends the current picture, which is cancelled."""


@dataclass(kw_only=True, eq=False)
class RenderJob:
    """Requested picture and its state."""

    id: str
    options: PictureOptions
    state: State = "waiting"
    version: int = 0
    """Counter of updates, by which `wait_for_update` sees a new one."""
    image: Image | None = None
    scene_core_s: float | None = None
    """CPU seconds of the scene's preparation; None where they are unknown."""
    notes: Sequence[str] = ()
    sampling: Sampling | None = None
    """Progress of a path tracer since the last image."""
    error: str = ""
    costs: list[Mapping[str, float | int | None]] = field(default_factory=list)
    """Samples, CPU seconds and stated error of each image so far."""


class RenderQueue:
    """Render queue of one scene: each picture has a thread, and one of them works at a time.

    `_changed` guards `_jobs` (every kept job, oldest first) and the state of each job.
    `wait_for_update` waits for a newer version of a job. The working thread holds `_rendering`,
    which guards `_loaded`, the last scene of each renderer. It and exports use `_edited`.
    """

    def __init__(self, scene: Scene, renderers: Mapping[str, PageRenderer]) -> None:
        self._scene = scene
        self._renderers = renderers
        self._changed = threading.Condition()
        self._rendering = threading.Lock()
        self._jobs = OrderedDict[str, RenderJob]()
        self._thread: threading.Thread | None = None
        self._numbers = itertools.count(1)
        self._edited: tuple[str, Scene] | None = None
        self._loaded: dict[str, tuple[object, ReadyScene, Sequence[str]]] = {}

    def submit(self, options: PictureOptions) -> RenderJob:
        """Queue a picture, or return an equal job; the current picture is cancelled."""
        with self._changed:
            same = [job for job in self._jobs.values() if _is_same(job, options)]
            if same:
                self._jobs.move_to_end(same[-1].id)
                return same[-1]
            self.cancel_all()
            job = RenderJob(id=str(next(self._numbers)), options=options)
            self._jobs[job.id] = job
            while len(self._jobs) > MOST_KEPT:
                self._jobs.popitem(last=False)
            self._thread = threading.Thread(target=self._render, args=(job,), daemon=True)
            self._thread.start()
            return job

    def cancel_all(self) -> None:
        """Cancel the current and the waiting picture; the current one ends at its next step."""
        with self._changed:
            for job in self._jobs.values():
                if not _is_over(job):
                    self._update(job, state="cancelled")

    def job(self, number: str) -> RenderJob:
        """Return a job by its id; raises TrilightError where it is no longer kept."""
        with self._changed:
            if number not in self._jobs:
                raise TrilightError("The image is not kept any more; ask for it again.")
            return self._jobs[number]

    def wait_for_update(self, number: str, after: int) -> RenderJob:
        """Return a job once it is newer than a version, or after PATIENCE_S."""
        job = self.job(number)
        with self._changed:
            self._changed.wait_for(lambda: job.version > after or _is_over(job), PATIENCE_S)
        return job

    def reference(self, job: RenderJob) -> RenderJob | None:
        """Return the job whose picture is the reference of another job; None without one.

        It has the shape of the job's picture, if there is one already.
        """
        with self._changed:
            for engine in _REFERENCES:
                for other in reversed(self._jobs.values()):
                    if _can_judge(other, job, engine):
                        return other
        return None

    def scene(self, scene_key: str, edits: Mapping[str, Any]) -> Scene:
        """Return the scene with edits; the last edited scene is kept."""
        if self._edited is None or self._edited[0] != scene_key:
            self._edited = (scene_key, apply_edits(self._scene, edits))
        return self._edited[1]

    def join(self) -> None:
        """Wait for the current picture, which `cancel_all` ends at its next step.

        Libraries abort a process that ends while they work in one of its threads.
        """
        if self._thread is not None:
            self._thread.join(LAST_PICTURE_S)

    def _render(self, job: RenderJob) -> None:
        def show(step: Image | Sampling) -> None:
            with self._changed:
                if job.state != "working":
                    raise _Superseded
                if isinstance(step, Image):
                    job.image = step
                    job.sampling = None
                    job.costs.append(
                        {
                            "spp": step.samples,
                            "core_s": step.cpu_seconds,
                            "floor_db": step.stated_error_db,
                        }
                    )
                else:
                    job.sampling = step
                self._update(job)

        with self._rendering:
            with self._changed:
                if job.state == "cancelled":
                    return
                self._update(job, state="working")
            state: State = "done"
            try:
                loaded, job.notes = self._load(job.options)
                job.scene_core_s = loaded.cpu_seconds
                show(loaded.render(job.options.camera, show))
            except _Superseded:
                state = "cancelled"
            except TrilightError as mistake:
                state = "failed"
                job.error = str(mistake)
            except Exception as defect:  # of any library: the page shows it, the queue goes on
                state = "failed"
                job.error = f"{type(defect).__name__}: {defect}"
            with self._changed:
                self._update(job, state=state)

    def _load(self, options: PictureOptions) -> tuple[ReadyScene, Sequence[str]]:
        """Return the edited scene in the renderer of a request, and the notes on its pictures."""
        renderer = self._renderers[options.engine].make(options)
        key = (options.scene_key, renderer.identity)
        if self._loaded.get(options.engine, (None,))[0] != key:
            scene = self.scene(options.scene_key, options.edits)
            loaded = renderer.load(scene, "the scene")
            self._loaded[options.engine] = (key, loaded, [*loaded.notes, *renderer.notes])
        return self._loaded[options.engine][1:]

    def _update(self, job: RenderJob, *, state: State | None = None) -> None:
        job.state = state or job.state
        job.version += 1
        self._changed.notify_all()


def job_record(job: RenderJob, queue: RenderQueue) -> Mapping[str, Any]:
    """Return what a page shows of a job of a queue, as JSON values."""
    image = job.image  # before the reference, which then has its shape
    reference = queue.reference(job)
    truth = None if reference is None else reference.image
    sampling = job.sampling
    record: dict[str, Any] = {
        "id": job.id,
        "engine": job.options.engine,
        "state": job.state,
        "version": job.version,
        "error": job.error,
        "prices": job.costs,
        "shown": image is not None,
    }
    if sampling is not None:
        record["sampling"] = {"spp": sampling.spp, "expected_spp": sampling.expected_spp}
    if image is not None:
        record |= {
            "spp": image.samples,
            "core_s": image.cpu_seconds,
            "scene_core_s": job.scene_core_s,
            "floor_db": image.stated_error_db,
            "expected_db": image.facts.get("expected_error_db"),
            "says": image.remark,
            "notes": list(job.notes),
            "agreement_db": (
                None
                if truth is None
                else float(psnr_log_db(image.radiance_rgb, truth.radiance_rgb))
            ),
            "truth": None if reference is None else reference.options.engine,
            "error_white": ERROR_WHITE,
        }
    return record


def _is_over(job: RenderJob) -> bool:
    return job.state in ("done", "failed", "cancelled")


def _is_same(job: RenderJob, options: PictureOptions) -> bool:
    return (
        job.state in ("waiting", "working", "done")
        and job.options.engine == options.engine
        and job.options.camera_key == options.camera_key
        and job.options.error_db == options.error_db
    )


def _can_judge(other: RenderJob, job: RenderJob, engine: str) -> bool:
    return (
        other.options.engine == engine
        and other is not job
        and other.options.camera_key == job.options.camera_key
        and other.image is not None
        and (engine == "target" or other.image.stated_error_db is not None)
        and (
            job.image is None
            or (
                not isinstance(job.image, PassImage)
                and job.image.radiance_rgb.shape == other.image.radiance_rgb.shape
            )
        )
    )
