"""The contact sheet: one picture that shows a person what is in a dataset."""

import io
from dataclasses import dataclass
from itertools import chain

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from storage.atomic import write_atomically
from storage.conventions import SPLITS, preview_srgb8
from storage.dataset import Dataset
from storage.sample import Sample
from storage.statistics import Statistics

_TILE_PX = 192
_MARGIN_PX = 8
_CAPTION_PX = 34
_TITLE_PX = 64
_SCENES_PER_ROW = 2
_BACKGROUND, _INK, _FAINT = (24, 24, 26), (235, 235, 235), (160, 160, 165)


@dataclass(frozen=True, kw_only=True)
class _Cell:
    """One scene on the sheet."""

    sample: Sample
    split: str


def write_contact_sheet(dataset: Dataset, statistics: Statistics, *, max_scenes: int = 16) -> None:
    """Write `contact_sheet.png`: every view of up to `max_scenes` scenes, tone-mapped.

    The scenes are spread evenly over the shards, in order of splits. The tone map is
    storage.conventions.preview_srgb8.

    Raises:
        TrilightError: a shard is not what the manifest says.
    """
    cells = _choose(dataset, max_scenes)
    if not cells:
        return
    views = dataset.manifest.num_views
    row_width = _SCENES_PER_ROW * (views * _TILE_PX + 2 * _MARGIN_PX)
    rows = -(-len(cells) // _SCENES_PER_ROW)
    row_height = _TILE_PX + _CAPTION_PX + _MARGIN_PX
    sheet = Image.new("RGB", (row_width, _TITLE_PX + rows * row_height), _BACKGROUND)
    _draw_title(sheet, dataset, statistics)
    for number, cell in enumerate(cells):
        row, column = divmod(number, _SCENES_PER_ROW)
        left = column * (row_width // _SCENES_PER_ROW) + _MARGIN_PX
        _draw_cell(sheet, cell, left, _TITLE_PX + row * row_height)
    stream = io.BytesIO()
    sheet.save(stream, "PNG")
    write_atomically(dataset.folder.contact_sheet, stream.getvalue())


def _choose(dataset: Dataset, max_scenes: int) -> list[_Cell]:
    """Take scenes evenly: first how many of each shard, then the first ones of it."""
    shards = list(chain.from_iterable(dataset.shards_of(split) for split in SPLITS))
    total = sum(shard.num_samples for shard in shards)
    if not total:
        return []
    wanted = np.linspace(0, total - 1, min(max_scenes, total)).round().astype(int)
    cells, first = [], 0
    for shard in shards:
        chosen = set(wanted[(wanted >= first) & (wanted < first + shard.num_samples)] - first)
        if chosen:
            samples = enumerate(dataset.read_shard(shard))
            cells += [_Cell(sample=s, split=shard.split) for at, s in samples if at in chosen]
        first += shard.num_samples
    return cells


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


def _draw_cell(sheet: Image.Image, cell: _Cell, left: int, top: int) -> None:
    draw, sample = ImageDraw.Draw(sheet), cell.sample
    template = sample.scene.provenance["template"]
    draw.text(
        (left, top),
        f"{sample.key}  {cell.split}  {template}  {sample.scene.num_triangles} triangles",
        fill=_INK,
        font=ImageFont.load_default(13),
    )
    for view, (picture, record) in enumerate(zip(sample.radiance_rgb, sample.views, strict=True)):
        tile = Image.fromarray(preview_srgb8(picture)).resize((_TILE_PX, _TILE_PX))
        x = left + view * _TILE_PX
        sheet.paste(tile, (x, top + _CAPTION_PX))
        mark = " (cap)" if record.at_cap else ""
        draw.text(
            (x, top + 17),
            f"{record.noise_floor_db:.1f} dB, {record.spp} spp{mark}",
            fill=_FAINT,
            font=ImageFont.load_default(11),
        )
