"""Request handlers of a scene's page: the scene in 3D, pictures by every engine, and exports.

Below the page of many scenes, the most recent ones stay open.
"""

import dataclasses
import json
import re
import shlex
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.render.path_tracer import RenderChild
from infra.render.tone_mapping import ToneMap, tone_mapped
from infra.viewer.page_renderers import PageRenderer, PassImage, StoredPictures, page_renderers
from infra.viewer.picture_options import parse_picture_options, short_digest
from infra.viewer.render_queue import RenderJob, RenderQueue, agreement_db
from infra.viewer.scene_bytes import scene_bytes, sky_bytes, texture_png
from infra.viewer.server import (
    NotFound,
    Request,
    Response,
    Routes,
    dispatch,
    json_response,
    static_routes,
)
from pipeline.documents.png import encode_png
from pipeline.documents.scene_page import preview
from pipeline.exchange.convert import write_scene
from pipeline.exchange.formats import FORMATS, LoadedScene
from pipeline.exchange.renderformer_json import camera_entry
from storage.conventions import preview_gain
from storage.errors import TrilightError
from storage.records.lights import num_lights
from storage.records.scene import Scene
from train.evaluation.error_colors import ERROR_WHITE, error_picture

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

MOST_THUMBNAILS = 1000
"""Maximum number of small pictures that a page keeps."""

_OCTETS = "application/octet-stream"
MOST_OPEN = 3
"""Maximum number of scenes whose pages stay open."""

_BELOW = re.compile(r"scene/([^/]+)/(.*)", re.DOTALL)


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
        self.queue.close()
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
            pixels = self._error_of(job)
        elif isinstance(job.image, PassImage):
            pixels = job.image.pixels
        else:
            pixels = _tone_map(job.image.radiance_rgb, request.query)
        return Response(body=encode_png(pixels), kind="image/png")

    def _error_of(self, job: RenderJob) -> NDArray[np.uint8]:
        reference = self.queue.reference(job)
        if agreement_db(job, reference) is None:
            raise TrilightError("There is nothing to judge this picture by yet.")
        assert job.image is not None and reference is not None and reference.image is not None
        return error_picture(job.image.radiance_rgb, reference.image.radiance_rgb)

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


def thumbnail_png(radiance_rgb: NDArray[np.float32], width: int) -> bytes:
    """Return a picture [R, R, 3] of linear radiance as a small PNG, exposed for looking."""
    return encode_png(preview(radiance_rgb * preview_gain(radiance_rgb), width))


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


class OpenScenes:
    """Handlers of the most recent scenes by key, each at `scene/KEY/`."""

    def __init__(self, key: re.Pattern[str], open_scene: Callable[[str], SceneHandlers]) -> None:
        """Store the pattern of keys, and the function that opens a scene by its key."""
        self._key = key
        self._open_scene = open_scene
        self._opening = threading.Lock()
        self._open = OrderedDict[str, SceneHandlers]()

    def close(self) -> None:
        """Stop rendering, and wait for its end."""
        for room in self._open.values():
            room.close()

    def respond(self, request: Request) -> Response:
        """Respond to a request below a scene's page."""
        match = _BELOW.fullmatch(request.path)
        if match is None or not self._key.fullmatch(match[1]):
            raise NotFound("there is no such scene.")
        key = match[1]
        with self._opening:
            room = self._open.pop(key, None) or self._open_scene(key)
            self._open[key] = room
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].queue.close()
        below = dataclasses.replace(request, path=match[2])
        return dispatch({**static_routes("scene.html"), **room.routes()}, below)
