"""Converts the scenes of a file to another format, in a child process with limits.

A USD file holds many scenes. In formats that hold one, each scene becomes `NAME.KEY.SUFFIX`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.formats import (
    FORMATS,
    LoadedScene,
    Pictures,
    SceneFormat,
    SceneSource,
    drop_uncarried_maps,
    list_lost_members,
    writable_suffixes,
)
from pipeline.exchange.open_scene import load_source
from pipeline.exchange.reader import SceneReader
from pipeline.exchange.scene_budget import within_budget
from storage.atomic import write_error
from storage.errors import TrilightError
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True)
class ConvertResult:
    """Result of a conversion."""

    files: tuple[Path, ...]  # written files, without the meshes of a scene JSON
    triangles: int  # sum over all scenes
    notes: tuple[str, ...]  # sentences about what was lost


def convert_scene(
    source: SceneSource, target: Path, *, budget: int | None, done: Callable[[int, int], None]
) -> ConvertResult:
    """Read a source of one or many scenes and write it in the format of the target's suffix.

    Scenes get at most `budget` triangles; None is all of them. `done` is called with (finished,
    all) files.

    Raises:
        TrilightError: the source is unusable, the target's format cannot hold it, or it cannot be
            written.
    """
    form = _form_of(target)
    with SceneReader(writes=[_make_folder(target)]) as reader:
        sources = reader.scenes_of(source)
        outputs = [(target, sources)]
        if len(sources) > 1 and not form.write_many:
            outputs = [(target.with_suffix(f".{one.key}{target.suffix}"), [one]) for one in sources]
        results = []
        for out, group in outputs:
            arguments = (convert_sources, group, out, budget)
            results.append(reader.call(*arguments, name=source.name, done="converted"))
            done(len(results), len(outputs))
    return ConvertResult(
        files=tuple(path for each in results for path in each.files),
        triangles=sum(each.triangles for each in results),
        notes=tuple(dict.fromkeys(note for each in results for note in each.notes)),
    )


def write_scene(
    target: Path, scene: Scene, radiance_rgb: NDArray[np.float32] | None = None
) -> tuple[str, ...]:
    """Write a scene in the format of the target's suffix; return what that cannot hold.

    HDF5 alone holds the pictures [V, R, R, 3] of its views.

    Raises:
        TrilightError: the format cannot hold it, or it cannot be written.
    """
    form = _form_of(target)
    assert form.write is not None
    carried = drop_uncarried_maps(scene, form.carried)
    return (*list_lost_members(scene, form.carried), *form.write(target, carried, radiance_rgb))


def _make_folder(target: Path) -> Path:
    """Make the folder of a file; the child may write there and nowhere else."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(target, error) from error
    return target.parent


def _form_of(target: Path) -> SceneFormat:
    form = FORMATS.get(target.suffix.lower())
    if form is None or form.write is None or target.is_dir():
        raise TrilightError(
            f"{target}: cannot be written as a scene; expected the name of a file: "
            f"{' '.join(writable_suffixes())}."
        )
    return form


def convert_sources(
    sources: Sequence[SceneSource], target: Path, budget: int | None
) -> ConvertResult:
    """Write sources into one file; only child processes call this. Raises TrilightError."""
    form = _form_of(target)
    triangles = 0
    notes = list[str]()

    def carried_scenes() -> Iterator[tuple[str, Scene, Pictures]]:
        nonlocal triangles
        for source in sources:
            loaded = _load_within_budget(source, budget, pictures=form.holds_pictures)
            triangles += loaded.scene.num_triangles
            notes.extend(loaded.notes)
            note_losses(list_lost_members(loaded.scene, form.carried))
            carried = drop_uncarried_maps(loaded.scene, form.carried)
            yield str(source.key), carried, loaded.radiance_rgb

    def note_losses(lost: Iterable[str]) -> None:
        notes.extend(f"{target.name}: cannot hold {text}" for text in lost)

    if form.write_many and len(sources) > 1:
        form.write_many(target, ((key, scene) for key, scene, _ in carried_scenes()))
    elif form.write:
        for _, scene, radiance_rgb in carried_scenes():
            note_losses(form.write(target, scene, radiance_rgb))
    files = (target, *(form.named_files(target) if form.named_files else ()))
    return ConvertResult(files=files, triangles=triangles, notes=tuple(notes))


def _load_within_budget(source: SceneSource, budget: int | None, *, pictures: bool) -> LoadedScene:
    loaded = load_source(source, pictures=pictures)
    if budget is None or loaded.scene.num_triangles <= budget:
        return loaded
    scene, notes = within_budget(loaded.scene, budget)
    if loaded.radiance_rgb is not None:
        notes = (*notes, "pictures left out: they show the scene before that")
    return LoadedScene(scene=scene, notes=(*loaded.notes, *notes))
