"""Small pictures of passes (depth, normals, ids and others) for the page of a scene.

They are computed from the scene when the page is written, so that a dataset stores nothing for
them. At 96 pixels a side, all views of a scene cost about half as much as the rest of its page.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.html import Markup, element, enlargeable, png_uri
from pipeline.documents.pass_colors import (
    albedo_colors,
    depth_grays,
    finite_range,
    fraction_grays,
    id_colors,
    normal_colors,
)
from storage.records.passes.declared import pass_names
from storage.records.passes.pictures import view_passes
from storage.records.sample import Sample
from storage.records.surfaces import MISS

PASSES_STYLE = """
.passes { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, 192px);
  margin-bottom: 1.2rem } .passes img { width: 100%; image-rendering: pixelated }
@media (max-width: 32rem) { .passes { grid-template-columns: 1fr 1fr } }
section code { display: block; overflow-x: auto; white-space: nowrap; margin-bottom: 1rem }
"""
"""Style sheet of `passes_section`."""

_PREVIEW_PX = 96


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


def passes_section(sample: Sample) -> Markup:
    """Return small pictures of the passes of each view, and the command that writes the numbers."""
    words = [pass_view.word for pass_view in PASS_VIEWS]
    intro = element(
        "p",
        f"What each view sees through the centres of {_PREVIEW_PX} x {_PREVIEW_PX} pixels, "
        "computed from the scene for this page. Lights are hidden from cameras; where no surface "
        "is met, the pictures are black. In the dataset's folder, this command writes the numbers:",
    )
    command = element("code", passes_command(words, scene=sample.key))
    views = [_view(sample, view, words) for view in range(sample.scene.num_views)]
    return element("section", element("h2", "Passes"), intro, command, *views)


def passes_command(words: Sequence[str] = (), *, scene: str | None = None) -> str:
    """Return the command that writes passes beside a dataset; it is run in the dataset's folder.

    Args:
        words: passes, as `trilight passes` takes them; empty for its default.
        scene: key of the only scene; None for all.
    """
    one = "" if scene is None else f" --scene {scene}"
    chosen = f" --passes {','.join(words)}" if words else ""
    return f"trilight passes .{one}{chosen} --out ../passes"


def _view(sample: Sample, view: int, words: Sequence[str]) -> Markup:
    names = [pass_names([word])[0] for word in words]
    passes = view_passes(sample.scene, names, view=view, resolution=_PREVIEW_PX)
    figures = []
    for pass_view, name in zip(PASS_VIEWS, names, strict=True):
        values = passes[name]
        is_hit = np.any(values != MISS if values.dtype == np.int32 else np.isfinite(values))
        means = pass_view.caption(values) if is_hit else "nothing is met"
        title = f"view {view}, {pass_view.title}"
        picture = enlargeable(png_uri(pass_view.pixels(values)), title)
        figures.append(element("figure", picture, element("figcaption", f"{title}: {means}")))
    return element("div", *figures, class_="passes")
