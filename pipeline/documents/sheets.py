"""Sheets: one picture with many pictures of a dataset, tone-mapped by `preview_srgb8`."""

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from pipeline.documents.png import encode_png
from storage.atomic import write_atomically
from storage.conventions import SPLITS, preview_gain, preview_srgb8
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry
from storage.dataset.statistics import Statistics, described_shards
from storage.records.sample import Sample, error_text

_LEAST_SHARE = 8
"""Divisor of the chosen scenes: a split with few scenes gets up to one in this many."""


def choose_scenes(
    dataset: Dataset, max_scenes: int, splits: Sequence[str] = SPLITS
) -> list[tuple[ShardEntry, str]]:
    """Choose up to `max_scenes` scenes, by shard and key; only their shards are opened.

    Every split gets scenes in proportion, at least an eighth if it has so many. Within a split they
    are spread evenly over its shards. The order is that of splits, then shards.

    Raises:
        TrilightError: a shard is missing or damaged.
    """
    shards = [dataset.shards_of(split) for split in splits]
    ends = [np.cumsum([shard.num_samples for shard in each], dtype=int) for each in shards]
    counts = [int(each[-1]) if len(each) else 0 for each in ends]
    keys_of = functools.cache(dataset.keys)
    chosen = []
    for each, end, count, num_chosen in zip(
        shards, ends, counts, _scenes_per_split(counts, max_scenes), strict=True
    ):
        rows = np.linspace(0, count - 1, num_chosen).round().astype(int)
        for row, number in zip(rows, np.searchsorted(end, rows, side="right"), strict=True):
            shard = each[number]
            chosen.append((shard, keys_of(shard)[row - end[number]]))
    return chosen


def read_chosen(
    dataset: Dataset, chosen: Sequence[tuple[ShardEntry, str]]
) -> Iterator[tuple[ShardEntry, Sample]]:
    """Yield the chosen scenes with their shards and pictures, one at a time.

    Raises:
        TrilightError: a shard is missing, or a sample is unreadable or breaks a law.
    """
    for shard, key in chosen:
        for sample in dataset.read_samples(shard, [key]):
            yield shard, sample


