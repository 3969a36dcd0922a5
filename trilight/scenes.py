"""Scenes of files: read, written, and brought to the size that a network knows."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.rendering.sources import scene_sources
from pipeline.exchange.convert import write_scene as write_in_form
from pipeline.exchange.open_scene import LoadedScene, scene_source
from pipeline.exchange.reader import SceneReader
from storage.records.scene import Scene, SceneObject

__all__ = ["Scene", "SceneObject", "read_scene", "read_scenes", "within_budget", "write_scene"]


def read_scene(source: str | os.PathLike[str]) -> Scene:
    """Return one scene with all of its cameras; it passes `Scene.check`.

    Warns of unknown parts of the file, and of what could not be carried over. A child process with
    limits reads it, so that no file can crash or fill this one.

    Args:
        source: `.usda .usdc .usdz .usd`, RenderFormer's `.json` or `.h5`, `.safetensors`, or
            `SHARD.tar::KEY`.

    Raises:
        TrilightError: anything in the file is unusable, or breaks a law of scenes.
    """
    with SceneReader() as reader:
        return _warn_notes(reader.load(scene_source(os.fspath(source))))


def read_scenes(source: str | os.PathLike[str]) -> Iterator[Scene]:
    """Yield every scene of a shard, a moving USD stage, a folder of scene files, or numbered files.

    Warns and raises as `read_scene`, which says what a scene file may be.

    Args:
        source: such as `train-000000.tar`, `stage.usdc`, `scenes/` or `scenes/{000..119}.json`.
    """
    with SceneReader() as reader:
        for entry in scene_sources(os.fspath(source), reader):
            yield _warn_notes(reader.load(entry))


def write_scene(
    scene: Scene,
    path: str | os.PathLike[str],
    *,
    radiance_rgb: NDArray[np.float32] | None = None,
) -> tuple[str, ...]:
    """Write a scene in the form that the path's suffix says; return what that form cannot hold.

    Args:
        scene: passes `Scene.check`.
        path: ends in `.usda .usdc .usdz .glb .json .h5` or `.safetensors`. Meshes of a `.json` are
            written beside it.
        radiance_rgb: [V, R, R, 3] linear radiance of its views, which `.h5` alone holds.

    Raises:
        TrilightError: the scene breaks a law, there is no such form, or it cannot be written.
    """
    scene.check()
    return write_in_form(Path(path), scene, radiance_rgb)


def within_budget(scene: Scene, max_triangles: int) -> Scene:
    """Return the scene with fewer triangles; emitters stay whole. Warns of what it cost.

    Args:
        scene: passes `Scene.check`.
        max_triangles: the limit, such as the 768 of the network that comes with Trilight.

    Raises:
        TrilightError: emitters alone are more, or an object cannot be reduced that far.
    """
    with SceneReader() as reader:
        return _warn_notes(reader.within_budget(scene, max_triangles))


def _warn_notes(loaded: LoadedScene) -> Scene:
    for note in loaded.notes:
        warnings.warn(note, stacklevel=3)
    return loaded.scene
