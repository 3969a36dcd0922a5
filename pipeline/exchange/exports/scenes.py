"""Scenes and targets as files that others' renderers and networks read, with names that pair.

    KEY.h5                  RenderFormer's HDF5: what its inference reads, and the pictures
    KEY.json, objects/KEY   RenderFormer's scene with its meshes: what its converter reads
    KEY.usdc                USD
    KEY_view_VIEW.exr       the target of a view: linear radiance, half floats

The form `benchmark` writes all four, each into a folder of its name, and `views.csv`, a row a view.
A target is called as the published inference calls the picture that it makes of `KEY.h5`, so that
what that writes is judged as it is (`trilight leaderboard SET --pictures FOLDER`).
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from pipeline.exchange.convert import write_scene
from storage.atomic import write_atomically
from storage.records.exr import encode_exr
from storage.records.sample import Sample

SCENE_SUFFIXES = {"h5": ".h5", "json": ".json", "usd": ".usdc"}
"""Suffix of a scene's file by the name of its form."""

TARGETS = "exr"
"""Name of the form of targets."""

MOST_NOTES = 6
"""Different losses that are told of each form; others are counted."""

_COLUMNS = ("scene", "view", "split", "h5", "json", "usd", "target", "noise_floor_db")

WriteSample = Callable[[Sample, Path], Sequence[str]]
"""Writes a sample's files into a folder, and returns what they cannot hold."""


def picture_name(key: str, view: int) -> str:
    """Return what the picture of a view is called, made by whomever: `000000003_view_0.exr`."""
    return f"{key}_view_{view}.exr"


def write_targets(sample: Sample, folder: Path) -> Sequence[str]:
    """Write the picture of every view, bit for bit as the dataset has it."""
    for view, radiance_rgb in enumerate(sample.radiance_rgb):
        write_atomically(folder / picture_name(sample.key, view), encode_exr(radiance_rgb))
    return ()


def make_scene_writer(form: str) -> WriteSample:
    """Return what writes a sample's scene in a form of SCENE_SUFFIXES."""

    def write(sample: Sample, folder: Path) -> Sequence[str]:
        target = folder / f"{sample.key}{SCENE_SUFFIXES[form]}"
        folder.mkdir(parents=True, exist_ok=True)
        return write_scene(target, sample.scene, sample.radiance_rgb)

    return write


WRITERS: dict[str, WriteSample] = {
    **{form: make_scene_writer(form) for form in SCENE_SUFFIXES},
    TARGETS: write_targets,
}
"""Writers by form."""


def write_scenes(samples: Iterator[tuple[str, Sample]], out: Path, form: str) -> Sequence[str]:
    """Write one form of every sample into a folder; return what it cannot hold, for people."""
    lost: dict[str, None] = {}
    for _, sample in samples:
        lost |= dict.fromkeys(WRITERS[form](sample, out))
    return _limit_notes(form, list(lost))


def write_benchmark(samples: Iterator[tuple[str, Sample]], out: Path) -> Sequence[str]:
    """Write all forms and the table of views; see the top of this file."""
    lost: dict[str, dict[str, None]] = {form: {} for form in WRITERS}
    stream = io.StringIO(newline="")
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(_COLUMNS)
    for split, sample in samples:
        for form, write in WRITERS.items():
            lost[form] |= dict.fromkeys(write(sample, out / form))
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
