"""The HTML page of one scene: its pictures, and tables of its contents."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.html import (
    Cell,
    Markup,
    element,
    enlargeable,
    join_markup,
    outside_link,
    page,
    png_uri,
    table,
)
from pipeline.documents.pass_colors import id_colors
from pipeline.documents.scene_maps import MAPS_STYLE, maps_section
from pipeline.documents.scene_passes import PASSES_STYLE, passes_section
from storage.conventions import preview_gain, preview_srgb8, srgb8
from storage.records.material import DIFFUSE
from storage.records.objects import Failure
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.records.scene_facts import cameras, lights, surfaces

_PICTURE_PX = 384
_MOST_SWATCHES = 128
_STYLE = """
.views { display: flex; flex-wrap: wrap; gap: 1rem }
figure { margin: 0 } figure img { display: block; width: min(272px, 42vw); background: #111 }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .2rem }
.swatches { font-size: 0; line-height: 0 }
.swatches i, .id { display: inline-block; width: 13px; height: 13px; margin: 1px }
nav { display: flex; gap: 1.5rem } td:first-child { min-width: 9rem }
.objects td:nth-child(2) { white-space: nowrap }
"""


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """Relative links of a scene's page."""

    report: str
    """Link to the report with all scenes."""
    before: str | None
    """Link to the previous scene, if there is one."""
    after: str | None
    """Link to the next scene, if there is one."""


def encode_scene_page(
    sample: Sample, split: str, rejected: Sequence[Failure], links: Neighbours
) -> bytes:
    """Return the page of one scene.

    Args:
        sample: a valid scene with its pictures.
        split: split of the scene.
        rejected: rejected attempts at the scene and its views.
        links: relative links to the other pages.
    """
    scene = sample.scene
    title = f"Scene {sample.key}"
    template = scene.provenance.get("template", "")
    summary = f"{split}, template {template}, {scene.num_triangles} triangles"
    body = [
        _navigation(links),
        element("h1", title),
        element("p", summary),
        element("div", *_figures(sample), class_="views"),
        element("h2", "Views"),
        _views(sample),
        *_parts(sample),
        passes_section(sample),
        element("h2", "Objects"),
        _objects(scene),
        element("h2", "Materials"),
        _materials(scene),
        *maps_section(scene),
        element("h2", "Lights"),
        _lights(scene),
        *_attempts(rejected),
        element("h2", "Provenance"),
        _provenance(scene.provenance),
    ]
    return page(title, join_markup(body), style=_STYLE + PASSES_STYLE + MAPS_STYLE)


def preview(radiance_rgb: NDArray[np.float32], width: int) -> NDArray[np.uint8]:
    """Return a picture tone-mapped for display, reduced to at most `width` pixels [W, W, 3]."""
    pixels = preview_srgb8(radiance_rgb)
    if pixels.shape[1] <= width:
        return pixels
    height = max(1, round(pixels.shape[0] * width / pixels.shape[1]))
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


def _navigation(links: Neighbours) -> Markup:
    anchors = [element("a", "All scenes", href=links.report)]
    if links.before is not None:
        anchors.append(element("a", "← before", href=links.before))
    if links.after is not None:
        anchors.append(element("a", "next →", href=links.after))
    return element("nav", *anchors)


def _figures(sample: Sample) -> list[Markup]:
    figures = []
    gain = preview_gain(sample.radiance_rgb)
    for view, (picture, record) in enumerate(zip(sample.radiance_rgb, sample.views, strict=True)):
        uri = png_uri(preview(picture * gain, _PICTURE_PX))
        mark = ", at the cap" if record.at_cap else ""
        mark += f", shown {-np.log2(gain):.1f} stops darker" if gain < 1 else ""
        caption = f"view {view}: {float(record.noise_floor_db):.1f} dB, {record.spp} spp{mark}"
        figures.append(
            element("figure", enlargeable(uri, f"view {view}"), element("figcaption", caption))
        )
    return figures


def _views(sample: Sample) -> Markup:
    rows: list[list[Cell]] = []
    pairs = zip(cameras(sample.scene), sample.views, strict=True)
    for view, (camera, record) in enumerate(pairs):
        rows.append(
            [
                view,
                _triple(camera.position, 3),
                f"{camera.distance:.3f}",
                f"{camera.elevation_deg:.1f}",
                f"{camera.azimuth_deg:.1f}",
                f"{camera.fov_deg:.1f}",
                record.spp,
                f"{float(record.noise_floor_db):.2f}",
                f"{float(record.noise_floor_linear_db):.2f}",
                f"{float(record.object_noise_floor_db):.2f}",
                f"{record.coverage:.2f}",
                "yes" if record.at_cap else "no",
                record.camera_attempt,
                record.seed,
            ]
        )
    head = (
        "view", "camera at, m", "distance", "elevation °", "azimuth °", "fov °", "spp",
        "floor dB", "linear dB", "objects dB", "coverage", "at cap", "attempt", "seed",
    )  # fmt: skip
    return table(head, rows, numbers=len(head) - 1)


def _parts(sample: Sample) -> list[Markup]:
    """Return the pictures of the stored light components, with their noise floors."""
    if sample.parts_rgb is None:
        return []
    figures = []
    rows = list[list[Cell]]()
    gain = preview_gain(sample.radiance_rgb)
    for view, record in enumerate(sample.views):
        for part, floor in (record.parts or {}).items():
            picture = sample.parts_rgb[part][view]
            together = picture.sum(axis=0) if picture.ndim == 4 else picture
            name = f"view {view}, {part}"
            picture_box = enlargeable(png_uri(preview(together * gain, _PICTURE_PX)), name)
            figures.append(element("figure", picture_box, element("figcaption", name)))
            floors = (
                floor.noise_floor_db,
                floor.noise_floor_linear_db,
                floor.object_noise_floor_db,
            )
            rows.append([view, part, *(f"{float(floor_db):.2f}" for floor_db in floors)])
    head = ("view", "part", "floor dB", "linear dB", "objects dB")
    pictures = element("div", *figures, class_="views")
    return [element("h2", "Parts"), pictures, table(head, rows, numbers=3)]


def _objects(scene: Scene) -> Markup:
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    shading = {s.row: "smooth" if s.smooth else "flat" for s in surfaces(scene)}
    rows: list[list[Cell]] = [
        [
            join_markup([_square(id_colors(row), class_="id"), entry.name], " "),
            entry.kind,
            entry.uid,
            entry.licence,
            entry.attribution,
            outside_link(entry.source_url),
            shading.get(row, ""),
            int(counts[row]),
        ]
        for row, entry in enumerate(scene.objects)
    ]
    head = ("name", "kind", "uid", "licence", "attribution", "source", "shading", "triangles")
    return table(head, rows, numbers=1, class_="objects")


def _materials(scene: Scene) -> Markup:
    rows: list[list[Cell]] = [
        [
            scene.objects[surface.row].name,
            _swatches(scene, surface.row),
            surface.num_colours,
            f"{surface.diffuse:.3f}",
            f"{surface.specular:.3f}",
            f"{surface.albedo_sum:.3f}",
            f"{surface.roughness:.3f}",
        ]
        for surface in surfaces(scene)
    ]
    head = ("surface", "diffuse colours", "colours", "diffuse", "specular", "sum", "roughness")
    return table(head, rows, numbers=5)


def _swatches(scene: Scene, row: int) -> Markup:
    used = np.unique(scene.material_index[scene.object_index == row])
    colours = srgb8(scene.materials[used[:_MOST_SWATCHES], DIFFUSE])
    return element("div", *map(_square, colours), class_="swatches")


def _square(colour: NDArray[np.uint8], **attributes: str) -> Markup:
    red, green, blue = colour.tolist()
    return element("i", **attributes, style=f"background: #{red:02x}{green:02x}{blue:02x}")


def _lights(scene: Scene) -> Markup:
    rows: list[list[Cell]] = [
        [
            scene.objects[light.row].name,
            _triple(light.centre, 3),
            f"{float(np.sqrt(np.sum(np.square(light.centre)))):.3f}",
            _triple(light.radiance_rgb, 1),
            f"{light.area:.5f}",
        ]
        for light in lights(scene)
    ]
    head = ("light", "centre, m", "distance, m", "radiance rgb", "area, m²")
    return table(head, rows, numbers=4)


def _attempts(rejected: Sequence[Failure]) -> list[Markup]:
    if not rejected:
        return []
    rows = [(row.item, row.attempt, row.stage, row.reason, row.message) for row in rejected]
    head = ("item", "attempt", "stage", "reason", "what was found")
    return [element("h2", "Rejected before"), table(head, rows)]


def _provenance(provenance: Mapping[str, object]) -> Markup:
    rows = [
        (name, value if isinstance(value, str) else json.dumps(value, sort_keys=True))
        for name, value in sorted(provenance.items())
    ]
    return table(("field", "value"), rows)


def _triple(values: tuple[float, float, float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
