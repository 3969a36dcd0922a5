"""`report.html`: a gallery of a dataset and its distributions.

The report is one file; the pages of the gallery are in `report/`. It holds no time and no machine:
equal datasets give equal reports.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from pipeline.documents.distributions import MEASURED, Distributions
from pipeline.documents.gallery import gallery_filters, write_gallery
from pipeline.documents.pages import render_page
from pipeline.documents.report_sections import report_sections
from pipeline.documents.scene_passes import passes_command
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.records.quantities import QUANTITIES, summary

_MOST_USED = 20


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
    manifest = dataset.manifest
    cards = write_gallery(dataset, distributions.failures, folder, max_scenes)
    # those of the sources of a derived dataset stand in the manifest
    settings = {name: value for name, value in manifest.settings.items() if name != "derived"}
    page = render_page(
        "report.html",
        f"Dataset {manifest.build}",
        manifest=manifest,
        summary=_in_one_line(dataset, distributions),
        cards=cards,
        filters=gallery_filters(cards),
        overview=list(_overview(dataset, distributions)),
        passes_command=passes_command(),
        sections=report_sections(distributions),
        most_used=_most_used(distributions),
        settings=list(_lines(settings)),
        environment=list(_lines(manifest.environment)),
    )
    write_atomically(folder.report, page)
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


def _overview(dataset: Dataset, distributions: Distributions) -> Iterator[tuple[str, str]]:
    """Yield facts of the dataset, as names and values."""
    if distributions.sample:
        yield "what follows is", distributions.sample
    counts = {split: 0 for split in distributions.splits}
    for (_, split), count in distributions.scenes.items():
        counts[split] += count
    scenes = ", ".join(f"{count} {split}" for split, count in counts.items())
    yield "scenes", f"{sum(counts.values())} ({scenes or 'none'})"
    views = len(distributions.all("noise_floor_db"))
    yield "views", f"{views}, {dataset.manifest.num_views} of each scene"
    for name in MEASURED.values():
        floors = summary(distributions.all(name))
        if floors["count"]:
            text = f"median {floors['median']:.1f} dB, 5th percentile {floors['p5']:.1f} dB"
            yield QUANTITIES[name].label.removesuffix(", dB"), text
    in_scenes = f"{len(distributions.placements)} of them in scenes"
    yield "objects", f"{len(distributions.objects)}, {in_scenes}"
    yield "rejections", str(len(distributions.failures))


def _most_used(distributions: Distributions) -> list[tuple[str, str, str, int]]:
    """Return uid, title, split and placements of the objects that scenes have most often."""
    locked = {entry.uid: (entry.title, entry.split) for entry in distributions.objects}
    ranked = sorted(distributions.placements.items(), key=lambda entry: (-entry[1], entry[0]))
    return [(uid, *locked.get(uid, ("", "")), count) for uid, count in ranked[:_MOST_USED]]


def _lines(values: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """Yield one line for each setting, under its dotted name."""
    for name, value in sorted(values.items()):
        if isinstance(value, Mapping):
            yield from _lines(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {json.dumps(value, sort_keys=True)}"
