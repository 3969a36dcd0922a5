"""Request handlers of a scene's page: the scene in 3D, pictures by every engine, and exports.

Below the page of many scenes, the most recent ones stay open.
"""

import dataclasses
import json
import shlex
import struct
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from starlette.responses import JSONResponse, Response

from infra.render.path_tracer import RenderChild
from infra.render.tone_mapping import ToneMap, tone_mapped
from infra.viewer.page_renderers import PageRenderer, PassImage, RenderJob, RenderQueue, job_record
from infra.viewer.picture_options import parse_picture_options, short_digest
from infra.viewer.server import NotFound, Request, Routes
from pipeline.documents.png import encode_png
from pipeline.exchange.convert import write_scene
from pipeline.exchange.formats import FORMATS, LoadedScene
from pipeline.exchange.renderformer_json import camera_entry
from storage.conventions import srgb8
from storage.errors import TrilightError
from storage.records.lights import num_lights
from storage.records.lookup import environment_values
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from storage.records.scene_facts import lights
from storage.records.texture import TEXTURED, Texture
from train.evaluation.sheet import error_picture

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
    loaded: LoadedScene
    renderers: Mapping[str, PageRenderer]
    source: str = ""
    """Scene as `trilight render` takes it; empty where it cannot."""
    child: RenderChild | None = None
    """Render child that `close` closes; None where other pages share it."""
    queue: RenderQueue = field(init=False)

    def __post_init__(self) -> None:
        self.scene = self.loaded.scene
        self.queue = RenderQueue(self.scene, self.renderers)
        self._writing = threading.Lock()

    def routes(self) -> Routes:
        """Return the routes of the page's requests."""
        return {
            "GET api/scene": self._facts,
            "GET api/scene.bin": lambda _: Response(scene_bytes(self.scene), media_type=_OCTETS),
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
        target = self.loaded.radiance_rgb
        engines = [
            {"name": name, "title": each.title, "means": each.means}
            for name, each in self.renderers.items()
        ]
        return JSONResponse(
            {
                "name": self.name,
                "triangles": scene.num_triangles,
                "lights": num_lights(scene),
                "materials": len(scene.materials),
                "textures": len(scene.textures),
                "views": scene.num_views,
                "target_px": None if target is None or not len(target) else target.shape[1],
                "template": str(scene.provenance.get("template", "")),
                "notes": list(self.loaded.notes),
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
        return Response(texture_png(self.scene.textures[int(name)]), media_type="image/png")

    def _sky(self, _: Request) -> Response:
        if self.scene.environment is None:
            raise NotFound("the scene has no environment.")
        return Response(sky_bytes(self.scene), media_type=_OCTETS)

    def _submit(self, request: Request) -> Response:
        options = parse_picture_options(request.body, self.renderers, self.scene.num_views)
        return JSONResponse({"id": self.queue.submit(options).id})

    def _cancel_all(self, _: Request) -> Response:
        self.queue.cancel_all()
        return JSONResponse({})

    def _progress(self, request: Request) -> Response:
        after = request.query.get("after", "0")
        number = request.path.removeprefix("api/picture/")
        job = self.queue.wait_for_update(number, int(after) if after.isdecimal() else 0)
        return JSONResponse({**job_record(job, self.queue), **self._reproduction(job)})

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
            if reference is None or reference.image is None:
                raise TrilightError("There is nothing to judge this picture by yet.")
            pixels = error_picture(job.image.radiance_rgb, reference.image.radiance_rgb)
        elif isinstance(job.image, PassImage):
            pixels = job.image.pixels
        else:
            pixels = _tone_map(job.image.radiance_rgb, request.query)
        return Response(encode_png(pixels), media_type="image/png")

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
        return Response(data, media_type=_OCTETS, headers={"X-Lost": said} if said else {})


def _tone_map(radiance_rgb: NDArray[np.float32], query: Mapping[str, str]) -> NDArray[np.uint8]:
    tone_map: ToneMap = "filmic" if query.get("tone") == "filmic" else "plain"
    try:
        exposure_ev = float(query.get("ev", "0"))
    except ValueError as error:
        raise TrilightError("ev: expected a number of stops.") from error
    if not -32 <= exposure_ev <= 32:
        raise TrilightError(f"ev is {exposure_ev}; expected -32 to 32.")
    return tone_mapped(radiance_rgb, tone_map, exposure_ev)


MOST_TRIANGLES = 1_500_000
"""Maximum number of triangles; a browser holds 96 bytes of each, three times."""

MOST_GROUPS = 5000
"""Maximum number of pairs of object and material; each needs a draw call."""

_SIDE = 2048
"""Maximum width and height in pixels of textures for the browser; larger ones are reduced."""

_SKY_ROWS = 128


def scene_bytes(scene: Scene) -> bytes:
    """Return a scene as one block of bytes for the browser's 3D view, which reads it in place.

        4 bytes      length of the JSON, little-endian; the JSON is padded to a multiple of 4
        JSON         groups, materials, textures, sky, cameras, lamps, bounds
        float32      positions [3T, 3], normals [3T, 3], and uv [3T, 2] where anything is textured

    Triangles are sorted into groups of one object and one material. The 3D view is for orientation
    only; the rendered pictures beside it are exact.

    Raises:
        TrilightError: the scene has more triangles or groups than a browser draws.
    """
    if scene.num_triangles > MOST_TRIANGLES:
        raise TrilightError(
            f"{scene.num_triangles} triangles; expected at most {MOST_TRIANGLES} to turn the scene "
            "in 3D. Its pictures are made all the same."
        )
    order, groups = _groups(scene)
    corners = scene.faces[order].reshape(-1)
    arrays = [scene.vertex_positions[corners], scene.vertex_normals[corners]]
    if scene.uv is not None:
        arrays.append(scene.uv.reshape(-1, 3, 2)[order].reshape(-1, 2))
    head = {
        "groups": groups,
        "materials": [_material(scene, row) for row in range(len(scene.materials))],
        "objects": [{"name": entry.name, "kind": entry.kind} for entry in scene.objects],
        "lamps": [
            {"object": light.row, "centre": light.centre, "area": light.area,
             "radiance": light.radiance_rgb}
            for light in lights(scene)
        ],
        "cameras": [
            {"c2w": c2w.reshape(-1).tolist(), "fov": float(fov_deg)}
            for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
        ],
        "corners": len(corners),
        "uv": scene.uv is not None,
        "sky": None if scene.environment is None else {"seen": scene.environment.is_seen},
    }  # fmt: skip
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    blocks = [np.ascontiguousarray(array, "<f4").tobytes() for array in arrays]
    return b"".join((struct.pack("<I", len(text)), text, *blocks))


def texture_png(texture: Texture) -> bytes:
    """Return a texture as PNG: colors sRGB-encoded, numbers linear, the bottom row last."""
    linear = texture.linear(texture.texels)[::-1]
    if texture.channels == 3:
        pixels = srgb8(linear)
    else:
        pixels = np.round(255 * linear).astype(np.uint8).repeat(3, axis=2)
    if max(pixels.shape[:2]) > _SIDE:
        picture = Picture.fromarray(pixels)
        picture.thumbnail((_SIDE, _SIDE))
        pixels = np.asarray(picture)
    return encode_png(pixels)


def sky_bytes(scene: Scene) -> bytes:
    """Return the environment map in the layout of three.js, for directions of Trilight's world.

    There u is atan2(z, x) / 2 pi + 1/2 and v is asin(y) / pi + 1/2: small, [rows, 2 rows, 4] in
    float32, v rising, after its width and height as two unsigned integers.
    """
    assert scene.environment is not None
    texels = scene.environment.radiance_rgb
    step = max(1, len(texels) // _SKY_ROWS)  # blocks of texels are averaged
    rows = len(texels) // step
    blocks = texels[: rows * step, : 2 * rows * step].reshape(rows, step, 2 * rows, step, 3)
    sky = dataclasses.replace(scene.environment, radiance_rgb=blocks.mean(axis=(1, 3)))
    height = (np.arange(rows) + 0.5) / rows * np.pi - np.pi / 2
    around = (np.arange(2 * rows) + 0.5) / rows * np.pi - np.pi
    flat = np.cos(height)[:, None]
    up = np.broadcast_to(np.sin(height)[:, None], (rows, 2 * rows))
    directions = np.stack([flat * np.cos(around), up, flat * np.sin(around)], axis=-1)
    rgba = np.ones((rows, 2 * rows, 4), "<f4")
    rgba[..., :3] = environment_values(sky, directions)
    return struct.pack("<II", 2 * rows, rows) + rgba.tobytes()


def _groups(scene: Scene) -> tuple[NDArray[np.int64], list[Mapping[str, int]]]:
    """Return the order of triangles, and the range of each pair of object and material in it."""
    pair = scene.object_index.astype(np.int64) << 16 | scene.material_index
    order = np.argsort(pair, kind="stable")
    values, first, count = np.unique(pair[order], return_index=True, return_counts=True)
    if len(values) > MOST_GROUPS:
        raise TrilightError(
            f"{len(values)} parts of objects and materials; expected at most {MOST_GROUPS} to turn "
            "the scene in 3D. Its pictures are made all the same."
        )
    return order, [
        {"object": v >> 16, "material": v & 0xFFFF, "first": 3 * f, "count": 3 * n}
        for v, f, n in zip(values.tolist(), first.tolist(), count.tolist(), strict=True)
    ]


def _material(scene: Scene, row: int) -> Mapping[str, Any]:
    values = scene.materials[row]
    worn = None if scene.material_textures is None else scene.material_textures[row].tolist()
    maps = {name: at for name, at in zip(TEXTURED, worn or (), strict=False) if at >= 0}
    return {
        "diffuse": values[DIFFUSE].tolist(),
        "specular": values[SPECULAR].tolist(),
        "roughness": float(values[ROUGHNESS]),
        "emission": values[EMISSION].tolist(),
        "maps": maps,
    }
