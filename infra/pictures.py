"""Pictures of the documents: `python -m infra.pictures FOLDER` makes all, from a folder of objects.

The published ones show KayKit's Dungeon Remastered by Kay Lousberg (CC0). Every picture has a dark
ground of its own, so that it stands on light and on dark pages. Data is made once, and kept.
"""

import argparse
import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from infra.cli.console import console
from infra.render.path_tracer import PathTracer, RenderChild
from infra.viewer.open_source import open_handlers
from model.inference import NeuralRenderer
from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.preview import preview
from pipeline.assets.settings import AssetSettings
from pipeline.executors.threads import ThreadRunner
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.pipeline import make_dataset
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.renderer import RenderedView
from pipeline.renders.settings import measured_settings
from storage.conventions import preview_gain, preview_srgb8
from storage.dataset.dataset import open_dataset
from storage.metrics import psnr_log_db
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.renderer import Camera
from train.evaluation.sheet import ERROR_WHITE, heat_colors, mean_error

GROUND = (22, 25, 29)
INK = (240, 240, 236)
FAINT = (158, 167, 176)
GIVEN = FAINT
TRACED = (86, 156, 214)
LEARNED = (240, 146, 60)
"""A user's, the path tracer's and the network's: the colors of the bars above panels."""
GAP_PX = 12
BAR_PX = 6
TEXT_PX = 33
STATED_DB = (30, 40, 46)
AMPLIFIED = 5
"""How much brighter an error is drawn than in reports."""
QUALITY = 82
"""Of WebP: at most 150 kB a picture."""

Pixels = NDArray[np.uint8]

_STILL = {
    "scenes.materials.source": "object",
    "scenes.placement.orientation": "kept",
    "scenes.placement.resting_share": 1.0,
    "scenes.placement.overlap_share": 0.0,
    "scenes.textures.share": 1.0,
    "scenes.skies.share": 1.0,
    "scenes.cameras.up_jitter": 0.0,
    "scenes.cameras.target_jitter": 0.05,
    "scenes.cameras.elevation_deg": [14, 34],
    "scenes.cameras.fov_deg": [36, 42],
    "scenes.lights.count": [2, 3],
}
"""Objects stand upright on a textured floor, as a person would place them."""


def _family(template: str) -> dict[str, Any]:
    shell = {"square_share": 1.0, "scale": [1.5, 1.6], "raise_z": [0.55, 0.7]}
    return {
        "name": f"still-{template}",
        "template": template,
        "shell": shell,
        "num_objects": [2, 3],
        "object_scale": [0.9, 1.5],
    }


ROOMS = {
    **_STILL,
    "scenes.families": [_family("corner")],
    "scenes.skies.over_lamps_log": [0.02, 0.05],
}
"""A weak sky beside lamps: the included network knows lamps alone."""

SKIES = {
    **_STILL,
    "scenes.families": [_family("plane"), _family("wall")],
    "scenes.skies.seen_share": 1.0,
    "scenes.skies.over_lamps_log": [0.8, 2.5],
    "scenes.skies.maps.families": ["sun_and_sky", "clouds"],
    "scenes.cameras.elevation_deg": [4, 12],
}

ALONE = {
    "renders.resolution": 256,
    "scenes.num_views": 1,
    "scenes.max_triangles": 1100,
    "scenes.cameras.elevation_deg": [25, 30],
}
"""Of the preset `object-views`."""


GLOSSY = {"renders.noise_floor_db": 20.0, "renders.resolution": 128}
"""Drawn materials, stopped at the first measurement."""


