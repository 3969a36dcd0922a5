"""What the page of a scene may ask: the scene in 3D, pictures by every engine, and files of it."""

import json
import shlex
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from infra.rendering.look import Look, ToneMap, tone_mapped
from infra.viewer.easel import Easel, Job, agreement_db
from infra.viewer.painters import Painter, render_words
from infra.viewer.scene_bytes import scene_bytes, sky_bytes, texture_png
from infra.viewer.server import Answer, NotThere, Question, Route, json_answer
from infra.viewer.wanted import edits_of, wanted_of
from pipeline.documents.png import encode_png
from pipeline.exchange.convert import write_scene
from pipeline.exchange.formats import FORMATS
from pipeline.exchange.renderformer_json import camera_entry
from pipeline.making.progressive_tracer import ProgressiveTracer
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.lights import num_lights
from storage.records.scene import Scene
from train.evaluation.error_colours import ERROR_WHITE, error_picture

EXPORTS = {
    ".usdz": "USD with textures",
    ".usda": "USD as text",
    ".glb": "glTF",
    ".h5": "RenderFormer",
    ".safetensors": "exact",
}
"""Forms of one file that a page offers, as far as they can be written."""

CAMERA = "camera.json"
EDITED = "scene.safetensors"
"""What the page saves, as the commands name it that it shows."""

_OCTETS = "application/octet-stream"


