"""The HTML page of one scene: its pictures and maps, and tables of its contents.

Small pictures of passes (depth, normals, ids and others) are computed from the scene when the page
is written, so that a dataset stores nothing for them. At 96 pixels a side, all views of a scene
cost about half as much as the rest of its page. Their colors are for display, never for
measurement. Black marks pixels that meet no surface; every other gray and every id is brighter.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from pipeline.documents.pages import Figure, png_uri, render_page
from storage.conventions import preview_gain, preview_srgb8, srgb8
from storage.raycast import MISS
from storage.records.material import DIFFUSE
from storage.records.objects import Failure
from storage.records.passes import pass_names, view_passes
from storage.records.sample import PictureErrors, Sample, error_text
from storage.records.scene import Scene
from storage.records.scene_facts import cameras, lights, sky_facts, surfaces
from storage.records.texture import NORMAL, TEXTURED, Environment, MapSource, Texture

PREVIEW_PX = 96

_DARKEST = 40
"""Gray of the farthest point and of roughness 0, distinct from black."""


def depth_grays(depth_m: NDArray) -> NDArray[np.uint8]:
    """Return depths [R, R] in meters as grays: the nearest is white, the farthest dark.

    The grays fall in proportion to the depth. Infinite depths are black.
    """
    near, far = finite_range(depth_m) or (0.0, 0.0)
    span = far - near
    return fraction_grays(
        np.where(np.isfinite(depth_m), (far - depth_m) / span if span else 1, np.nan)
    )


def fraction_grays(share: NDArray) -> NDArray[np.uint8]:
    """Return numbers from 0 to 1 [R, R] as grays from dark to white; NaN is black."""
    is_hit = np.isfinite(share)
    greys = _DARKEST + (255 - _DARKEST) * np.clip(np.where(is_hit, share, 0), 0, 1)
    return np.where(is_hit, np.round(greys), 0).astype(np.uint8)


def normal_colors(normal: NDArray) -> NDArray[np.uint8]:
    """Return unit vectors [R, R, 3] as RGB: -1 to 1 become 0 to 255; NaN is black."""
    return np.round(np.where(np.isnan(normal), 0, (normal + 1) * 127.5)).astype(np.uint8)


def albedo_colors(albedo: NDArray) -> NDArray[np.uint8]:
    """Return linear colors [R, R, 3] from 0 to 1 as sRGB; NaN is black."""
    return srgb8(np.nan_to_num(albedo))


def id_colors(ids: ArrayLike) -> NDArray[np.uint8]:
    """Return the colors of ids [...], as [..., 3] RGB: the palette of PASCAL VOC's label pictures.

    An id has the same color in every scene, and no two ids below 2^24 - 1 share one: from its
    lowest bit on, the bits of id + 1 go to red, green and blue alternately, to the highest bits
    first. -1, no surface, is black.
    """
    code = np.asarray(ids, np.int64) - MISS
    colours = np.zeros((*code.shape, 3), np.uint8)
    for bit in range(24):
        colours[..., bit % 3] |= ((code >> bit & 1) << 7 - bit // 3).astype(np.uint8)
    return colours


def finite_range(values: NDArray) -> tuple[float, float] | None:
    """Return the least and the greatest finite number; None if there is none."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else None


class PassView(NamedTuple):
    """Display of one pass."""

    word: str
    """Name of the pass, as `trilight passes` takes it."""
    title: str
    pixels: Callable[[NDArray], NDArray[np.uint8]]
    """Converts the values of the pass to a picture."""
    caption: Callable[[NDArray], str]
    """Returns the meaning of the picture's colors; called only if a pixel meets a surface."""

    def show(self, values: NDArray) -> tuple[NDArray[np.uint8], str]:
        """Return the picture of the values, and its caption."""
        is_hit = np.any(np.isfinite(values) if values.dtype.kind == "f" else values != MISS)
        return self.pixels(values), self.caption(values) if is_hit else "nothing is met"


