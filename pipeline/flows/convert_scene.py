"""One scene, or all that a file holds, from one form to another; in a child process with limits.

USD holds many scenes in one file. The other forms hold one: many become `NAME.KEY.SUFFIX`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.flows.file_child import file_child
from pipeline.flows.scene_source import LoadedScene, SceneSource, load_source, source_keys
from pipeline.isolation import ChildFailed, call_with_retries
from pipeline.scenes import renderformer_json_write
from pipeline.scenes.renderformer_json_write import described_files
from storage import renderformer_h5, scene_file
from storage.atomic import write_atomically
from storage.carried import lost_members
from storage.errors import TrilightError
from storage.renderformer_h5 import reflecting_emitters, write_renderformer_h5
from storage.scene import Scene
from storage.scene_file import encode_scene
from storage.usd import export as usd
from storage.usd.export import SUFFIXES, write_usd, write_usd_shard

_CARRIED = {
    **dict.fromkeys(SUFFIXES, usd.CARRIED),
    ".json": renderformer_json_write.CARRIED,
    ".h5": renderformer_h5.CARRIED,
    ".safetensors": scene_file.CARRIED,
}
"""What each form holds of a scene, by the suffix that chooses it."""

_EXPECTED = "expected the name of a file: .usda .usdc .usdz, .json, .h5 or .safetensors"


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What came of a conversion."""

    files: tuple[Path, ...]
    """What was written, without the meshes beside a scene JSON."""
    triangles: int
    """Of all scenes."""
    notes: tuple[str, ...]
    """What could not be carried over, for people."""


def convert_scene(
    source: SceneSource, target: Path, *, budget: int | None, done: Callable[[int, int], None]
) -> Converted:
    """Read a source and write it in the form that the target's name says.

    Args:
        source: one scene, or a file of many.
        target: the file to write.
        budget: most triangles of each scene, or None for all of them.
        done: called with (finished, all) files.

    Raises:
        TrilightError: the source is unusable, the target's form cannot hold it, or it cannot be
            written.
    """
    suffix = _require_form(target)
    child = file_child()
    try:
        keys = call_with_retries(child, source_keys, source)
        if not keys:
            raise TrilightError(f"{source.name}: holds no scene.")
        if suffix in SUFFIXES and len(keys) > 1:
            found = [call_with_retries(child, _many_to_usd, source, keys, target, budget)]
            done(1, 1)
        else:
            found = []
            for key in keys:
                wanted = source if key is None else dataclasses.replace(source, key=key)
                out = target if len(keys) == 1 else target.with_suffix(f".{key}{target.suffix}")
                found.append(call_with_retries(child, _one, wanted, out, budget))
                done(len(found), len(keys))
    except ChildFailed as failure:
        raise TrilightError(f"{source.name}: could not be converted ({failure}).") from failure
    finally:
        child.close()
    return Converted(
        files=tuple(path for each in found for path in each.files),
        triangles=sum(each.triangles for each in found),
        notes=tuple(dict.fromkeys(note for each in found for note in each.notes)),
    )


def write_scene(
    target: Path, scene: Scene, radiance_rgb: NDArray[np.float32] | None = None
) -> tuple[str, ...]:
    """Write a scene in the form that the target's name says; return what that cannot hold.

    Args:
        target: the file to write.
        scene: that passes `Scene.check`.
        radiance_rgb: [V, R, R, 3] pictures of its views, which HDF5 alone holds.

    Raises:
        TrilightError: the form cannot hold it, or it cannot be written.
    """
    suffix = _require_form(target)
    lost = lost_members(scene, _CARRIED[suffix])
    if suffix in SUFFIXES:
        write_usd(target, scene)
    elif suffix == ".json":
        return (*lost, *_write_json(target, scene))
    elif suffix == ".h5":
        write_renderformer_h5(target, scene, radiance_rgb)
        return (*lost, *reflecting_emitters(scene))
    else:
        write_atomically(target, encode_scene(scene))
    return lost


def _require_form(target: Path) -> str:
    """Return the suffix that chooses the form; raises TrilightError where it means none."""
    suffix = target.suffix.lower()
    if suffix not in _CARRIED or target.is_dir():
        raise TrilightError(f"{target}: cannot be written as a scene; {_EXPECTED}.")
    return suffix


def _one(source: SceneSource, target: Path, budget: int | None) -> Converted:
    loaded = _loaded(source, budget, pictures=target.suffix.lower() == ".h5")
    lost = write_scene(target, loaded.scene, loaded.radiance_rgb)
    notes = (*loaded.notes, *_said(target, lost))
    return Converted(files=(target,), triangles=loaded.scene.num_triangles, notes=notes)


def _said(target: Path, lost: Iterable[str]) -> Iterator[str]:
    return (f"{target.name}: cannot hold {text}" for text in lost)


def _many_to_usd(
    source: SceneSource, keys: list[str | None], target: Path, budget: int | None
) -> Converted:
    triangles, notes = 0, list[str]()

    def scenes() -> Iterator[tuple[str, Scene]]:
        nonlocal triangles
        for key in keys:
            loaded = _loaded(dataclasses.replace(source, key=key), budget)
            triangles += loaded.scene.num_triangles
            lost = lost_members(loaded.scene, usd.CARRIED)
            notes.extend((*loaded.notes, *_said(target, lost)))
            yield _variant_name(str(key)), loaded.scene

    write_usd_shard(target, scenes())
    return Converted(files=(target,), triangles=triangles, notes=tuple(notes))


def _variant_name(key: str) -> str:
    """Return a key as a variant of USD may be called: a time code has a point, or a minus."""
    return key.replace(".", "_").replace("-", "m")


def _loaded(source: SceneSource, budget: int | None, *, pictures: bool = False) -> LoadedScene:
    loaded = load_source(source, pictures=pictures)
    if budget is None or loaded.scene.num_triangles <= budget:
        return loaded
    from pipeline.flows.scene_budget import within_budget  # loads mesh libraries

    scene, notes = within_budget(loaded.scene, budget)
    if loaded.radiance_rgb is not None:
        notes = (*notes, "pictures left out: they show the scene before that")
    return LoadedScene(scene=scene, notes=(*loaded.notes, *notes))


def _write_json(target: Path, scene: Scene) -> tuple[str, ...]:
    described = described_files(scene, target.stem)
    for path, data in described.meshes.items():
        write_atomically(target.parent / path, data)
    write_atomically(target, described.json)  # last: what it names is there
    return described.lost
