"""The gallery of a report: thumbnails that link to a page of each scene."""

from collections.abc import Mapping, Sequence

from pipeline.documents.gallery_controls import (
    CardFacts,
    card_attributes,
    card_facts,
    gallery_controls,
)
from pipeline.documents.html import Markup, element, image, join_markup, png_uri
from pipeline.documents.scene_choice import ChosenScene, choose_scenes, read_chosen
from pipeline.documents.scene_page import Neighbours, encode_scene_page, preview
from storage.atomic import write_atomically
from storage.conventions import preview_gain
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError
from storage.records.objects import Failure
from storage.records.sample import Sample

MOST_SCENES = 1000
"""Pages that one folder may hold."""

_CARD_PX = 176


def write_gallery(
    dataset: Dataset, failures: Sequence[Failure], out: DatasetFolder, max_scenes: int
) -> Markup:
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
    rejected = _by_scene(failures, chosen)
    names = [f"{entry.key}.html" for entry in chosen]
    cards: list[tuple[Markup, str]] = []
    facts: list[CardFacts] = []
    for row, (entry, sample) in enumerate(read_chosen(dataset, chosen)):
        links = Neighbours(
            report=f"../{out.report.name}#gallery",
            before=names[row - 1] if row else None,
            after=names[row + 1] if row + 1 < len(names) else None,
        )
        page = encode_scene_page(sample, entry.split, rejected[entry.key], links)
        write_atomically(out.report_pages / names[row], page)
        cards.append((_card(sample, entry.split), f"{out.report_pages.name}/{names[row]}"))
        facts.append(card_facts(sample, entry.split))
    _remove_others(out, names)
    caption = f"{len(chosen)} of {dataset.manifest.num_samples} scenes, by their first view."
    linked = [
        element("a", card, href=link, class_="card", **attributes)
        for (card, link), attributes in zip(cards, card_attributes(facts), strict=True)
    ]
    gallery = element("div", *linked, class_="cards")
    return join_markup([element("p", caption), gallery_controls(facts), gallery])


def _card(sample: Sample, split: str) -> Markup:
    exposed = sample.radiance_rgb[0] * preview_gain(sample.radiance_rgb)
    picture = image(png_uri(preview(exposed, _CARD_PX)), f"scene {sample.key}")
    template = sample.scene.provenance.get("template", "")
    num_objects = sum(entry.kind == "object" for entry in sample.scene.objects)
    caption = f"{template}, {num_objects} {'object' if num_objects == 1 else 'objects'}"
    name = f"{sample.key} {split}"
    text = element("span", name, Markup("<br>"), element("span", caption, class_="faint"))
    return join_markup([picture, text], "")


def _by_scene(
    failures: Sequence[Failure], chosen: Sequence[ChosenScene]
) -> Mapping[str, list[Failure]]:
    """Return the rejections of each chosen scene and its views."""
    rejected: dict[str, list[Failure]] = {entry.key: [] for entry in chosen}
    for failure in failures:
        key = str(failure.item).partition(".")[0]
        if failure.stage in ("scenes", "renders") and key in rejected:
            rejected[key].append(failure)
    return rejected


def _remove_others(out: DatasetFolder, names: Sequence[str]) -> None:
    """Delete pages of an earlier report; other files of the folder stay."""
    for old in sorted(out.report_pages.glob("[0-9]" * 9 + ".html")):
        if old.name not in names:
            old.unlink(missing_ok=True)
