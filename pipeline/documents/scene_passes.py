"""Small pictures of passes (depth, normals, ids and others) for the page of a scene.

They are computed from the scene when the page is written, so that a dataset stores nothing for
them. At 96 pixels a side, all views of a scene cost about half as much as the rest of its page.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.pages import Figure, png_uri
from pipeline.documents.pass_colors import (
    albedo_colors,
    depth_grays,
    finite_range,
    fraction_grays,
    id_colors,
    normal_colors,
)
from storage.raycast.caster import MISS
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.sample import Sample

PREVIEW_PX = 96


@dataclass(frozen=True, kw_only=True)
class PassView:
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
    return f"{seen} seen, in the colours of the table Objects"


PASS_VIEWS = (
    PassView(
        word="depth",
        title="depth",
        pixels=depth_grays,
        caption=_range_caption("{:.2f} to {:.2f} m, near is bright"),
    ),
    PassView(
        word="normal",
        title="shading normal",
        pixels=normal_colors,
        caption=lambda _: "x, y, z of the world from -1 to 1 as red, green, blue",
    ),
    PassView(word="object", title="object ids", pixels=id_colors, caption=_ids_seen),
    PassView(
        word="diffuse",
        title="diffuse albedo",
        pixels=albedo_colors,
        caption=_range_caption("{:.2f} to {:.2f} (no unit)"),
    ),
    PassView(
        word="roughness",
        title="roughness",
        pixels=fraction_grays,
        caption=_range_caption("{:.2f} to {:.2f} (no unit), rough is bright"),
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
    return [_figures_of_view(sample, view) for view in range(sample.scene.num_views)]


def _figures_of_view(sample: Sample, view: int) -> list[Figure]:
    names = [pass_names([pass_view.word])[0] for pass_view in PASS_VIEWS]
    passes = view_passes(sample.scene, names, view=view, resolution=PREVIEW_PX)
    figures = []
    for pass_view, name in zip(PASS_VIEWS, names, strict=True):
        values = passes[name]
        is_hit = np.any(values != MISS if values.dtype == np.int32 else np.isfinite(values))
        means = pass_view.caption(values) if is_hit else "nothing is met"
        title = f"view {view}, {pass_view.title}"
        figures.append(Figure(png_uri(pass_view.pixels(values)), title, f"{title}: {means}"))
    return figures