@dataclass(frozen=True)
class Pictures:
    """Makes the pictures of one folder of objects."""

    objects: Path
    data: Path
    out: Path
    room: int
    """Number of the room that the first pictures show."""
    view: int
    """Row of its camera in these pictures."""

    def hero(self) -> None:
        """One scene in five steps: given mesh, clean mesh, traced, by the network, its error."""
        scene = self._room()
        traced = _trace(scene, self.view, 320, STATED_DB[-1])
        rows = [self.view]
        seen = scene.with_cameras(scene.c2w[rows], scene.fov_deg[rows])
        learned = NeuralRenderer.load("builtin:").render(seen, resolution=320)[0]
        source, level = self._meshes(scene)
        target = traced.radiance_rgb
        gain = preview_gain(target)
        agreement = f"{psnr_log_db(learned, target):.0f} dB, included"
        stated = f"stated error {traced.noise_floor_db:.0f} dB"
        error = heat_colors(AMPLIFIED * mean_error(learned, target) / ERROR_WHITE)
        panels = [
            _panel(_draw_mesh(source, 320), "Your mesh", _triangles(source), GIVEN),
            _panel(_draw_mesh(level, 320), "Clean mesh", _triangles(level), TRACED),
            _panel(preview_srgb8(gain * target), "Path traced", stated, TRACED),
            _panel(preview_srgb8(gain * learned), "Network", agreement, LEARNED),
            _panel(error, "Its error", f"{AMPLIFIED} times brighter", LEARNED),
        ]
        self._write("hero", _beside(panels))

    def stated_errors(self) -> None:
        """One view of drawn, glossy materials at 30, 40 and 46 dB, each with a detail."""
        views = [
            (abs(view.noise_floor_db - STATED_DB[0]), row, sample.scene)
            for sample in self._samples("glossy", GLOSSY)
            for row, view in enumerate(sample.views)
        ]
        _, row, scene = min(views, key=lambda each: each[0])
        images = [_trace(scene, row, 128, target) for target in STATED_DB]
        few, _, many = (image.radiance_rgb for image in images)
        gain = preview_gain(many)
        errors = mean_error(few, many)[16:-16, 16:-16].reshape(6, 16, 6, 16).mean(axis=(1, 3))
        top_px, left_px = (
            16 * int(cell) for cell in np.unravel_index(errors.argmax(), errors.shape)
        )
        panels = []
        for target, image in zip(STATED_DB, images, strict=True):
            display = preview_srgb8(gain * image.radiance_rgb)
            detail = display[top_px : top_px + 48, left_px : left_px + 48]
            parts = [part.repeat(384 // len(part), axis=0) for part in (display, detail)]
            both = np.concatenate([part.repeat(384 // part.shape[1], axis=1) for part in parts])
            said = f"{image.noise_floor_db:.0f} dB, {image.spp:,} samples"
            panels.append(_panel(both, f"Asked: {target} dB", said, TRACED))
        self._write("stated_errors", _beside(panels))

    def own_objects(self) -> None:
        """Objects of the folder: as given, clean, and rendered alone with their own materials."""
        columns = {}
        for sample in self._samples("alone", ALONE, build="object-views"):
            source, level = self._meshes(sample.scene)
            image = sample.radiance_rgb[0]
            display = np.maximum(
                preview_srgb8(preview_gain(image) * image), np.array(GROUND, np.uint8)
            )
            panels = [
                _panel(_draw_mesh(source, 256), "Your file", _triangles(source), GIVEN),
                _panel(_draw_mesh(level, 256), "Clean", _triangles(level), TRACED),
                _panel(display, "Rendered", "its own materials", TRACED),
            ]
            columns[-len(source.faces), len(level.faces)] = np.concatenate(panels)
        self._write("own_objects", _beside([columns[key] for key in sorted(columns)[:4]]))

    def textures_and_skies(self) -> None:
        """Six scenes with textures below skies."""
        images = [sample.radiance_rgb[0] for sample in self._samples("skies", SKIES)]
        display = [preview_srgb8(preview_gain(image) * image) for image in images[:6]]
        rows = [_beside(display[:3]), _beside(display[3:])]
        self._write("textures_and_skies", np.concatenate(rows))

    def viewer(self) -> None:
        """Screenshot of `trilight view`, where Chromium is."""
        if shutil.which("chromium") is None:
            console.print(
                "viewer: no picture, since Chromium is not installed (apt-get install chromium)"
            )
            return
        from tests.end_to_end.browser_kit import browser  # a checkout has it, and a wheel has not
        from tests.infra.viewer.served_kit import served

        self._room()
        shard = self.data / "rooms" / f"train-{self.room // 4:06d}.tar"
        room = open_handlers(f"{shard}::{self.room:09d}", checkpoint=None, threads=None)
        path = self.out / "viewer.png"
        with served(room) as asker, browser("--hide-scrollbars") as page:
            page.show(1100, 1270)
            page.open(f"http://{asker.here}/{asker.word}/")
            page.until(f"{_CARD} && !document.querySelector('.busy')")
            for kind in ("input", "change"):
                page.run(f"view.value = {self.view}; view.dispatchEvent(new Event('{kind}'))")
            page.run(f"{_CARD}.click()")
            page.until(f"{_CARD}.innerText.includes('stated')")
            page.until("!document.querySelector('.busy')")
            page.picture(path)
        self._write("viewer", np.asarray(Image.open(path).convert("RGB")))
        path.unlink()

    def _room(self) -> Scene:
        scenes = [sample.scene for sample in self._samples("rooms", ROOMS)]
        return next(s for s in scenes if s.provenance["scene_index"] == self.room)

    def _samples(
        self, name: str, changes: Mapping[str, Any], build: str = "tiny"
    ) -> Iterator[Sample]:
        """Make one of the datasets, unless it is there, and yield its training scenes."""
        options = GenerateOptions(
            build=build,
            objects=str(self.objects),
            out=str(self.data / name),
            scenes=16,
            seed=1,
            licence="CC0-1.0",
            changes=changes,
        )
        make_dataset(options, ThreadRunner())
        yield from open_dataset(str(self.data / name)).samples("train")

    def _meshes(self, scene: Scene) -> tuple[TriangleMesh, TriangleMesh]:
        """Return the object whose file has most triangles: that file, and what the scene has."""
        objects = [row for row, each in enumerate(scene.objects) if each.kind == "object"]
        source = {}
        for row in objects:
            path = next(self.objects.rglob(f"{Path(scene.objects[row].uid).stem}.*"))
            mesh = load_mesh(read_source(path, AssetSettings().read_limits))
            source[row] = orient_outward(clean(normalize(mesh)))[0]
        row = max(objects, key=lambda each: len(source[each].faces))
        faces = scene.faces[scene.object_index == row].astype(np.int64)
        positions = scene.vertex_positions.astype(np.float64)
        used, where = np.unique(faces, return_inverse=True)
        level = TriangleMesh(positions=positions[used], faces=where.reshape(-1, 3))
        return source[row], orient_outward(clean(normalize(level)))[0]

    def _write(self, name: str, pixels: Pixels) -> None:
        path = self.out / f"{name}.webp"
        Image.fromarray(pixels).save(path, quality=QUALITY, method=6)
        console.print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


_CARD = "[...document.querySelectorAll('.card')].find(c => c.innerText.startsWith('Path traced'))"


def _trace(scene: Scene, view: int, resolution: int, target_db: float) -> RenderedView:
    settings = measured_settings(resolution, {"noise_floor_db": target_db})
    tracer = PathTracer(RenderChild(choose_variant("auto")), settings)
    with contextlib.closing(tracer):
        # no preview, whose error is not measured
        return cast(
            RenderedView, tracer.load(scene, "scene").render_view(Camera.of_scene(scene, view))
        )


def _triangles(mesh: TriangleMesh) -> str:
    return f"{len(mesh.faces):,} triangles"


def _draw_mesh(mesh: TriangleMesh, width: int) -> Pixels:
    """Return a mesh with its edges on our ground [W, W, 3], as large as fits."""
    grey = Image.fromarray(preview(mesh, 2 * width))
    rows, columns = np.nonzero(np.asarray(grey) < 255)
    ends = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    half = np.ptp(ends, axis=0).max() / 1.8
    corners = ends.mean(axis=0) + np.array([[-half], [half]])
    box = (*corners[0].tolist(), *corners[1].tolist())
    near = grey.transform(
        (width, width), Image.Transform.EXTENT, box, Image.Resampling.BICUBIC, fillcolor=255
    )
    drawn = np.asarray(near, np.float64)[..., None].repeat(3, axis=2)
    empty = np.clip((drawn - 240) / 15, 0, 1)
    return np.round(empty * GROUND + (1 - empty) * drawn).astype(np.uint8)


def _panel(pixels: Pixels, title: str, text: str, color: tuple[int, int, int]) -> Pixels:
    """Return a picture below a bar and above two lines of text."""
    height, width = pixels.shape[:2]
    panel = Image.new("RGB", (width, BAR_PX + height + 3 * TEXT_PX), GROUND)
    panel.paste(color, (0, 0, width, BAR_PX))
    panel.paste(Image.fromarray(pixels), (0, BAR_PX))
    pen = ImageDraw.Draw(panel)
    for line, (words, ink) in enumerate(((title, INK), (text, FAINT))):
        place = (GAP_PX, BAR_PX + height + round((1.3 * line + 0.3) * TEXT_PX))
        pen.text(place, words, ink, ImageFont.load_default(TEXT_PX - 3 * line))
    return np.asarray(panel)


def _beside(panels: Sequence[Pixels]) -> Pixels:
    """Return panels in a row, with gaps between and around."""
    height, width = panels[0].shape[:2]
    step = width + GAP_PX
    row = np.full((height + 2 * GAP_PX, GAP_PX + step * len(panels), 3), GROUND, np.uint8)
    for place, pixels in enumerate(panels):
        left_px = GAP_PX + place * step
        row[GAP_PX : GAP_PX + height, left_px : left_px + width] = pixels
    return row


NAMES = ("hero", "stated_errors", "own_objects", "textures_and_skies", "viewer")


def main() -> None:
    """Make the pictures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("objects", type=Path, help="folder of at least 30 objects")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--data", type=Path, default=Path("data/pictures"))
    parser.add_argument("--room", type=int, nargs=2, default=(14, 1), help="scene and view to show")
    parser.add_argument("--only", nargs="*", choices=NAMES, default=NAMES)
    arguments = parser.parse_args()
    pictures = Pictures(arguments.objects, arguments.data, arguments.out, *arguments.room)
    for name in arguments.only:
        getattr(pictures, name)()


if __name__ == "__main__":
    main()
