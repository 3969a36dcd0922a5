"""`report.html`: a gallery of a dataset, figures of its distributions and tables of numbers.

The report is one file; in `report/` is a page of each scene, to which the thumbnails of the gallery
link. It holds no time and no machine: equal datasets give equal reports. The script of pages obeys
the filters; without it a page shows all thumbnails and no button.
"""

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pipeline.documents.distributions import MEASURED, Distributions
from pipeline.documents.figures import Panel, draw_bars, draw_panels
from pipeline.documents.pages import data_uri, png_uri, render_page
from pipeline.documents.scene_page import encode_scene_page, preview
from pipeline.documents.sheets import choose_scenes, read_chosen
from storage.atomic import write_atomically
from storage.conventions import preview_gain
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.records.lights import num_lights
from storage.records.objects import Failure
from storage.records.quantities import QUANTITIES, STATISTICS, summary
from storage.records.sample import Sample

MOST_SHOWN = 48
"""Most scenes in the gallery; they are spread over splits and shards."""

_CARD_PX = 176
_MOST_CHOICES = 12
"""Most choices of one filter; a dataset with more layouts shows the first ones by name."""
_MOST_DB = 1e9
"""Shown for the stated error of a picture without any error: JSON has no infinity."""

_WITHIN = "within the target"
_AT_CAP = "at the cap"
_WHERE = {_WITHIN: "not any(at_cap)", _AT_CAP: "any(at_cap)"}
_OPTIONS = {"split": "--split", "layout": "--template", "views": "--where"}
"""Option that selects the scenes of a choice, by the name of its filter."""
_ORDERS: Mapping[str, Callable[[Sample], float]] = {
    "least stated error": lambda sample: min(*_of_views(sample, "noise_floor_db"), _MOST_DB),
    "fewest triangles": lambda sample: sample.scene.num_triangles,
    "most triangles": lambda sample: -sample.scene.num_triangles,
    "most lights": lambda sample: -num_lights(sample.scene),
    "least coverage": lambda sample: min(_of_views(sample, "coverage")),
}
"""Value that scenes are sorted by, the least first, by the name of the order."""


def _of_views(sample: Sample, name: str) -> list[float]:
    return [float(getattr(record, name)) for record in sample.views]


@dataclass(frozen=True, kw_only=True)
class Card:
    """Thumbnail of one scene, with the values that it is filtered and sorted by."""

    key: str
    link: str
    picture: str
    num_objects: int
    split: str
    layout: str
    """Template of the scene; empty if unknown."""
    views: str
    """Choice by the sampling of the views: one stopped at the cap, or none."""
    orders: Sequence[float]
    """Values to sort by, one for each order; the least value comes first."""


def write_gallery(dataset: Dataset, failures: Sequence[Failure], out: DatasetFolder) -> list[Card]:
    """Write the pages of up to MOST_SHOWN scenes and return the thumbnails that link to them.

    Pages of scenes that are no longer shown are deleted.

    Raises:
        TrilightError: a sample is unreadable, or the folder cannot be written.
    """
    chosen = choose_scenes(dataset, MOST_SHOWN)
    rejected: dict[str, list[Failure]] = {key: [] for _, key in chosen}
    for failure in failures:
        key = str(failure.item).partition(".")[0]
        if failure.stage in ("scenes", "renders") and key in rejected:
            rejected[key].append(failure)
    names = [f"{key}.html" for _, key in chosen]
    cards = []
    for row, (shard, sample) in enumerate(read_chosen(dataset, chosen)):
        links = {
            "report": f"../{out.report.name}#gallery",
            "before": names[row - 1] if row else None,
            "after": names[row + 1] if row + 1 < len(names) else None,
        }
        page = encode_scene_page(sample, shard.split, rejected[sample.key], links)
        write_atomically(out.report_pages / names[row], page)
        cards.append(make_card(sample, shard.split, f"{out.report_pages.name}/{names[row]}"))
    for old in sorted(out.report_pages.glob("[0-9]" * 9 + ".html")):
        if old.name not in names:
            old.unlink(missing_ok=True)
    return cards


def make_card(sample: Sample, split: str, link: str) -> Card:
    """Return the thumbnail of a scene."""
    scene = sample.scene
    exposed = sample.radiance_rgb[0] * preview_gain(sample.radiance_rgb)
    return Card(
        key=sample.key,
        link=link,
        picture=png_uri(preview(exposed, _CARD_PX)),
        num_objects=sum(entry.kind == "object" for entry in scene.objects),
        split=split,
        layout=str(scene.provenance.get("template", "")),
        views=_AT_CAP if any(record.at_cap for record in sample.views) else _WITHIN,
        orders=[order(sample) for order in _ORDERS.values()],
    )


