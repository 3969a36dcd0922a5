"""The sections of a report: figures of a dataset's distributions, with tables of numbers."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.documents.distributions import MEASURED, SURFACE_COUNTS, Distributions
from pipeline.documents.figures import drawing, encode_figure, histogram, panels, rose, stacked_bars
from pipeline.documents.html import Cell, Markup, element, join_markup, table
from storage.records.quantities import QUANTITIES, STATISTICS, summary

_MOST_USED = 20
_DEFAULT_STATISTICS = tuple(name for name in STATISTICS if name not in ("p5", "p95"))
_MOST_BARS = 16
"""Most templates or reasons in a figure; the table has all."""
_ATTEMPTS = (
    ("first attempt", 0, 0),
    ("second", 1, 1),
    ("third, fourth", 2, 3),
    ("later", 4, math.inf),
)


def scenes_section(distributions: Distributions) -> Markup:
    """Return the section on the number of scenes by template and split."""
    splits = distributions.splits
    templates = distributions.templates
    counts = {
        split: [distributions.scenes.get((name, split), 0) for name in templates]
        for split in splits
    }
    with drawing():
        lengths = {split: counts[split][:_MOST_BARS] for split in splits}
        figure, _ = stacked_bars(templates[:_MOST_BARS], lengths, xlabel="scenes")
        picture = encode_figure(figure, "scenes by template and split")
    rows: list[list[Cell]] = [
        [name, *(counts[split][row] for split in splits), sum(counts[s][row] for s in splits)]
        for row, name in enumerate(templates)
    ]
    totals = [sum(counts[split]) for split in splits]
    rows.append(["all", *totals, sum(totals)])
    head = ("template", *splits, "all")
    return section("scenes", "Scenes", picture, table(head, rows, numbers=len(splits) + 1))


def objects_section(distributions: Distributions) -> Markup:
    """Return the section on objects per scene, and on how evenly objects are used."""
    uses = np.array(distributions.uses_per_object())
    with drawing():
        figure, axes = panels(2)
        histogram(
            axes[0], distributions.all("objects_per_scene"), "objects in a scene", ylabel="scenes"
        )
        histogram(axes[1], uses, "places of an object in scenes", ylabel="objects")
        picture = encode_figure(figure, "objects of a scene, and places of an object")
    numbers = summaries(
        distributions, "objects_per_scene", extra=[("places of an object", 0, uses)]
    )
    note = element("p", f"{int((uses > 0).sum())} of {len(uses)} objects stand in a scene.")
    return join_markup(
        [section("objects", "Objects", picture, numbers, note), _most_used(distributions)]
    )


def triangles_section(distributions: Distributions) -> Markup:
    """Return the section on triangles of scenes and objects."""
    budget = distributions.targets["max_triangles"]
    with drawing():
        figure, axes = panels(2)
        marks = {f"budget {budget:.0f}": budget} if budget is not None else None
        values = distributions.all("triangles_per_scene")
        histogram(axes[0], values, "triangles of a scene", ylabel="scenes", marks=marks)
        values = distributions.all("triangles_per_object")
        histogram(axes[1], values, "triangles of an object", ylabel="places")
        picture = encode_figure(figure, "triangles of scenes and objects")
    numbers = summaries(distributions, "triangles_per_scene", "triangles_per_object")
    return section("triangles", "Triangles", picture, numbers)


def materials_section(distributions: Distributions) -> Markup:
    """Return the section on albedos, roughness and shading of all surfaces except lights."""
    picture = _histograms(
        distributions,
        ("diffuse", "specular", "albedo_sum", "roughness"),
        ylabel="surfaces",
        bounds=(0, 1),
    )
    numbers = summaries(distributions, "diffuse", "specular", "albedo_sum", "roughness")
    rows: list[list[Cell]] = []
    for kind in ("object", "shell"):
        count, *those = (distributions.surfaces.get((kind, name), 0) for name in SURFACE_COUNTS)
        name = {"object": "objects", "shell": "floors and walls"}[kind]
        rows.append([name, count, *(_share(of_them, count) for of_them in those)])
    head = ("surfaces", "count", "smooth", "many colours", "textured")
    shares = table(head, rows, numbers=4)
    note = element(
        "p",
        "A surface is an object, a floor or a wall in one scene. Of many colours the mean over "
        "triangles counts, of a texture its mean. Albedos are those of the strongest channel. "
        "Smooth surfaces share vertices between triangles; the others are flat.",
        class_="faint",
    )
    return section("materials", "Materials", picture, numbers, shares, note)


def lights_section(distributions: Distributions) -> Markup:
    """Return the section on number, radiance, distance and size of the lights."""
    names = ("lights_per_scene", "total_emission", "light_distance", "light_size")
    picture = _histograms(distributions, names, ylabel=("scenes", "scenes", "lights", "lights"))
    return section("lights", "Lights", picture, summaries(distributions, *names))


def cameras_section(distributions: Distributions) -> Markup:
    """Return the section on positions and fields of view of the cameras."""
    names = ("camera_distance", "elevation_deg", "fov_deg")
    with drawing():
        figure, axes = panels(4, polar=(3,))
        for panel, name in zip(axes, names, strict=False):
            histogram(panel, distributions.all(name), QUANTITIES[name].label, ylabel="views")
        rose(axes[3], distributions.all("azimuth_deg"), "azimuth: area of a petal = views")
        picture = encode_figure(figure, "cameras")
    replaced = int((distributions.all("camera_attempt") > 0).sum())
    note = element("p", f"{replaced} cameras stand in for rejected ones.")
    return section(
        "cameras", "Cameras", picture, summaries(distributions, *names, "azimuth_deg"), note
    )


def pictures_section(distributions: Distributions) -> Markup:
    """Return the section on measured errors and samples of the pictures."""
    marks = {measured: distributions.targets[name] for name, measured in MEASURED.items()}
    marks |= {"spp": distributions.targets["max_spp"], "coverage": None}
    with drawing():
        figure, axes = panels(len(marks))
        for panel, (name, mark) in zip(axes, marks.items(), strict=True):
            label = "" if mark is None else f"{'cap' if name == 'spp' else 'target'} {mark:g}"
            values = distributions.all(name)
            xlabel = QUANTITIES[name].label
            histogram(panel, values, xlabel, ylabel="views", marks={label: mark})
        picture = encode_figure(figure, "noise floors, samples per pixel and coverage")
    numbers = summaries(distributions, *marks, statistics=STATISTICS)
    return section("pictures", "Pictures", picture, numbers, _floors_by_split(distributions))


def rejections_section(distributions: Distributions) -> Markup:
    """Return the section on rejections by stage, reason and attempt."""
    rejections = distributions.rejections
    if not rejections:
        return join_markup(
            [_heading("rejections", "Rejections"), element("p", "Nothing was rejected.")]
        )
    names = [f"{stage}: {reason}" for stage, reason in rejections]
    with drawing():
        parts = {
            label: [_between(counts, low, high) for counts in rejections.values()]
            for label, low, high in _ATTEMPTS
        }
        longest = {label: lengths[:_MOST_BARS] for label, lengths in parts.items() if any(lengths)}
        figure, _ = stacked_bars(names[:_MOST_BARS], longest, xlabel="rejections")
        picture = encode_figure(figure, "rejections by stage and reason")
    rows: list[list[Cell]] = [
        [stage, reason, counts.total(), *(parts[label][row] for label in parts)]
        for row, ((stage, reason), counts) in enumerate(rejections.items())
    ]
    head = ("stage", "reason", "all", *parts)
    numbers = table(head, rows, numbers=len(parts) + 1)
    return section("rejections", "Rejections", picture, numbers)


def licences_section(distributions: Distributions) -> Markup:
    """Return the section on licences of the objects."""
    rows = [(name, *counts) for name, counts in distributions.licences.items()]
    head = ("licence", "objects", "of them in scenes", "places in scenes")
    note = element("p", "attribution.csv names the author of each object.", class_="faint")
    numbers = table(head, rows, numbers=3, class_="narrow")
    return join_markup([_heading("licences", "Licences"), numbers, note])


def _most_used(distributions: Distributions) -> Markup:
    titles = {entry.uid: entry for entry in distributions.objects}
    ranked = sorted(distributions.placements.items(), key=lambda entry: (-entry[1], entry[0]))[
        :_MOST_USED
    ]
    if not ranked:
        return Markup()
    most = ranked[0][1]
    rows: list[list[Cell]] = []
    for uid, count in ranked:
        entry = titles.get(uid)
        bar = element("span", class_="bar", style=f"width: {140 * count / most:.0f}px")
        title, split = (entry.title, entry.split) if entry else ("", "")
        rows.append([uid, title, split, bar, count])
    head = ("object", "title", "split", "", "places")
    heading = element("h3", f"The {len(ranked)} most used objects")
    return join_markup([heading, table(head, rows, numbers=1)])


def _floors_by_split(distributions: Distributions) -> Markup:
    rows: list[list[Cell]] = []
    for split in distributions.splits:
        floors = distributions.values[split]["noise_floor_db"]
        numbers = summary(floors)
        reached = distributions.reaches_targets(split)
        rows.append(
            [
                split,
                len(floors),
                *(f"{numbers[name]:.1f}" if name in numbers else "" for name in ("median", "p5")),
                "" if reached is None else _share(int(reached.sum()), len(floors)),
                _share(distributions.views_at_cap.get(split, 0), len(floors)),
            ]
        )
    head = ("split", "views", "median dB", "p5 dB", "reach the target", "at the cap")
    return table(head, rows, numbers=5)


def _histograms(
    distributions: Distributions,
    names: Sequence[str],
    *,
    ylabel: str | Sequence[str],
    bounds: tuple[float, float] | None = None,
) -> Markup:
    ylabels = [ylabel] * len(names) if isinstance(ylabel, str) else ylabel
    with drawing():
        figure, axes = panels(len(names))
        for panel, name, unit in zip(axes, names, ylabels, strict=True):
            values = distributions.all(name)
            label = QUANTITIES[name].label
            histogram(panel, values, label, ylabel=unit, bounds=bounds)
        return encode_figure(figure, ", ".join(QUANTITIES[name].label for name in names))


def summaries(
    distributions: Distributions,
    *names: str,
    extra: Sequence[tuple[str, int, np.ndarray]] = (),
    statistics: Sequence[str] = _DEFAULT_STATISTICS,
) -> Markup:
    """Return a table of statistics with one row per quantity."""
    named = [
        (QUANTITIES[name].label, QUANTITIES[name].digits, distributions.all(name)) for name in names
    ]
    rows: list[list[Cell]] = []
    for label, digits, values in [*named, *extra]:
        numbers = summary(values)
        rows.append([label, *(_number(numbers, name, digits) for name in statistics)])
    return table(("", *statistics), rows, numbers=len(statistics))


def _number(numbers: dict[str, float], name: str, digits: int) -> str:
    if name not in numbers:
        return ""
    if name == "count":
        return f"{numbers[name]:.0f}"
    return f"{numbers[name]:.{max(digits, 1) if name == 'mean' else digits}f}"


def _share(count: int, total: int) -> str:
    return f"{count / total:.1%}" if total else ""


def _between(counts: Mapping[int, int], low: float, high: float) -> int:
    return sum(number for attempt, number in counts.items() if low <= attempt <= high)


def _heading(anchor: str, title: str) -> Markup:
    return element("h2", title, id=anchor)


def section(anchor: str, title: str, picture: Markup, *details: Markup) -> Markup:
    """Return a section: a heading with an anchor, a figure, and details beside it."""
    figure_box = element("div", picture, class_="figure")
    numbers_box = element("div", *details, class_="numbers")
    return join_markup(
        [_heading(anchor, title), element("div", figure_box, numbers_box, class_="pair")]
    )
