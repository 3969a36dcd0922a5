"""Scene exports for other renderers and networks, with target pictures of matching names.

    KEY.h5                  RenderFormer's HDF5, for its inference, with the pictures
    KEY.json, objects/KEY   RenderFormer's scene with its meshes, for its converter
    KEY.usdc                USD
    KEY_view_VIEW.exr       the target of a view: linear radiance, half floats

The form `benchmark` writes all four, each into a folder of its name, and `views.csv` with a row for
each view. A target has the name that the published inference gives to its picture of `KEY.h5`, so
that the leaderboard reads those pictures unrenamed (`trilight leaderboard SET --pictures FOLDER`).
"""

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.exchange.convert import write_scene
from storage.atomic import write_atomically
from storage.records.exr import encode_exr
from storage.records.sample import Sample

SCENE_SUFFIXES = {"h5": ".h5", "json": ".json", "usd": ".usdc"}
"""Suffix of the scene file of each format."""

TARGETS = "exr"
"""Format name of the target pictures, which have exactly the dataset's values."""

SCENE_FORMS = (*SCENE_SUFFIXES, TARGETS)

MOST_NOTES = 6
"""Maximum number of losses listed for each format; further ones are counted."""

_COLUMNS = ("scene", "view", "split", "h5", "json", "usd", "target", "noise_floor_db")


def picture_name(key: str, view: int) -> str:
    """Return the file name of a view's picture, such as `000000003_view_0.exr`."""
    return f"{key}_view_{view}.exr"


def _write_sample(form: str, sample: Sample, folder: Path) -> Sequence[str]:
    """Write a sample in a form into a folder; return sentences about losses."""
    if form == TARGETS:
        for view, radiance_rgb in enumerate(sample.radiance_rgb):
            write_atomically(folder / picture_name(sample.key, view), encode_exr(radiance_rgb))
        return ()
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{sample.key}{SCENE_SUFFIXES[form]}"
    return write_scene(target, sample.scene, sample.radiance_rgb)


def write_scenes(samples: Iterator[tuple[str, Sample]], out: Path, form: str) -> Sequence[str]:
    """Write every sample in one format into a folder; return sentences about losses."""
    lost = dict.fromkeys(text for _, each in samples for text in _write_sample(form, each, out))
    return _limit_notes(form, list(lost))


def write_benchmark(samples: Iterator[tuple[str, Sample]], out: Path) -> Sequence[str]:
    """Write all formats and the table of views, in the layout of this module."""
    lost: dict[str, dict[str, None]] = {form: {} for form in SCENE_FORMS}
    stream = io.StringIO(newline="")
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(_COLUMNS)
    for split, sample in samples:
        for form in SCENE_FORMS:
            lost[form] |= dict.fromkeys(_write_sample(form, sample, out / form))
        scenes = [f"{form}/{sample.key}{suffix}" for form, suffix in SCENE_SUFFIXES.items()]
        for view, record in enumerate(sample.views):
            target = f"{TARGETS}/{picture_name(sample.key, view)}"
            floor = f"{record.noise_floor_db:.3f}"
            table.writerow([sample.key, view, split, *scenes, target, floor])
    write_atomically(out / "views.csv", stream.getvalue().encode())
    return [note for form, texts in lost.items() for note in _limit_notes(form, list(texts))]


def _limit_notes(form: str, lost: Sequence[str]) -> list[str]:
    notes = [f"{form} cannot hold {text}" for text in lost[:MOST_NOTES]]
    more = len(lost) - MOST_NOTES
    return [*notes, f"{form} loses {more} more things of this kind"] if more > 0 else notes
