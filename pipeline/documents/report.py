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
        max_scenes: most scenes in the gallery, up to 1000; they are spread over splits and shards.
        out: folder to write into; None for the dataset's folder.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    folder = out or dataset.folder
    manifest = dataset.manifest
    cards = write_gallery(dataset, distributions.failures, folder, max_scenes)
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
        passes_command=passes_command(),
        sections=report_sections(distributions),
        most_used=_most_used(distributions, dataset),
        settings=list(_lines(settings)),
        environment=list(_lines(manifest.environment)),
    )
    write_atomically(folder.report, page)
    return folder.report


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
    settings = dataset.manifest.settings
    if "derived" in settings:  # of several datasets, perhaps
        return {}, ""
    if settings.get("scenes", {}).get("materials", {}).get("source") != "object":
        return {}, "drawn"
    lost = json.loads(dataset.files.read("logs/drawn_materials.json") or "{}")
    return {uid: f"drawn: {', '.join(whys)}" for uid, whys in lost.items()}, "own"


def _lines(values: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """Yield one line for each setting, under its dotted name."""
    for name, value in sorted(values.items()):
        if isinstance(value, Mapping):
            yield from _lines(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}: {json.dumps(value, sort_keys=True)}"
