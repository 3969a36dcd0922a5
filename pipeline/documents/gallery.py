"""The gallery of a report: thumbnails that link to a page of each scene, with filters and orders.

The script of pages obeys the filters; without it a page shows all thumbnails and no button.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.documents.pages import png_uri
from pipeline.documents.scene_choice import choose_scenes, read_chosen
from pipeline.documents.scene_page import Neighbours, encode_scene_page, preview
from storage.atomic import write_atomically
from storage.conventions import preview_gain
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError
from storage.records.lights import num_lights
from storage.records.objects import Failure
from storage.records.sample import Sample

MOST_SCENES = 1000
"""Pages that one folder may hold."""

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
_ORDERS = (
    "least stated error",
    "fewest triangles",
    "most triangles",
    "most lights",
    "least coverage",
)


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


def write_gallery(
    dataset: Dataset, failures: Sequence[Failure], out: DatasetFolder, max_scenes: int
) -> list[Card]:
    """Write the pages of up to `max_scenes` scenes and return the thumbnails that link to them.

    Pages of scenes that are no longer shown are deleted.

    Raises:
        TrilightError: `max_scenes` is too large, a sample is unreadable, or the folder cannot be
            written.
    """
    if not 0 <= max_scenes <= MOST_SCENES:
        raise TrilightError(
            f"gallery: {max_scenes} scenes; expected 0 to {MOST_SCENES}, one page each."
        )
    chosen = choose_scenes(dataset, max_scenes)
    rejected: dict[str, list[Failure]] = {entry.key: [] for entry in chosen}
    for failure in failures:
        key = str(failure.item).partition(".")[0]
        if failure.stage in ("scenes", "renders") and key in rejected:
            rejected[key].append(failure)
    names = [f"{entry.key}.html" for entry in chosen]
    cards = []
    for row, (entry, sample) in enumerate(read_chosen(dataset, chosen)):
        links = Neighbours(
            report=f"../{out.report.name}#gallery",
            before=names[row - 1] if row else None,
            after=names[row + 1] if row + 1 < len(names) else None,
        )
        page = encode_scene_page(sample, entry.split, rejected[entry.key], links)
        write_atomically(out.report_pages / names[row], page)
        cards.append(make_card(sample, entry.split, f"{out.report_pages.name}/{names[row]}"))
    for old in sorted(out.report_pages.glob("[0-9]" * 9 + ".html")):
        if old.name not in names:
            old.unlink(missing_ok=True)
    return cards


def make_card(sample: Sample, split: str, link: str) -> Card:
    """Return the thumbnail of a scene."""
    scene = sample.scene
    exposed = sample.radiance_rgb[0] * preview_gain(sample.radiance_rgb)
    floor_db = min(float(record.noise_floor_db) for record in sample.views)
    return Card(
        key=sample.key,
        link=link,
        picture=png_uri(preview(exposed, _CARD_PX)),
        num_objects=sum(entry.kind == "object" for entry in scene.objects),
        split=split,
        layout=str(scene.provenance.get("template", "")),
        views=_AT_CAP if any(record.at_cap for record in sample.views) else _WITHIN,
        orders=(
            min(floor_db, _MOST_DB),
            scene.num_triangles,
            -scene.num_triangles,
            -num_lights(scene),
            min(float(record.coverage) for record in sample.views),
        ),
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
