"""The template sheet: some scenes of every layout, a row each, to compare builds with."""

import io
from collections.abc import Mapping

from PIL import Image, ImageDraw, ImageFont

from storage.atomic import write_atomically
from storage.conventions import preview_srgb8
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry

_TILE_PX = 192
_MARGIN_PX = 4
_LABEL_PX = 22
_BACKGROUND, _INK = (24, 24, 26), (235, 235, 235)


def write_template_sheet(
    dataset: Dataset, *, per_template: int, out: DatasetFolder | None = None
) -> None:
    """Write `templates.png`: the first view of the first `per_template` scenes of every layout.

    The tone map is storage.conventions.preview_srgb8.

    Args:
        dataset: the dataset.
        per_template: scenes in a row.
        out: the folder to write into; that of the dataset where None.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    rows = _first_scenes(dataset, per_template)
    row_height = _TILE_PX + _LABEL_PX + _MARGIN_PX
    width = per_template * (_TILE_PX + _MARGIN_PX) + _MARGIN_PX
    sheet = Image.new("RGB", (width, row_height * len(rows)), _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for row, (template, places) in enumerate(sorted(rows.items())):
        top = row * row_height
        label = f"{dataset.manifest.build}: {template}"
        draw.text((_MARGIN_PX, top + 3), label, fill=_INK, font=ImageFont.load_default(14))
        for column, (key, shard) in enumerate(places.items()):
            for sample in dataset.read_samples(shard, [key]):
                tile = Image.fromarray(preview_srgb8(sample.radiance_rgb[0]))
                left = _MARGIN_PX + column * (_TILE_PX + _MARGIN_PX)
                sheet.paste(tile.resize((_TILE_PX, _TILE_PX)), (left, top + _LABEL_PX))
    stream = io.BytesIO()
    sheet.save(stream, "PNG")
    write_atomically((out or dataset.folder).template_sheet, stream.getvalue())


def _first_scenes(dataset: Dataset, per_template: int) -> Mapping[str, dict[str, ShardEntry]]:
    """Return the shard of each scene to show by key, by template."""
    rows: dict[str, dict[str, ShardEntry]] = {}
    for shard in dataset.manifest.shards:
        for record in dataset.read_scenes(shard):
            places = rows.setdefault(str(record.scene.provenance["template"]), {})
            if len(places) < per_template:
                places[record.key] = shard
    return rows