def _scenes_per_split(counts: Sequence[int], max_scenes: int) -> list[int]:
    """Return the number of scenes to show of each split, together at most `max_scenes`."""
    total = sum(counts)
    if total <= max_scenes:
        return list(counts)
    one_each = max_scenes >= sum(count > 0 for count in counts)
    minimum = max(max_scenes // _LEAST_SHARE, int(one_each))
    least = [min(count, minimum) for count in counts]
    remaining = max_scenes - sum(least)
    spare = [count - low for count, low in zip(counts, least, strict=True)]
    share = [remaining * entry // sum(spare) for entry in spare]
    while sum(share) < remaining:
        unmet = [entry - granted for entry, granted in zip(spare, share, strict=True)]
        share[int(np.argmax(unmet))] += 1
    return [low + more for low, more in zip(least, share, strict=True)]


_TILE_PX = 192
_MARGIN_PX = 8
_TEMPLATE_MARGIN_PX = 4
_CAPTION_PX = 50
_LABEL_PX = 22
_TITLE_PX = 64
_TILES_PER_ROW = 8
_BACKGROUND = (24, 24, 26)
_INK = (235, 235, 235)
_FAINT = (160, 160, 165)


def write_contact_sheet(
    dataset: Dataset, statistics: Statistics, *, max_scenes: int = 16, out: DatasetFolder
) -> None:
    """Write `contact_sheet.png`: every view of up to `max_scenes` scenes, over splits and shards.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    chosen = choose_scenes(dataset, max_scenes)
    if not chosen:
        return
    values = dict(statistics.lines())
    title = f"{dataset.manifest.build}: scenes {values['scenes']}, views {values['views']}"
    floors = f"stated error {values['stated error']}; at the cap {values['views at the cap']}; "
    floors += "bright scenes are shown darker"
    cells = ((sample, shard.split) for shard, sample in read_chosen(dataset, chosen))
    sheet = _draw_sheet(title, floors, cells, len(chosen), dataset.manifest.num_views)
    write_atomically(out.contact_sheet, sheet)


def write_first_pictures(folder: DatasetFolder, sample: Sample, *, build: str, split: str) -> None:
    """Write `contact_sheet.png` of one scene, as a preview before the dataset is finished.

    Raises TrilightError where the folder cannot be written.
    """
    title = f"{build}: the first scene"
    state = "the dataset is still being made"
    sheet = _draw_sheet(title, state, [(sample, split)], 1, len(sample.views))
    write_atomically(folder.contact_sheet, sheet)


def write_template_sheet(dataset: Dataset, *, per_template: int, out: DatasetFolder) -> None:
    """Write `templates.png`: the first view of the first `per_template` scenes of every layout.

    Each layout has a row, so that presets can be compared. Arguments and errors are those of
    `write_contact_sheet`.
    """
    rows = _first_scenes(dataset, per_template)
    row_height = _TILE_PX + _LABEL_PX + _TEMPLATE_MARGIN_PX
    width = per_template * (_TILE_PX + _TEMPLATE_MARGIN_PX) + _TEMPLATE_MARGIN_PX
    sheet = Image.new("RGB", (width, row_height * len(rows)), _BACKGROUND)
    for row, (template, scenes) in enumerate(sorted(rows.items())):
        top = row * row_height
        _write(sheet, _TEMPLATE_MARGIN_PX, top + 3, f"{dataset.manifest.build}: {template}", 14)
        for column, (key, shard) in enumerate(scenes.items()):
            left_px = _TEMPLATE_MARGIN_PX + column * (_TILE_PX + _TEMPLATE_MARGIN_PX)
            for sample in dataset.read_samples(shard, [key]):
                picture = sample.radiance_rgb[0] * preview_gain(sample.radiance_rgb)
                sheet.paste(_tile(picture), (left_px, top + _LABEL_PX))
    write_atomically(out.template_sheet, encode_png(np.asarray(sheet)))


def _draw_sheet(
    title: str, line: str, cells: Iterable[tuple[Sample, str]], count: int, num_views: int
) -> bytes:
    """Return the PNG file of `count` scenes with their splits, below a title and a line."""
    per_row = min(max(1, _TILES_PER_ROW // num_views), count)
    cell_width = num_views * _TILE_PX + 2 * _MARGIN_PX
    row_height = _TILE_PX + _CAPTION_PX + _MARGIN_PX
    size = (per_row * cell_width, _TITLE_PX - (-count // per_row) * row_height)
    sheet = Image.new("RGB", size, _BACKGROUND)
    _write(sheet, _MARGIN_PX, 8, title, 20)
    _write(sheet, _MARGIN_PX, 36, line, 14, _FAINT)
    for number, (sample, split) in enumerate(cells):
        row, column = divmod(number, per_row)
        left_px = column * cell_width + _MARGIN_PX
        _draw_cell(sheet, sample, split, left_px, _TITLE_PX + row * row_height)
    return encode_png(np.asarray(sheet))


def _draw_cell(sheet: Image.Image, sample: Sample, split: str, left_px: int, top: int) -> None:
    origin = sample.scene.provenance
    excursion = origin.get("excursion")
    beyond = f"  {excursion['axis']} {excursion['value']:g}" if excursion else ""
    _write(sheet, left_px, top, f"{sample.key}  {split}{beyond}", 13)
    triangles = f"{origin.get('template', 'unknown')}  {sample.scene.num_triangles} triangles"
    _write(sheet, left_px, top + 16, triangles, 13)
    exposed = sample.radiance_rgb * preview_gain(sample.radiance_rgb)
    for view, (picture, record) in enumerate(zip(exposed, sample.views, strict=True)):
        x = left_px + view * _TILE_PX
        sheet.paste(_tile(picture), (x, top + _CAPTION_PX))
        mark = " (cap)" if record.at_cap else ""
        floor = f"{error_text(record)}, {record.spp} spp{mark}"
        _write(sheet, x, top + 33, floor, 11, _FAINT)


def _write(
    sheet: Image.Image, x: int, y: int, line: str, size: int, ink: tuple[int, int, int] = _INK
) -> None:
    ImageDraw.Draw(sheet).text((x, y), line, fill=ink, font=ImageFont.load_default(size))


def _tile(radiance_rgb: NDArray[np.float32]) -> Image.Image:
    return Image.fromarray(preview_srgb8(radiance_rgb)).resize((_TILE_PX, _TILE_PX))


def _first_scenes(dataset: Dataset, per_template: int) -> Mapping[str, dict[str, ShardEntry]]:
    """Return the scenes to show by template: their shards by key."""
    rows: dict[str, dict[str, ShardEntry]] = {}
    for shard in described_shards(dataset):
        for record in dataset.read_scenes(shard):
            scenes = rows.setdefault(record.scene.provenance.get("template", "unknown"), {})
            if len(scenes) < per_template:
                scenes[record.key] = shard
    return rows
