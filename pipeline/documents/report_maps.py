"""The section of a report on textures and skies; a dataset without any has none."""

import numpy as np

from pipeline.documents.distributions import Distributions
from pipeline.documents.figures import drawing, encoded, histogram, panels, stacked_bars
from pipeline.documents.html import Cell, Markup, element, joined, table
from pipeline.documents.report_sections import section, summaries
from storage.records.quantities import QUANTITIES

_MOST_BARS = 24
"""More families than this stand in the table only."""

_MANY = {"scene": "scenes", "texture": "textures", "sky": "skies"}
_OF_SKIES = ("sky_radiance", "sky_peak", "sky_half_light_deg")


def maps_section(found: Distributions) -> Markup:
    """Return which textures and skies there are, how large, how bright, and how sharp."""
    if not found.maps:
        return Markup()
    with drawing():
        shown = sorted(found.maps.items(), key=lambda entry: (entry[0][0], -entry[1], entry[0]))
        bars = shown[:_MOST_BARS]
        parts = {
            kind: [count if kind == this else 0 for (this, _), count in bars]
            for kind in dict.fromkeys(kind for (kind, _), _ in bars)
        }
        figure, _ = stacked_bars([name for (_, name), _ in bars], parts, xlabel="scenes")
        families = encoded(figure, "scenes by family of texture and of sky")
    rows: list[list[Cell]] = [[kind, name, count] for (kind, name), count in shown]
    numbers = table(("map", "family or name", "scenes"), rows, numbers=1)
    first = section("maps", "Textures and skies", families, _shares(found), numbers)
    return joined([first, _sizes(found)])


def maps_in_words(found: Distributions) -> dict[str, str]:
    """Return a line on textures and one on skies, for a card; what is not there has none."""
    scenes = sum(found.scenes.values())
    textures, skies = found.all("textures_per_scene"), found.all("skies_per_scene")
    families = {kind: sum(1 for this, _ in found.maps if this == kind) for kind in _KINDS}
    lines = {}
    if (textures > 0).any():
        lines["textures"] = (
            f"{int((textures > 0).sum())} of {scenes} scenes, {int(textures.sum())} maps of "
            f"{families['texture']} families, {_range(found, 'texture_width', 0)} texels wide"
        )
    if (skies > 0).any():
        lines["skies"] = (
            f"{int((skies > 0).sum())} of {scenes} scenes, {families['sky']} families, mean "
            f"radiance {_range(found, 'sky_radiance', 2)}; half of the light of one comes from "
            f"{_range(found, 'sky_half_light_deg', 1)} degrees"
        )
    return lines


_KINDS = ("texture", "sky")


def _shares(found: Distributions) -> Markup:
    rows: list[list[Cell]] = []
    for name, of_scene in (("textured", "textures_per_scene"), ("below a sky", "skies_per_scene")):
        values = found.all(of_scene)
        count = int((values > 0).sum())
        rows.append([f"scenes {name}", count, f"{count / max(len(values), 1):.1%}"])
    for kind, name in (("object", "objects"), ("shell", "floors and walls")):
        count, all_of_kind = (found.surfaces.get((kind, key), 0) for key in ("textured", "all"))
        rows.append([f"{name} textured", count, f"{count / max(all_of_kind, 1):.1%}"])
    return table(("", "count", "share"), rows, numbers=2)


def _sizes(found: Distributions) -> Markup:
    textured, sky_lit = (len(found.all(name)) for name in ("texture_width", "sky_radiance"))
    names = [
        *(("textures_per_scene", "texture_width") if textured else ()),
        *(_OF_SKIES if sky_lit else ()),
    ]
    with drawing():
        figure, axes = panels(len(names))
        for panel, name in zip(axes, names, strict=True):
            values, label = found.all(name), QUANTITIES[name].label
            if name == "sky_peak":
                values, label = np.log10(np.maximum(values, 1e-3)), f"log10 of {label}"
            histogram(panel, values, label, ylabel=_MANY[QUANTITIES[name].per])
        picture = encoded(figure, ", ".join(QUANTITIES[name].label for name in names))
    note = element(
        "p",
        "A sun like ours has half of its light in half a degree, a constant sky in 180.",
        class_="faint",
    )
    left = element("div", picture, class_="figure")
    right = element("div", summaries(found, *names), note if sky_lit else "", class_="numbers")
    return element("div", left, right, class_="pair")


def _range(found: Distributions, name: str, digits: int) -> str:
    values = found.all(name)
    low, high = (f"{value:.{digits}f}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"
