"""`report.html`: a gallery of a dataset and its distributions.

The report is one file, whose only script filters its gallery; the pages of the gallery are in
`report/`. It holds no time and no machine: equal datasets give equal reports.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.documents import report_sections
from pipeline.documents.distributions import MEASURED, Distributions
from pipeline.documents.gallery import write_gallery
from pipeline.documents.gallery_controls import CONTROLS_SCRIPT, CONTROLS_STYLE
from pipeline.documents.html import Markup, element, join_markup, page, table
from pipeline.documents.report_maps import maps_section
from pipeline.documents.scene_passes import passes_command
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.records.quantities import QUANTITIES, summary

_STYLE = """
.pair { display: flex; gap: 2rem; align-items: flex-start }
.figure { flex: 0 0 590px; width: 590px } .numbers { flex: 1 1 0; min-width: 0; font-size: .87rem }
.numbers table { margin-bottom: 1rem }
@media (max-width: 78rem) { .pair { display: block } .figure { width: auto } }
.toc { display: flex; flex-wrap: wrap; gap: 0 1rem }
.bar { display: inline-block; height: .7em; background: #3b6ea5 }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: 1rem }
.card { overflow-wrap: anywhere; font-size: .85rem; line-height: 1.35 }
.card img { display: block; width: 100%; background: #111; margin-bottom: .25rem }
pre { columns: 22rem; font-size: .8rem; line-height: 1.45; padding: .7rem;
  white-space: pre-wrap; overflow-wrap: anywhere }
"""

_VIEWED = " in the dataset's folder opens all scenes in 3D, beside their pictures by every engine."

_SECTIONS = {
    "scenes": report_sections.scenes_section,
    "objects": report_sections.objects_section,
    "triangles": report_sections.triangles_section,
    "materials": report_sections.materials_section,
    "maps": maps_section,
    "lights": report_sections.lights_section,
    "cameras": report_sections.cameras_section,
    "pictures": report_sections.pictures_section,
    "rejections": report_sections.rejections_section,
    "licences": report_sections.licences_section,
}
"""Functions that make the sections, by the name that links to them; a section may be empty."""


def write_report(
    dataset: Dataset,
    distributions: Distributions,
    *,
    max_scenes: int = 48,
    out: DatasetFolder | None = None,
) -> Path:
    """Write `report.html` and the pages of its gallery, and return the path of the former.

    Args:
        dataset: the dataset.
        distributions: distributions of the dataset.
        max_scenes: most scenes in the gallery, up to 1000; they are spread over splits and shards.
        out: folder to write into; None for the dataset's folder.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    folder = out or dataset.folder
    gallery = write_gallery(dataset, distributions.failures, folder, max_scenes)
    sections = _SECTIONS if distributions.scenes else {}
    made = {name: make(distributions) for name, make in sections.items()}
    anchors = ["gallery", *(name for name, section in made.items() if section), "settings"]
    body = [
        element("h1", f"Dataset {dataset.manifest.build}"),
        element("p", _in_one_line(dataset, distributions), class_="faint"),
        element("p", *(element("a", name, href=f"#{name}") for name in anchors), class_="toc"),
        element("p", element("code", "trilight view .", class_="command"), _VIEWED),
        element("h2", "Gallery", id="gallery"),
        gallery,
        element("h2", "In numbers"),
        _overview(dataset, distributions),
        *made.values(),
        _settings(dataset),
    ]
    title = f"Dataset {dataset.manifest.build}"
    data = page(title, join_markup(body), style=_STYLE + CONTROLS_STYLE, script=CONTROLS_SCRIPT)
    write_atomically(folder.report, data)
    return folder.report


def _in_one_line(dataset: Dataset, distributions: Distributions) -> str:
    """Return the summary line of the dataset, shown above its pictures."""
    manifest = dataset.manifest
    floors = summary(distributions.all("noise_floor_db"))
    median = f", median noise floor {floors['median']:.1f} dB" if floors["count"] else ""
    views = len(distributions.all("noise_floor_db"))
    return (
        f"{manifest.num_samples} scenes, {views} views{median}, {manifest.num_bytes / 1e6:.1f} MB"
    )


def _overview(dataset: Dataset, distributions: Distributions) -> Markup:
    manifest = dataset.manifest
    per_split = {split: 0 for split in distributions.splits}
    for (_, split), count in distributions.scenes.items():
        per_split[split] += count
    scenes = ", ".join(f"{count} {split}" for split, count in per_split.items())
    rows = [
        *([("what follows is", distributions.sample)] if distributions.sample else []),
        ("scenes", f"{sum(per_split.values())} ({scenes or 'none'})"),
        (
            "views",
            f"{len(distributions.all('noise_floor_db'))}, {manifest.num_views} of each scene",
        ),
    ]
    for name in MEASURED.values():
        floors = summary(distributions.all(name))
        if floors["count"]:
            text = f"median {floors['median']:.1f} dB, 5th percentile {floors['p5']:.1f} dB"
            rows.append((QUANTITIES[name].label.removesuffix(", dB"), text))
    rows += [
        (
            "objects",
            f"{len(distributions.objects)}, {len(distributions.placements)} of them in scenes",
        ),
        ("rejections", f"{len(distributions.failures)}"),
        ("passes", _passes(manifest.passes)),
        ("size", f"{manifest.num_bytes / 1e6:.1f} MB in {len(manifest.shards)} shards"),
        ("dataset digest", manifest.dataset_digest),
    ]
    return table((), rows, class_="narrow")


def _passes(names: Sequence[str]) -> Markup:
    """Return the passes in the shards; if there are none, the command that writes some."""
    if names:
        return join_markup([", ".join(names), "beside each picture"], " ")
    command = element("code", passes_command())
    return join_markup(["none stored;", command, "in the dataset's folder writes them"], " ")


def _settings(dataset: Dataset) -> Markup:
    return join_markup(
        [
            element("h2", "Settings", id="settings"),
            _details("Of the build", _without_sources(dataset.manifest.settings)),
            _details("What the bytes depend on besides", dataset.manifest.environment),
        ]
    )


def _details(title: str, values: Mapping[str, object]) -> Markup:
    return element("details", element("summary", title), element("pre", *_lines(values)))


def _without_sources(settings: Mapping[str, object]) -> Mapping[str, object]:
    """Return settings without those of the sources, which the manifest holds in full."""
    return {name: value for name, value in settings.items() if name != "derived"}


def _lines(values: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """Yield one line for each setting, under its dotted name."""
    for name, value in sorted(values.items()):
        if isinstance(value, Mapping):
            yield from _lines(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {json.dumps(value, sort_keys=True)}\n"