@dataclass(kw_only=True, eq=False)
class SceneRoom:
    """One scene and its pictures."""

    name: str
    """For the page."""
    scene: Scene
    notes: Sequence[str]
    """What could not be carried over from its file."""
    painters: Mapping[str, Painter]
    target_px: int | None
    """Width of the pictures that the file holds."""
    source: str = ""
    """Scene as `trilight render` takes it; empty where it can take none."""
    tracer: ProgressiveTracer | None = None
    """Ends with the room, where it is of this room alone."""
    easel: Easel = field(init=False)

    def __post_init__(self) -> None:
        self.easel = Easel(self.scene, self.painters)
        self._writing = threading.Lock()

    def gets(self) -> dict[str, Route]:
        """Return what is asked by GET."""
        return {
            "api/scene": self._facts,
            "api/scene.bin": lambda _: Answer(body=scene_bytes(self.scene), kind=_OCTETS),
            "api/texture/": self._texture,
            "api/sky.bin": self._sky,
            "api/picture/": self._news,
            "api/shown/": self._shown,
        }

    def posts(self) -> dict[str, Route]:
        """Return what is asked by POST."""
        return {"api/picture": self._ask, "api/rest": self._rest, "api/export": self._export}

    def close(self) -> None:
        """End what is being made."""
        self.easel.close()
        self.easel.join()
        if self.tracer is not None:
            self.tracer.close()

    def _facts(self, _: Question) -> Answer:
        scene = self.scene
        engines = [
            {"name": name, "title": each.title, "means": each.means}
            for name, each in self.painters.items()
        ]
        return json_answer(
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
        """Return whether a form of one file can be written; text has its pictures beside it."""
        form = FORMATS.get(suffix)
        scene = self.scene
        pictures = suffix == ".usda" and (scene.textures or scene.environment is not None)
        return form is not None and form.write is not None and not pictures

    def _texture(self, question: Question) -> Answer:
        name = question.path.removeprefix("api/texture/")
        if not (name.isascii() and name.isdecimal()) or int(name) >= len(self.scene.textures):
            raise NotThere("the scene has no such texture.")
        return Answer(body=texture_png(self.scene.textures[int(name)]), kind="image/png")

    def _sky(self, _: Question) -> Answer:
        if self.scene.environment is None:
            raise NotThere("the scene has no environment.")
        return Answer(body=sky_bytes(self.scene), kind=_OCTETS)

    def _ask(self, question: Question) -> Answer:
        wanted = wanted_of(question.body, self.painters, self.scene.num_views)
        return json_answer({"id": self.easel.ask(wanted).id})

    def _rest(self, _: Question) -> Answer:
        self.easel.rest()
        return json_answer({})

    def _news(self, question: Question) -> Answer:
        after = question.query.get("after", "0")
        number = question.path.removeprefix("api/picture/")
        job = self.easel.news(number, int(after) if after.isdecimal() else 0)
        return json_answer({**_told(job, self.easel.truth(job)), **self._repeated(job)})

    def _repeated(self, job: Job) -> Mapping[str, Any]:
        """Return the command that makes a picture, and its camera in a form that `render` reads."""
        wanted = job.wanted
        camera = job.wanted.camera
        place = ["--view", str(wanted.view), "--out", "view.exr"]
        if wanted.view is None:  # of a file of cameras come many pictures, into a folder
            place = ["--cameras", CAMERA, "--out", "view"]
        words = ["trilight", "render", EDITED if wanted.edits else self.source, *place]
        words += ["--resolution", str(wanted.resolution)]
        command = shlex.join([*words, *render_words(self.painters[wanted.engine], wanted)])
        camera_file = json.dumps({"cameras": [camera_entry(camera.c2w, camera.fov_deg)]})
        return {"command": command if self.source else "", "camera": camera_file}

    def _shown(self, question: Question) -> Answer:
        job = self.easel.job(question.path.removeprefix("api/shown/"))
        if job.painted is None:
            raise NotThere("the picture has not begun yet.")
        if question.query.get("as") == "error":
            pixels = self._error_of(job)
        elif job.painted.radiance_rgb is None:
            assert job.painted.pixels is not None
            pixels = job.painted.pixels
        else:
            pixels = _toned(job.painted.radiance_rgb, question.query)
        return Answer(body=encode_png(pixels), kind="image/png")

    def _error_of(self, job: Job) -> NDArray[np.uint8]:
        truth = self.easel.truth(job)
        if agreement_db(job, truth) is None:
            raise TrilightError("There is nothing to judge this picture by yet.")
        assert job.painted is not None and truth is not None and truth.painted is not None
        mine = job.painted.radiance_rgb
        other = truth.painted.radiance_rgb
        assert mine is not None and other is not None
        return error_picture(mine, other)

    def _export(self, question: Question) -> Answer:
        body = question.body if isinstance(question.body, dict) else {}
        suffix = str(body.get("form"))
        edits = edits_of(body)
        if suffix not in EXPORTS or not self._is_offered(suffix):
            raise TrilightError(f"form {suffix:.20}: expected one of {' '.join(EXPORTS)}.")
        key = sha256_hex(canonical_json(edits))[:24]
        with self._writing, tempfile.TemporaryDirectory(prefix="trilight-view-") as folder:
            path = Path(folder) / f"scene{suffix}"
            lost = write_scene(path, self.easel.scene(key, edits))
            data = path.read_bytes()
        said = "; ".join(lost).encode("ascii", "replace").decode()[:800]
        return Answer(body=data, kind=_OCTETS, headers={"X-Lost": said} if said else {})


def _told(job: Job, truth: Job | None) -> Mapping[str, Any]:
    painted = job.painted
    sampling = job.sampling
    told: dict[str, Any] = {
        "id": job.id,
        "engine": job.wanted.engine,
        "state": job.state,
        "version": job.version,
        "error": job.error,
        "prices": job.prices,
        "shown": painted is not None,
    }
    if sampling is not None:
        told["sampling"] = {"spp": sampling.spp, "expected_spp": sampling.expected_spp}
    if painted is not None:
        told |= {
            "spp": painted.spp,
            "core_s": painted.core_s,
            "scene_core_s": painted.scene_core_s,
            "floor_db": painted.floor_db,
            "says": painted.says,
            "notes": list(painted.notes),
            "agreement_db": agreement_db(job, truth),
            "truth": None if truth is None else truth.wanted.engine,
            "error_white": ERROR_WHITE,
        }
    return told


def _toned(radiance_rgb: NDArray[np.float32], query: Mapping[str, str]) -> NDArray[np.uint8]:
    tone_map: ToneMap = "filmic" if query.get("tone") == "filmic" else "plain"
    try:
        exposure_ev = float(query.get("ev", "0"))
    except ValueError as error:
        raise TrilightError("ev: expected a number of stops.") from error
    if not -32 <= exposure_ev <= 32:
        raise TrilightError(f"ev is {exposure_ev}; expected -32 to 32.")
    look = Look(tone_map=tone_map, exposure_ev=exposure_ev)
    return tone_mapped(radiance_rgb * np.float32(2.0**look.exposure_ev), look.tone_map)
