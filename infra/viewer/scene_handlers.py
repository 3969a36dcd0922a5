"""Request handlers of a scene's page: the scene in 3D, pictures by every engine, and exports.

Below the page of many scenes, the most recent ones stay open. A queue renders one picture of a
scene at a time, and a new request cancels the current one. Finished pictures are kept for a while,
so that switching back to one costs nothing. Pictures of one scene, camera and width are compared
with the best of them: the one stored in the file, else the path traced one.
"""

import itertools
import json
import shlex
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from infra.render.path_tracer import RenderChild
from infra.render.tone_mapping import ToneMap, tone_mapped
from infra.viewer.page_renderers import PageRenderer, PassImage, StoredPictures, page_renderers
from infra.viewer.picture_options import (
    PictureOptions,
    apply_edits,
    parse_picture_options,
    short_digest,
)
from infra.viewer.scene_bytes import scene_bytes, sky_bytes, texture_png
from infra.viewer.server import (
    NotFound,
    Request,
    Response,
    Routes,
    json_response,
)
from pipeline.documents.png import encode_png
from pipeline.exchange.convert import write_scene
from pipeline.exchange.formats import FORMATS, LoadedScene
from pipeline.exchange.renderformer_json import camera_entry
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.lights import num_lights
from storage.records.scene import Scene
from storage.renderer import Image, ReadyScene, Sampling
from train.evaluation.sheet import ERROR_WHITE, error_picture

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


EXPORTS = {
    ".usdz": "USD with textures",
    ".usda": "USD as text",
    ".glb": "glTF",
    ".h5": "RenderFormer",
    ".safetensors": "exact",
}
"""Title of each export format by suffix; a page offers those that can be written."""

CAMERA = "camera.json"
EDITED = "scene.safetensors"
"""Names of saved files in the commands that the page shows."""

_OCTETS = "application/octet-stream"