def _range_caption(form: str) -> Callable[[NDArray], str]:
    return lambda values: form.format(*finite_range(values) or ())


def _ids_seen(ids: NDArray) -> str:
    seen = len(np.unique(ids[ids != MISS]))
    return f"{seen} seen, in the colors of the table Objects"


_AXES = "x, y, z of the world from -1 to 1 as red, green, blue"
_FRACTION = "{:.2f} to {:.2f} (no unit)"

PASS_VIEWS = (
    PassView("depth", "depth", depth_grays, _range_caption("{:.2f} to {:.2f} m, near is bright")),
    PassView("normal", "shading normal", normal_colors, lambda _: _AXES),
    PassView("object", "object ids", id_colors, _ids_seen),
    PassView("diffuse", "diffuse albedo", albedo_colors, _range_caption(_FRACTION)),
    PassView(
        "roughness", "roughness", fraction_grays, _range_caption(f"{_FRACTION}, rough is bright")
    ),
)


def pass_figures(sample: Sample) -> list[list[Figure]]:
    """Return small pictures of the passes, for each view."""
    names = [pass_names([pass_view.word])[0] for pass_view in PASS_VIEWS]
    rows = []
    for view in range(sample.scene.num_views):
        passes = view_passes(sample.scene, names, view=view, resolution=PREVIEW_PX)
        figures = []
        for pass_view, name in zip(PASS_VIEWS, names, strict=True):
            pixels, means = pass_view.show(passes[name])
            title = f"view {view}, {pass_view.title}"
            figures.append(Figure(png_uri(pixels), title, f"{title}: {means}"))
        rows.append(figures)
    return rows


_PICTURE_PX = 384
_MOST_SWATCHES = 128
_MAP_PX = 112
_MOST_MAPS = 48
"""Most textures shown as pictures; the table has all."""


def encode_scene_page(
    sample: Sample, split: str, rejected: Sequence[Failure], links: Mapping[str, str | None]
) -> bytes:
    """Return the page of one scene, with the rejected attempts at it and its views.

    Args:
        links: links to the `report` with all scenes, and to the scenes `before` and `after` if
            there are any.
    """
    scene = sample.scene
    reflecting = surfaces(scene)
    shading = {surface.row: "smooth" if surface.smooth else "flat" for surface in reflecting}
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    return render_page(
        "scene.html",
        f"Scene {sample.key}",
        scene=scene,
        split=split,
        rejected=rejected,
        links=links,
        pictures=list(_pictures(sample)),
        views=list(zip(cameras(scene), sample.views, strict=True)),
        parts=list(_parts(sample)),
        pass_px=PREVIEW_PX,
        passes=pass_figures(sample),
        key=sample.key,
        pass_words=",".join(pass_view.word for pass_view in PASS_VIEWS),
        objects=[
            (entry, id_colors(row), shading.get(row, ""), counts[row])
            for row, entry in enumerate(scene.objects)
        ],
        materials=[
            (scene.objects[surface.row].name, _colors(scene, surface.row), surface)
            for surface in reflecting
        ],
        maps=shown_maps(scene),
        lights=lights(scene),
        provenance=[
            (name, value if isinstance(value, str) else json.dumps(value, sort_keys=True))
            for name, value in sorted(scene.provenance.items())
        ],
    )


def preview(radiance_rgb: NDArray[np.float32], width: int) -> NDArray[np.uint8]:
    """Return a picture tone-mapped for display, reduced to at most `width` pixels [W, W, 3]."""
    pixels = preview_srgb8(radiance_rgb)
    if pixels.shape[1] <= width:
        return pixels
    height = max(1, round(pixels.shape[0] * width / pixels.shape[1]))
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


