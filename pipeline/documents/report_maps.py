"""The section of a report on textures and skies; empty for a dataset without any."""

import numpy as np

from pipeline.documents.distributions import Distributions
from pipeline.documents.figures import drawing, encode_figure, histogram, panels, stacked_bars
from pipeline.documents.html import Cell, Markup, element, join_markup, table
from pipeline.documents.report_sections import section, summaries
from storage.records.quantities import QUANTITIES

_MOST_BARS = 24
"""Most families in the figure; the table has all."""

_MANY = {"scene": "scenes", "texture": "textures", "sky": "skies"}
_OF_SKIES = ("sky_radiance", "sky_peak", "sky_half_light_deg")


def maps_section(distributions: Distributions) -> Markup:
    """Return the section on families of textures and skies, their sizes and brightness."""
    if not distributions.maps:
        return Markup()
    with drawing():
        ordered = sorted(
            distributions.maps.items(), key=lambda entry: (entry[0][0], -entry[1], entry[0])
        )
        bars = ordered[:_MOST_BARS]
        parts = {
            kind: [count if kind == this else 0 for (this, _), count in bars]
            for kind in dict.fromkeys(kind for (kind, _), _ in bars)
        }
        figure, _ = stacked_bars([name for (_, name), _ in bars], parts, xlabel="scenes")
        families = encode_figure(figure, "scenes by family of texture and of sky")
    rows: list[list[Cell]] = [[kind, name, count] for (kind, name), count in ordered]
    numbers = table(("map", "family or name", "scenes"), rows, numbers=1)
    first = section("maps", "Textures and skies", families, _shares(distributions), numbers)
    return join_markup([first, _sizes(distributions)])


def maps_in_words(distributions: Distributions) -> dict[str, str]:
    """Return a line on textures and one on skies for the card, if there are any."""
    scenes = sum(distributions.scenes.values())
    textures = distributions.all("textures_per_scene")
    skies = distributions.all("skies_per_scene")
    families = {kind: sum(1 for this, _ in distributions.maps if this == kind) for kind in _KINDS}
    lines = {}
    if (textures > 0).any():
        lines["textures"] = (
            f"{int((textures > 0).sum())} of {scenes} scenes, {int(textures.sum())} maps of "
            f"{families['texture']} families, {_range(distributions, 'texture_width', 0)} texels "
            "wide"
        )
    if (skies > 0).any():
        lines["skies"] = (
            f"{int((skies > 0).sum())} of {scenes} scenes, {families['sky']} families, mean "
            f"radiance {_range(distributions, 'sky_radiance', 2)}; half of the light of one comes "
            f"from {_range(distributions, 'sky_half_light_deg', 1)} degrees"
        )
    return lines


_KINDS = ("texture", "sky")


def _shares(distributions: Distributions) -> Markup:
    rows: list[list[Cell]] = []
    for name, of_scene in (("textured", "textures_per_scene"), ("below a sky", "skies_per_scene")):
        values = distributions.all(of_scene)
        count = int((values > 0).sum())
        rows.append([f"scenes {name}", count, f"{count / max(len(values), 1):.1%}"])
    for kind, name in (("object", "objects"), ("shell", "floors and walls")):
        count, all_of_kind = (
            distributions.surfaces.get((kind, key), 0) for key in ("textured", "all")
        )
        rows.append([f"{name} textured", count, f"{count / max(all_of_kind, 1):.1%}"])
    return table(("", "count", "share"), rows, numbers=2)


def _sizes(distributions: Distributions) -> Markup:
    textured, sky_lit = (len(distributions.all(name)) for name in ("texture_width", "sky_radiance"))
    names = [
        *(("textures_per_scene", "texture_width") if textured else ()),
        *(_OF_SKIES if sky_lit else ()),
    ]
    with drawing():
        figure, axes = panels(len(names))
        for panel, name in zip(axes, names, strict=True):
            values = distributions.all(name)
            label = QUANTITIES[name].label
            if name == "sky_peak":
                values = np.log10(np.maximum(values, 1e-3))
                label = f"log10 of {label}"
            histogram(panel, values, label, ylabel=_MANY[QUANTITIES[name].per])
        picture = encode_figure(figure, ", ".join(QUANTITIES[name].label for name in names))
    note = element(
        "p",
        "A sun like ours has half of its light in half a degree, a constant sky in 180.",
        class_="faint",
    )
    figure_box = element("div", picture, class_="figure")
    numbers_box = element(
        "div", summaries(distributions, *names), note if sky_lit else "", class_="numbers"
    )
    return element("div", figure_box, numbers_box, class_="pair")


def _range(distributions: Distributions, name: str, digits: int) -> str:
    values = distributions.all(name)
    low, high = (f"{value:.{digits}f}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"