@dataclass(kw_only=True, eq=False)
class SceneHandlers:
    """Handlers of one scene and its pictures."""

    name: str
    scene: Scene
    notes: Sequence[str]
    """Losses of the conversion from the scene's file."""
    renderers: Mapping[str, PageRenderer]
    target_px: int | None
    """Width in pixels of the pictures in the file; None without such pictures."""
    source: str = ""
    """Scene as `trilight render` takes it; empty where it cannot."""
    child: RenderChild | None = None
    """Render child that `close` closes; None where other pages share it."""
    queue: RenderQueue = field(init=False)

    def __post_init__(self) -> None:
        self.queue = RenderQueue(self.scene, self.renderers)
        self._writing = threading.Lock()

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            "GET api/scene": self._facts,
            "GET api/scene.bin": lambda _: Response(body=scene_bytes(self.scene), kind=_OCTETS),
            "GET api/texture/": self._texture,
            "GET api/sky.bin": self._sky,
            "GET api/picture/": self._progress,
            "GET api/shown/": self._image_png,
            "POST api/picture": self._submit,
            "POST api/rest": self._cancel_all,
            "POST api/export": self._export,
        }

    def close(self) -> None:
        """Stop rendering, and wait for its end."""
        self.queue.cancel_all()
        self.queue.join()
        if self.child is not None:
            self.child.close()

    def _facts(self, _: Request) -> Response:
        scene = self.scene
        engines = [
            {"name": name, "title": each.title, "means": each.means}
            for name, each in self.renderers.items()
        ]
        return json_response(
            {
                "name": self.name,
                "triangles": scene.num_triangles,
                "lights": num_lights(scene),
                "materials": len(scene.materials),
                "textures": len(scene.textures),
                "views": scene.num_views,
                "target_px": self.target_px,
                "template": str(scene.provenance.get("template", "")),
                "notes": list(self.notes),
                "engines": engines,
                "exports": [pair for pair in EXPORTS.items() if self._is_offered(pair[0])],
            }
        )

    def _is_offered(self, suffix: str) -> bool:
        """Return whether the scene can be exported as one file; .usda keeps pictures outside."""
        form = FORMATS.get(suffix)
        scene = self.scene
        pictures = suffix == ".usda" and (scene.textures or scene.environment is not None)
        return form is not None and form.write is not None and not pictures

    def _texture(self, request: Request) -> Response:
        name = request.path.removeprefix("api/texture/")
        if not (name.isascii() and name.isdecimal()) or int(name) >= len(self.scene.textures):
            raise NotFound("the scene has no such texture.")
        return Response(body=texture_png(self.scene.textures[int(name)]), kind="image/png")

    def _sky(self, _: Request) -> Response:
        if self.scene.environment is None:
            raise NotFound("the scene has no environment.")
        return Response(body=sky_bytes(self.scene), kind=_OCTETS)

    def _submit(self, request: Request) -> Response:
        options = parse_picture_options(request.body, self.renderers, self.scene.num_views)
        return json_response({"id": self.queue.submit(options).id})

    def _cancel_all(self, _: Request) -> Response:
        self.queue.cancel_all()
        return json_response({})

    def _progress(self, request: Request) -> Response:
        after = request.query.get("after", "0")
        number = request.path.removeprefix("api/picture/")
        job = self.queue.wait_for_update(number, int(after) if after.isdecimal() else 0)
        return json_response(
            {**_job_record(job, self.queue.reference(job)), **self._reproduction(job)}
        )

    def _reproduction(self, job: RenderJob) -> Mapping[str, Any]:
        """Return the command that renders a picture, and its camera as a file for that command."""
        options = job.options
        camera = job.options.camera
        place = ["--view", str(camera.view), "--out", "view.exr"]
        if camera.view is None:  # a camera file means many pictures, which need a folder
            place = ["--cameras", CAMERA, "--out", "view"]
        words = ["trilight", "render", EDITED if options.edits else self.source, *place]
        words += ["--resolution", str(options.resolution)]
        quality = self.renderers[options.engine].words
        command = shlex.join([*words, *(quality or ("--noise-floor", f"{options.error_db:g}"))])
        camera_file = json.dumps({"cameras": [camera_entry(camera.c2w, camera.fov_deg)]})
        return {"command": command if self.source else "", "camera": camera_file}

    def _image_png(self, request: Request) -> Response:
        job = self.queue.job(request.path.removeprefix("api/shown/"))
        if job.image is None:
            raise NotFound("the picture has not begun yet.")
        if request.query.get("as") == "error":
            reference = self.queue.reference(job)
            if reference is None or agreement_db(job, reference) is None:
                raise TrilightError("There is nothing to judge this picture by yet.")
            assert reference.image is not None
            pixels = error_picture(job.image.radiance_rgb, reference.image.radiance_rgb)
        elif isinstance(job.image, PassImage):
            pixels = job.image.pixels
        else:
            pixels = _tone_map(job.image.radiance_rgb, request.query)
        return Response(body=encode_png(pixels), kind="image/png")

    def _export(self, request: Request) -> Response:
        body = request.body if isinstance(request.body, dict) else {}
        suffix = str(body.get("form"))
        if suffix not in EXPORTS or not self._is_offered(suffix):
            raise TrilightError(f"form {suffix:.20}: expected one of {' '.join(EXPORTS)}.")
        edits = body.get("edits") or {}
        key = short_digest(edits)
        with self._writing, tempfile.TemporaryDirectory(prefix="trilight-view-") as folder:
            path = Path(folder) / f"scene{suffix}"
            lost = write_scene(path, self.queue.scene(key, edits))
            data = path.read_bytes()
        said = "; ".join(lost).encode("ascii", "replace").decode()[:800]
        return Response(body=data, kind=_OCTETS, headers={"X-Lost": said} if said else {})


def handlers_of_scene(
    name: str,
    loaded: LoadedScene,
    source: str,
    child: RenderChild,
    checkpoint: str | None,
    errors_db: Sequence[float] = (),
) -> SceneHandlers:
    """Return the handlers of a loaded scene; they do not close the render child.

    Args:
        source: scene as `trilight render` takes it; empty where it cannot.
        child, checkpoint: render child and network of the page.
        errors_db: stated errors of the pictures as psnr_log_db.
    """
    target = None
    if loaded.radiance_rgb is not None and len(loaded.radiance_rgb):
        target = StoredPictures(
            scene=loaded.scene, radiance_rgb=loaded.radiance_rgb, errors_db=errors_db
        )
    return SceneHandlers(
        name=name,
        scene=loaded.scene,
        notes=loaded.notes,
        renderers=page_renderers(child, target, checkpoint),
        target_px=None if target is None else target.resolution,
        source=source,
    )


def _job_record(job: RenderJob, reference: RenderJob | None) -> Mapping[str, Any]:
    image = job.image
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
            "agreement_db": agreement_db(job, reference),
            "truth": None if reference is None else reference.options.engine,
            "error_white": ERROR_WHITE,
        }
    return record


def _tone_map(radiance_rgb: NDArray[np.float32], query: Mapping[str, str]) -> NDArray[np.uint8]:
    tone_map: ToneMap = "filmic" if query.get("tone") == "filmic" else "plain"
    try:
        exposure_ev = float(query.get("ev", "0"))
    except ValueError as error:
        raise TrilightError("ev: expected a number of stops.") from error
    if not -32 <= exposure_ev <= 32:
        raise TrilightError(f"ev is {exposure_ev}; expected -32 to 32.")
    return tone_mapped(radiance_rgb * np.float32(2.0**exposure_ev), tone_map)
