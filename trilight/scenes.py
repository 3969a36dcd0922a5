"""Scene files, read, written and reduced to a network's number of triangles; and datasets."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange import convert
from pipeline.exchange.reader import LoadedScene, SceneReader, scene_source
from pipeline.generation.generate_options import GenerateOptions
from storage.records.scene import Scene


def read_scene(source: str | os.PathLike[str]) -> Scene:
    """Read one scene with all of its cameras; it passes `Scene.check`.

    Warns of unknown parts of the file, and of parts that a scene cannot hold. A child process with
    limits reads it, so that no file can crash this process or fill its memory.

    Args:
        source: `.usda .usdc .usdz .usd`, RenderFormer's `.json` or `.h5`, `.safetensors`, or
            `SHARD.tar::KEY`.

    Raises:
        TrilightError: a part of the file is unusable, or breaks a rule of scenes.
    """
    with SceneReader() as reader:
        return _warn_notes(reader.load(scene_source(os.fspath(source))))


def read_scenes(source: str | os.PathLike[str]) -> Iterator[Scene]:
    """Yield every scene of a shard, a moving USD stage, a folder of scene files, or numbered files.

    Warns and raises as `read_scene`, which lists the forms of scene files.

    Args:
        source: such as `train-000000.tar`, `stage.usdc`, `scenes/` or `scenes/{000..119}.json`.
    """
    with SceneReader() as reader:
        for entry in reader.list_scenes(os.fspath(source)):
            yield _warn_notes(reader.load(entry))


def write_scene(
    scene: Scene,
    path: str | os.PathLike[str],
    *,
    radiance_rgb: NDArray[np.float32] | None = None,
) -> tuple[str, ...]:
    """Write a scene in the format of the path's suffix; return notes on lost parts.

    Args:
        scene: a scene that passes `Scene.check`.
        path: file that ends in `.usda .usdc .usdz .glb .json .h5` or `.safetensors`. Meshes of a
            `.json` are written next to it.
        radiance_rgb: [V, R, R, 3] linear radiance of the views, which only `.h5` holds.

    Raises:
        TrilightError: the scene breaks a rule, the suffix is unknown, or writing fails.
    """
    scene.check()
    return convert.write_scene(Path(path), scene, radiance_rgb)


def within_budget(scene: Scene, max_triangles: int) -> Scene:
    """Return the scene with fewer triangles; emitters stay whole. Warns of the loss.

    Args:
        scene: a scene that passes `Scene.check`.
        max_triangles: limit, such as the 768 of the built-in network.

    Raises:
        TrilightError: the emitters alone exceed it, or an object cannot be reduced that far.
    """
    with SceneReader() as reader:
        return _warn_notes(reader.call(convert.within_budget, scene, max_triangles, name="scene"))


def _warn_notes(loaded: LoadedScene) -> Scene:
    for note in loaded.notes:
        warnings.warn(note, stacklevel=3)
    return loaded.scene


if TYPE_CHECKING:
    from pipeline.generation.generation_run import Outcome


def generate(options: GenerateOptions) -> "Outcome":
    """Generate a dataset, or its missing scenes, as `trilight generate` does.

    The call may be stopped at any time; the same options resume and give the same dataset digest.

    Args:
        options: preset, folder, number of scenes: the options of the command line.

    Raises:
        TrilightError: an error that the user can fix; finished scenes are safe.
    """
    from pipeline.executors.threads import ThreadRunner
    from pipeline.generation.pipeline import make_dataset

    return make_dataset(options, ThreadRunner())
