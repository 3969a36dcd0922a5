"""Scenes of the experiments on pictures: fixed sampled ones, and those of the user."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from infra.render.held_out_scenes import first_composed
from pipeline.assets.settings import AssetSettings
from pipeline.builds.training import smoke
from pipeline.exchange.gltf.read import SUFFIXES as GLTF_SUFFIXES
from pipeline.exchange.gltf.read import read_gltf
from pipeline.exchange.scene_files import build_scene
from pipeline.generation.scene_worker import MAX_ATTEMPTS, SceneWorker
from pipeline.isolation import IsolatedChild
from pipeline.objects.licences import USER_PROVIDED
from storage.errors import TrilightError
from storage.records.sample import Sample
from storage.records.scene import Scene

MakeScene = Callable[[IsolatedChild], Scene]
"""Function that makes a scene in a render child."""


def sampled_trials(count: int) -> list[str]:
    """Return the names of the first sampled scenes."""
    return [f"sampled {index}" for index in range(count)]


def given_scenes(folder: Path | None) -> Mapping[str, MakeScene]:
    """Return the scenes of a folder of RenderFormer and glTF files by name; empty for no folder.

    Raises:
        TrilightError: the folder holds neither a glTF file nor a JSON file of a scene.
    """
    if folder is None:
        return {}
    root = folder.resolve()
    names = [path.name for path in sorted(root.glob("*.json")) if _holds_a_scene(path)]
    trees = [path for suffix in GLTF_SUFFIXES for path in sorted(root.glob(f"*{suffix}"))]
    if not names and not trees:
        raise TrilightError(
            f"--scenes {folder}: it holds no scene; expected RenderFormer scenes (*.json) or glTF."
        )
    scenes: dict[str, MakeScene] = {path.name: partial(_call, _gltf_scene, path) for path in trees}
    return scenes | {
        Path(name).stem: partial(_call, _described_scene, root, name) for name in names
    }


def sampled_scene(child: IsolatedChild, scene_index: int) -> Scene:
    """Return a scene of the preset `smoke` with one camera, composed in a render child.

    Raises:
        Rejected: every attempt at it was rejected.
    """
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    return first_composed(child, settings, scene_index)


def first_sample(child: IsolatedChild, scene_index: int) -> Sample:
    """Return the sample of a training scene's first accepted attempt, made in a render child.

    Raises:
        TrilightError: every attempt was rejected.
    """
    for attempt in range(MAX_ATTEMPTS):
        made = child.call_method(SceneWorker.attempt, "train", scene_index, attempt)
        if made.sample is not None:
            return made.sample
    raise TrilightError(f"scene {scene_index}: rejected {MAX_ATTEMPTS} times; choose others.")


def _call(function: Callable[..., Scene], *arguments: object) -> Scene:
    """Call a function in the render child, which is the last argument."""
    *known, child = arguments
    assert isinstance(child, IsolatedChild)
    return child.call(function, *known)


def _gltf_scene(path: Path) -> Scene:
    return read_gltf(path, USER_PROVIDED).scene


def _described_scene(root: Path, name: str) -> Scene:
    """Return the scene of a RenderFormer file with its first camera."""
    scene, _ = build_scene(
        root, name, AssetSettings(), licence=USER_PROVIDED, num_views=1, scene_index=0, seed=0
    )
    return scene


def _holds_a_scene(path: Path) -> bool:
    """Return whether a file has objects and a camera, which templates lack."""
    try:
        record = json.loads(path.read_bytes())
    except ValueError:
        return False
    return isinstance(record, dict) and bool(record.get("objects")) and bool(record.get("cameras"))
