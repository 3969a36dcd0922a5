"""The contact sheet: one picture that shows a person what is in a dataset."""

import io

from PIL import Image, ImageDraw, ImageFont

from pipeline.documents.chosen import choose_scenes, read_chosen
from storage.atomic import write_atomically
from storage.conventions import preview_srgb8
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import Statistics
from storage.records.sample import Sample

_TILE_PX = 192
_MARGIN_PX = 8
_CAPTION_PX = 50
_TITLE_PX = 64
_TILES_PER_ROW = 8
_BACKGROUND, _INK, _FAINT = (24, 24, 26), (235, 235, 235), (160, 160, 165)


def write_contact_sheet(
    dataset: Dataset,
    statistics: Statistics,
    *,
    max_scenes: int = 16,
    out: DatasetFolder | None = None,
) -> None:
    """Write `contact_sheet.png`: every view of up to `max_scenes` scenes, tone-mapped.

    The scenes are spread evenly over splits and shards. The tone map is
    storage.conventions.preview_srgb8.

    Args:
        dataset: the dataset.
        statistics: its statistics.
        max_scenes: most scenes that are shown.
        out: the folder to write into; that of the dataset where None.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    chosen = choose_scenes(dataset.manifest, max_scenes)
    if not chosen:
        return
    views = dataset.manifest.num_views
    per_row = min(max(1, _TILES_PER_ROW // views), len(chosen))
    row_width = per_row * (views * _TILE_PX + 2 * _MARGIN_PX)
    rows = -(-len(chosen) // per_row)
    row_height = _TILE_PX + _CAPTION_PX + _MARGIN_PX
    sheet = Image.new("RGB", (row_width, _TITLE_PX + rows * row_height), _BACKGROUND)
    _draw_title(sheet, dataset, statistics)
    for number, (entry, sample) in enumerate(read_chosen(dataset, chosen)):
        row, column = divmod(number, per_row)
        left = column * (row_width // per_row) + _MARGIN_PX
        _draw_cell(sheet, sample, entry.split, left, _TITLE_PX + row * row_height)
    stream = io.BytesIO()
    sheet.save(stream, "PNG")
    write_atomically((out or dataset.folder).contact_sheet, stream.getvalue())


def _draw_title(sheet: Image.Image, dataset: Dataset, statistics: Statistics) -> None:
    draw = ImageDraw.Draw(sheet)
    values = dict(statistics.lines())
    draw.text(
        (_MARGIN_PX, 8),
        f"{dataset.manifest.build}: {values['scenes']}, {values['views']} views",
        fill=_INK,
        font=ImageFont.load_default(20),
    )
    draw.text(
        (_MARGIN_PX, 36),
        f"noise floor {values['noise floor']}; at the cap {values['views at the cap']}",
        fill=_FAINT,
        font=ImageFont.load_default(14),
    )


def _draw_cell(sheet: Image.Image, sample: Sample, split: str, left: int, top: int) -> None:
    draw = ImageDraw.Draw(sheet)
    origin = sample.scene.provenance
    excursion = origin.get("excursion")
    beyond = f"  {excursion['axis']} {excursion['value']:g}" if excursion else ""
    lines = (
        f"{sample.key}  {split}{beyond}",
        f"{origin['template']}  {sample.scene.num_triangles} triangles",
    )
    for number, line in enumerate(lines):
        at = (left, top + 16 * number)
        draw.text(at, line, fill=_INK, font=ImageFont.load_default(13))
    for view, (picture, record) in enumerate(zip(sample.radiance_rgb, sample.views, strict=True)):
        tile = Image.fromarray(preview_srgb8(picture)).resize((_TILE_PX, _TILE_PX))
        x = left + view * _TILE_PX
        sheet.paste(tile, (x, top + _CAPTION_PX))
        mark = " (cap)" if record.at_cap else ""
        draw.text(
            (x, top + 33),
            f"{record.noise_floor_db:.1f} dB, {record.spp} spp{mark}",
            fill=_FAINT,
            font=ImageFont.load_default(11),
        )