def _pictures(sample: Sample) -> Iterator[Figure]:
    gain = preview_gain(sample.radiance_rgb)
    for view, (picture, record) in enumerate(zip(sample.radiance_rgb, sample.views, strict=True)):
        mark = ", at the cap" if record.at_cap else ""
        mark += f", shown {-np.log2(gain):.1f} stops darker" if gain < 1 else ""
        caption = f"view {view}: {error_text(record)}, {record.spp} spp{mark}"
        yield Figure(png_uri(preview(picture * gain, _PICTURE_PX)), f"view {view}", caption)


def _parts(sample: Sample) -> Iterator[tuple[int, str, PictureErrors, Figure]]:
    """Yield view, name, stated errors and picture of each stored light component."""
    if sample.parts_rgb is None:
        return
    gain = preview_gain(sample.radiance_rgb)
    for view, record in enumerate(sample.views):
        for part, floor in (record.parts or {}).items():
            picture = sample.parts_rgb[part][view]
            together = picture.sum(axis=0) if picture.ndim == 4 else picture
            name = f"view {view}, {part}"
            source = png_uri(preview(together * gain, _PICTURE_PX))
            yield view, part, floor, Figure(source, name, name)


def _colors(scene: Scene, row: int) -> NDArray[np.uint8]:
    """Return the first diffuse colors of an object, as [N, 3] sRGB."""
    used = np.unique(scene.material_index[scene.object_index == row])
    return srgb8(scene.materials[used[:_MOST_SWATCHES], DIFFUSE])


def shown_maps(scene: Scene) -> list[tuple[MapSource, str, str, Figure]]:
    """Return the textures and the sky of a scene, if there are any.

    Returns:
        The source of each; the columns of the material that it gives, or whether cameras see the
        sky; its width and height in texels; and its picture, whose address is empty beyond the most
        that are shown.
    """
    maps = []
    for row, texture in enumerate(scene.textures):
        assert scene.material_textures is not None
        used = (scene.material_textures == row).any(axis=0).tolist()
        used.append(scene.normal_textures is not None and row in scene.normal_textures)
        role = " and ".join(compress((*TEXTURED, NORMAL), used))
        name = texture.source.name
        caption = name if name.endswith(role) else f"{name} ({role})"
        picture = png_uri(_texture_pixels(texture)) if row < _MOST_MAPS else ""
        figure = Figure(picture, caption, caption)
        maps.append((texture.source, f"texture: {role}", _size(texture.texels), figure))
    if (sky := scene.environment) is not None:
        seen = "environment, seen" if sky.is_seen else "environment, hidden from cameras"
        facts = sky_facts(sky)
        caption = (
            f"{sky.source.name} ({seen}): mean radiance {facts.mean_radiance:.3g}, brightest texel "
            f"{facts.peak:.3g} times that, half of the light from {facts.half_light_deg:.1f} "
            "degrees"
        )
        figure = Figure(png_uri(_sky_pixels(sky, facts.mean_radiance)), caption, caption)
        maps.append((sky.source, seen, _size(sky.radiance_rgb), figure))
    return maps


def _size(values: NDArray) -> str:
    return f"{values.shape[1]} x {values.shape[0]}"


def _texture_pixels(texture: Texture) -> NDArray[np.uint8]:
    """Return the pixels of a texture, top row first; linear values are converted to sRGB."""
    height, width = texture.texels.shape[:2]
    step = max(1, height // _MAP_PX, width // (4 * _MAP_PX))
    linear = texture.linear(texture.texels[::-1][::step, ::step])
    return srgb8(linear if texture.channels == 3 else linear[..., 0])


def _sky_pixels(sky: Environment, mean_radiance: float) -> NDArray[np.uint8]:
    """Return the pixels of a sky, exposed by its mean: a sun is white, the rest visible."""
    scale = 0.5 / mean_radiance if mean_radiance else 1.0
    pixels = preview_srgb8((sky.radiance_rgb * np.float32(scale)).astype(np.float32))
    size = (2 * _MAP_PX, _MAP_PX)
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))
