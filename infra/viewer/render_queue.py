"""Render queue of one scene: renders one picture at a time; a new request cancels the current one.

Finished pictures are kept for a while, so that switching back to one costs nothing. Pictures of one
scene, camera and width are compared with the best of them: the one stored in the file, else the
path traced one.
"""

import itertools
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from infra.viewer.page_renderers import PageRenderer, PassImage
from infra.viewer.picture_options import PictureOptions, apply_edits
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from storage.renderer import Image, ReadyScene, Sampling

MOST_KEPT = 32
"""Maximum number of pictures that are kept; one of 1024 pixels takes 13 MB."""

PATIENCE_S = 20.0
"""Seconds that a response waits for an update."""

LAST_PICTURE_S = 15.0
"""Seconds that `join` waits for the current picture."""

_REFERENCES = ("target", "traced")

State = Literal["waiting", "working", "done", "failed", "cancelled"]


class _Superseded(Exception):
    """Ends the current picture, which another request or `cancel_all` has replaced."""


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
    """Render queue of one scene, with a thread of its own.

    `_changed` guards all fields but `_edited`, which the rendering thread and exports use, and
    `_loaded`, the last scene of each renderer, which the rendering thread alone uses: `_jobs`
    (every kept job, oldest first), `_next` (the job that waits), and the state of each job. Its
    waiters are the rendering thread, for `_next` and `_closed`, and `wait_for_update`, for a newer
    version of a job.
    """

    def __init__(self, scene: Scene, renderers: Mapping[str, PageRenderer]) -> None:
        self._scene = scene
        self._renderers = renderers
        self._changed = threading.Condition()
        self._jobs = OrderedDict[str, RenderJob]()
        self._next: RenderJob | None = None
        self._thread: threading.Thread | None = None
        self._numbers = itertools.count(1)
        self._edited: tuple[str, Scene] | None = None
        self._loaded: dict[str, tuple[object, ReadyScene, Sequence[str]]] = {}
        self._closed = False

    def submit(self, options: PictureOptions) -> RenderJob:
        """Queue a picture, or return an equal job; the current picture is cancelled."""
        with self._changed:
            same = [job for job in self._jobs.values() if _is_same(job, options)]
            if same:
                self._jobs.move_to_end(same[-1].id)
                return same[-1]
            job = RenderJob(id=str(next(self._numbers)), options=options)
            self._jobs[job.id] = job
            self._cancel(self._next)
            self._next = job
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._changed.notify_all()
            return job

    def cancel_all(self) -> None:
        """Cancel the current and the waiting picture."""
        with self._changed:
            self._cancel(self._next)
            self._next = None
            for job in self._jobs.values():
                if job.state == "working":
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
        """Return the job whose picture is the reference of another job; None without one."""
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

    def close(self) -> None:
        """Stop the thread at the next step of the current picture."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def join(self) -> None:
        """Wait for the current picture, which `close` ends at its next step.

        Libraries abort a process that ends while they work in one of its threads.
        """
        if self._thread is not None:
            self._thread.join(LAST_PICTURE_S)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._next is not None or self._closed)
                job = self._next
                self._next = None
                if job is None or self._closed:
                    return
                self._update(job, state="working")
            self._render(job)

    def _render(self, job: RenderJob) -> None:
        def show(step: Image | Sampling) -> None:
            with self._changed:
                if self._next is not None or self._closed or job.state != "working":
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

        state = "done"
        error = ""
        try:
            loaded, job.notes = self._load(job.options)
            job.scene_core_s = loaded.cpu_seconds
            show(loaded.render(job.options.camera, show))
        except _Superseded:
            state = "cancelled"
        except TrilightError as mistake:
            state = "failed"
            error = str(mistake)
        except Exception as defect:  # of any library: the page shows it, and the queue goes on
            state = "failed"
            error = f"{type(defect).__name__}: {defect}"
        with self._changed:
            job.error = error
            self._update(job, state=state)
            while len(self._jobs) > MOST_KEPT:
                self._jobs.popitem(last=False)

    def _load(self, options: PictureOptions) -> tuple[ReadyScene, Sequence[str]]:
        """Return the edited scene in the renderer of a request, and the notes on its pictures."""
        renderer = self._renderers[options.engine].make(options)
        key = (options.scene_key, renderer.identity)
        if self._loaded.get(options.engine, (None,))[0] != key:
            scene = self.scene(options.scene_key, options.edits)
            loaded = renderer.load(scene, "the scene")
            self._loaded[options.engine] = (key, loaded, [*loaded.notes, *renderer.notes])
        return self._loaded[options.engine][1:]

    def _cancel(self, job: RenderJob | None) -> None:
        if job is not None:
            self._update(job, state="cancelled")

    def _update(self, job: RenderJob, *, state: State | str | None = None) -> None:
        job.state = state or job.state  # type: ignore[assignment]
        job.version += 1
        self._changed.notify_all()


def agreement_db(job: RenderJob, reference: RenderJob | None) -> float | None:
    """Return psnr_log_db of a picture against the reference; None where one is missing."""
    if reference is None or reference is job or job.image is None or reference.image is None:
        return None
    if not _are_comparable(job.image, reference.image):
        return None
    return float(psnr_log_db(job.image.radiance_rgb, reference.image.radiance_rgb))


def _are_comparable(image: Image, other: Image) -> bool:
    if isinstance(image, PassImage) or isinstance(other, PassImage):
        return False
    return image.radiance_rgb.shape == other.radiance_rgb.shape


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
        and (job.image is None or _are_comparable(job.image, other.image))
    )
