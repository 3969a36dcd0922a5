"""Small pictures of passes (depth, normals, ids and others) for the page of a scene.

They are computed from the scene when the page is written, so that a dataset stores nothing for
them. At 96 pixels a side, all views of a scene cost about half as much as the rest of its page.

Their colors are for display, never for measurement. Black marks pixels that meet no surface; every
other gray and every id is brighter.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.documents.pages import Figure, png_uri
from storage.conventions import srgb8
from storage.raycast.caster import MISS
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.sample import Sample

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


def passes_command(*, scene: str | None = None, for_page: bool = False) -> str:
    """Return the command that writes passes beside a dataset; it is run in the dataset's folder.

    Args:
        scene: key of the only scene; None for all.
        for_page: True for the passes of a scene's page; False for those that the command chooses.
    """
    one = "" if scene is None else f" --scene {scene}"
    words = ",".join(pass_view.word for pass_view in PASS_VIEWS)
    return f"trilight passes .{one}{f' --passes {words}' if for_page else ''} --out ../passes"


def pass_figures(sample: Sample) -> list[list[Figure]]:
    """Return small pictures of the passes, for each view."""
    names = [pass_names([pass_view.word])[0] for pass_view in PASS_VIEWS]
    rows = []
    for view in range(sample.scene.num_views):
        passes = view_passes(sample.scene, names, view=view, resolution=PREVIEW_PX)
        figures = []
        for pass_view, name in zip(PASS_VIEWS, names, strict=True):
            values = passes[name]
            is_hit = np.any(values != MISS if values.dtype == np.int32 else np.isfinite(values))
            means = pass_view.caption(values) if is_hit else "nothing is met"
            title = f"view {view}, {pass_view.title}"
            figures.append(Figure(png_uri(pass_view.pixels(values)), title, f"{title}: {means}"))
        rows.append(figures)
    return rows
