"""Converts the scenes of a file to another format, in a child process with limits.

A USD file holds many scenes. In formats that hold one, each scene becomes `NAME.KEY.SUFFIX`.

A budget reduces the triangles of a scene, by the same fraction in each object. Emitters stay
unchanged. The mesh stage's decimation reduces an object; each new triangle takes the material of
the nearest old one, and smooth normals are computed again.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.formats import (
    FORMATS,
    LoadedScene,
    SceneFormat,
    SceneSource,
    drop_uncarried_maps,
    list_lost_members,
)
from pipeline.exchange.from_description import shade
from pipeline.exchange.reader import SceneReader, load_source
from pipeline.exchange.textured_triangles import is_smooth, mesh_of_triangles
from pipeline.foreign.mesh import TriangleMesh
from pipeline.scenes.pieces import ScenePiece, concatenate_pieces
from pipeline.scenes.shading_normals import has_area
from storage.atomic import write_error
from storage.errors import Rejected, TrilightError
from storage.records.retextured import without_maps
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
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(target, error) from error
    with SceneReader(writes=[target.parent]) as reader:
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
    lost = list[str]()
    carried = _carry(scene, form, lost)
    return (*lost, *form.write(target, carried, radiance_rgb))


def _carry(scene: Scene, form: SceneFormat, lost: list[str]) -> Scene:
    """Return what a format holds of a scene; `lost` receives a text about the rest."""
    lost += list_lost_members(scene, form.carried)
    return drop_uncarried_maps(scene, form.carried)


def _form_of(target: Path) -> SceneFormat:
    form = FORMATS.get(target.suffix.lower())
    if form is None or form.write is None or target.is_dir():
        suffixes = " ".join(suffix for suffix, each in FORMATS.items() if each.write)
        raise TrilightError(
            f"{target}: cannot be written as a scene; expected the name of a file: {suffixes}."
        )
    return form


def convert_sources(
    sources: Sequence[SceneSource], target: Path, budget: int | None
) -> ConvertResult:
    """Write sources into one file; only child processes call this. Raises TrilightError."""
    form = _form_of(target)
    triangles = 0
    notes = list[str]()
    lost = list[str]()

    def load(source: SceneSource) -> LoadedScene:
        nonlocal triangles
        loaded = load_source(source, pictures=form.holds_pictures)
        notes.extend(loaded.notes)
        if budget is not None and loaded.scene.num_triangles > budget:
            has_pictures = loaded.radiance_rgb is not None
            loaded = within_budget(loaded.scene, budget)
            notes.extend(loaded.notes)
            notes.extend(["pictures left out: they show the scene before that"] * has_pictures)
        triangles += loaded.scene.num_triangles
        return loaded

    if form.write_many and len(sources) > 1:
        scenes = ((str(each.key), _carry(load(each).scene, form, lost)) for each in sources)
        form.write_many(target, scenes)
    else:
        (source,) = sources
        loaded = load(source)
        lost += write_scene(target, loaded.scene, loaded.radiance_rgb)
    files = (target, *(form.named_files(target) if form.named_files else ()))
    notes += (f"{target.name}: cannot hold {text}" for text in lost)
    return ConvertResult(files=files, triangles=triangles, notes=tuple(notes))


LEAST = 4
"""Minimum number of triangles of a reduced object."""

_LOST = "textures became their means: reduced triangles have no texture coordinates"
_FLAT = 1e-3


def within_budget(scene: Scene, budget: int) -> LoadedScene:
    """Return a scene with at most `budget` triangles, and notes on what that cost.

    Raises:
        TrilightError: emitters alone exceed the budget, or an object cannot be reduced that far.
    """
    lost = [_LOST] if scene.textures else []
    scene = without_maps(scene, environment=False)
    counts = np.bincount(scene.object_index, minlength=len(scene.objects))
    emits = np.array([entry.kind == "emitter" for entry in scene.objects])
    room = budget - int(counts[emits].sum())
    least = np.where(emits, 0, np.minimum(counts, LEAST))
    more = np.where(emits, 0, counts) - least
    fraction = max(room - int(least.sum()), 0) / max(int(more.sum()), 1)
    pieces = []
    for row in np.flatnonzero(counts):
        piece = _build_piece(scene, int(row))
        if not emits[row]:
            piece = _reduce_piece(piece, int(least[row] + more[row] * fraction))
        pieces.append(piece)
    total = sum(len(piece.mesh.faces) for piece in pieces)
    if total > budget:
        raise TrilightError(
            f"--budget is {budget}; expected at least {total}, the fewest triangles of this scene "
            f"(emitters take {counts[emits].sum()} of them)."
        )
    reduced = dataclasses.replace(
        scene,
        **concatenate_pieces(pieces),
        objects=tuple(piece.entry for piece in pieces),
        provenance={**scene.provenance, "budget": budget},
    )
    reduced.check()
    note = f"{scene.num_triangles} triangles reduced to {total}"
    return LoadedScene(scene=reduced, notes=(note, *lost))


def _build_piece(scene: Scene, row: int) -> ScenePiece:
    in_object = scene.object_index == row
    palette, index = np.unique(scene.material_index[in_object], return_inverse=True)
    return ScenePiece(
        entry=scene.objects[row],
        mesh=mesh_of_triangles(scene, in_object),
        materials=scene.materials[palette],
        material_index=index.astype(np.int64),
    )


def _reduce_piece(piece: ScenePiece, count: int) -> ScenePiece:
    old = piece.mesh
    if len(old.faces) <= count:
        return piece
    from scipy.spatial import cKDTree

    from pipeline.assets.decimation.decimate import remesh  # loads mesh libraries

    raw = TriangleMesh(positions=old.positions.astype(np.float64), faces=old.faces.astype(np.int64))
    try:
        reduced = remesh(raw, count, "faithful")
    except Rejected as rejection:
        raise TrilightError(
            f"{piece.entry.name}: no method gives at most {count} of its {len(old.faces)} "
            "triangles; choose a larger --budget."
        ) from rejection
    positions = reduced.positions.astype(np.float32)
    faces = reduced.faces.astype(np.uint32)
    faces = faces[has_area(positions, faces)]
    mesh = shade(positions, faces, is_smooth=is_smooth(old, _FLAT))
    centers = old.positions[old.faces].mean(axis=1)
    _, nearest = cKDTree(centers).query(mesh.positions[mesh.faces].mean(axis=1))
    return dataclasses.replace(piece, mesh=mesh, material_index=piece.material_index[nearest])