def gallery_filters(cards: Sequence[Card]) -> Mapping[str, list[tuple[str, str, str]]]:
    """Return the buttons of each filter and of the order: value, label, option that selects it."""
    filters = {}
    for name, option in _OPTIONS.items():
        known = [value for card in cards if (value := getattr(card, name))]
        values = list(dict.fromkeys(sorted(known) if name == "layout" else known))[:_MOST_CHOICES]
        if len(values) > 1:
            words = [shlex.join([option, _WHERE.get(value, value)]) for value in values]
            filters[name] = [("", "all", ""), *zip(values, values, words, strict=True)]
    if len(cards) > 1:
        orders = [(str(row), label, "") for row, label in enumerate(_ORDERS)]
        filters["order"] = [("", "as made", ""), *orders]
    return filters


_MOST_USED = 20


def write_report(dataset: Dataset, distributions: Distributions, *, out: DatasetFolder) -> Path:
    """Write `report.html` and the pages of its gallery, and return the path of the former.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    manifest = dataset.manifest
    cards = write_gallery(dataset, distributions.failures, out)
    floors = {
        QUANTITIES[name].label.removesuffix(", dB"): summary(distributions.all(name))
        for name in MEASURED.values()
    }
    # those of the sources of a derived dataset stand in the manifest
    settings = {name: value for name, value in manifest.settings.items() if name != "derived"}
    page = render_page(
        "report.html",
        f"Dataset {manifest.build}",
        manifest=manifest,
        found=distributions,
        num_views=len(distributions.all("noise_floor_db")),
        floors={label: numbers for label, numbers in floors.items() if numbers["count"]},
        cards=cards,
        filters=gallery_filters(cards),
        parts=report_sections(distributions),
        statistics=STATISTICS,
        attempts=list(_ATTEMPTS),
        most_used=_most_used(distributions, dataset),
        settings=list(_lines(settings)),
        environment=list(_lines(manifest.environment)),
    )
    write_atomically(out.report, page)
    return out.report


def _most_used(
    distributions: Distributions, dataset: Dataset
) -> list[tuple[str, str, str, str, int]]:
    """Return uid, title, split, materials and placements of the objects most often in scenes."""
    locked = {entry.uid: (entry.title, entry.split) for entry in distributions.objects}
    ranked = sorted(distributions.placements.items(), key=lambda entry: (-entry[1], entry[0]))
    reasons, usual = _drawn_materials(dataset)
    return [
        (uid, *locked.get(uid, ("", "")), reasons.get(uid, usual), count)
        for uid, count in ranked[:_MOST_USED]
    ]


def _drawn_materials(dataset: Dataset) -> tuple[dict[str, str], str]:
    """Return why materials of an object are drawn, by uid, and what the others have."""
    if "derived" in dataset.manifest.settings:  # of several datasets, perhaps
        return {}, ""
    if dataset.manifest.setting("scenes.materials.source") != "object":
        return {}, "drawn"
    lost = json.loads(dataset.store.get("logs/drawn_materials.json") or "{}")
    return {uid: f"drawn: {', '.join(whys)}" for uid, whys in lost.items()}, "own"


def _lines(values: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """Yield one line for each setting, under its dotted name."""
    for name, value in sorted(values.items()):
        if isinstance(value, Mapping):
            yield from _lines(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {json.dumps(value, sort_keys=True)}"


_MOST_BARS = 20
"""Most bars of a figure; the table has all."""
_ATTEMPTS = {
    "first attempt": (0, 0),
    "second": (1, 1),
    "third, fourth": (2, 3),
    "later": (4, math.inf),
}
"""First and last attempt by column."""
_LIMITS = {
    "triangles_per_scene": ("budget", "max_triangles"),
    "spp": ("cap", "max_spp"),
    **{measured: ("target", name) for name, measured in MEASURED.items()},
}
"""Word and setting of the line in a histogram, by quantity."""
_HISTOGRAMS = {
    "triangles": ("triangles_per_scene", "triangles_per_object"),
    "materials": ("diffuse", "specular", "albedo_sum", "roughness"),
    "lights": ("lights_per_scene", "total_emission", "light_distance", "light_size"),
    "cameras": ("camera_distance", "elevation_deg", "fov_deg", "azimuth_deg"),
    "pictures": (*MEASURED.values(), "spp", "coverage"),
}
"""Quantities of the histograms of a part."""


class ReportPart(NamedTuple):
    """Figure with the rows of its numbers."""

    figure: str
    """Address that holds the data of the picture itself."""
    alt: str
    rows: Sequence[Sequence[object]]
    """Cells of a table, the last of which are numbers."""


def report_sections(distributions: Distributions) -> dict[str, ReportPart]:
    """Return the figures by the name of their part; none without scenes, and none without data."""
    if not distributions.scenes:
        return {}
    uses = distributions.uses_per_object()
    places = Panel(values=uses, label="places of an object in scenes", unit="objects")
    parts = {name: _histograms(distributions, names) for name, names in _HISTOGRAMS.items()}
    parts["scenes"] = _scenes(distributions)
    parts["objects"] = _histograms(distributions, ["objects_per_scene"], more=[places])
    if distributions.maps:
        sizes = ("textures_per_scene", "texture_width")
        skies = ("sky_radiance", "sky_peak", "sky_half_light_deg")
        names = [
            name for kind in (sizes, skies) if len(distributions.all(kind[-1])) for name in kind
        ]
        parts["maps"] = _maps(distributions)
        parts["map_sizes"] = _histograms(distributions, names)
    if distributions.rejections:
        parts["rejections"] = _rejections(distributions)
    return parts


def _histograms(
    distributions: Distributions, names: Sequence[str], *, more: Sequence[Panel] = ()
) -> ReportPart:
    """Return histograms of quantities, and of whole numbers in `more`, with their statistics."""
    panels = [*(_panel(distributions, name) for name in names), *more]
    digits = [*(QUANTITIES[name].digits for name in names), *(0 for _ in more)]
    rows = [
        [panel.label, *(_statistic(summary(panel.values), name, places) for name in STATISTICS)]
        for panel, places in zip(panels, digits, strict=True)
    ]
    alt = ", ".join(panel.label for panel in panels)
    return ReportPart(data_uri(draw_panels(panels)), alt, rows)


def _panel(distributions: Distributions, name: str) -> Panel:
    quantity = QUANTITIES[name]
    word, setting = _LIMITS.get(name, ("", ""))
    limit = distributions.targets[setting] if setting else None
    return Panel(
        values=distributions.all(name),
        label=quantity.label,
        unit={"sky": "skies"}.get(quantity.per, f"{quantity.per}s"),
        marks={} if limit is None else {f"{word} {limit:g}": limit},
        bounds=(0, 1) if quantity.per == "surface" else None,
        is_log=name == "sky_peak",
        is_rose=name == "azimuth_deg",
    )


def _statistic(numbers: Mapping[str, float], name: str, digits: int) -> str:
    if name not in numbers:
        return ""
    if name == "count":
        return f"{numbers[name]:.0f}"
    return f"{numbers[name]:.{max(digits, 1) if name == 'mean' else digits}f}"


def _bars(names: Sequence[str], parts: Mapping[str, Sequence[int]], label: str) -> str:
    """Return the address of a figure of stacked bars, the first ones of many."""
    first = {name: lengths[:_MOST_BARS] for name, lengths in parts.items() if any(lengths)}
    return data_uri(draw_bars(names[:_MOST_BARS], first, label=label))


def _scenes(distributions: Distributions) -> ReportPart:
    names = sorted({template for template, _ in distributions.scenes})
    counts = {
        split: [distributions.scenes[name, split] for name in names]
        for split in distributions.splits
    }
    columns = [*counts.values(), [sum(row) for row in zip(*counts.values(), strict=True)]]
    rows = [*zip(names, *columns, strict=True), ("all", *map(sum, columns))]
    return ReportPart(_bars(names, counts, "scenes"), "scenes by template and split", rows)


def _maps(distributions: Distributions) -> ReportPart:
    """Return the families of textures and skies."""
    ordered = sorted(
        distributions.maps.items(), key=lambda entry: (entry[0][0], -entry[1], entry[0])
    )
    bars = {
        kind: [count if kind == this else 0 for (this, _), count in ordered]
        for kind in dict.fromkeys(kind for (kind, _), _ in ordered)
    }
    figure = _bars([name for (_, name), _ in ordered], bars, "scenes")
    rows = [(*map_, count) for map_, count in ordered]
    return ReportPart(figure, "scenes by family of texture and of sky", rows)


def _rejections(distributions: Distributions) -> ReportPart:
    rejections = distributions.rejections
    parts = {
        label: [
            sum(number for attempt, number in counts.items() if low <= attempt <= high)
            for counts in rejections.values()
        ]
        for label, (low, high) in _ATTEMPTS.items()
    }
    figure = _bars([f"{stage}: {reason}" for stage, reason in rejections], parts, "rejections")
    totals = [counts.total() for counts in rejections.values()]
    rows = [
        [*where, *numbers]
        for where, *numbers in zip(rejections, totals, *parts.values(), strict=True)
    ]
    return ReportPart(figure, "rejections by stage and reason", rows)
