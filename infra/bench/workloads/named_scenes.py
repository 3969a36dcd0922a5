"""Scenes of the experiments on pictures: fixed ones, plain or mapped, and those of the user."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

from infra.render.held_out_scenes import first_composed
from pipeline.exchange.gltf.read_gltf import SUFFIXES as GLTF_SUFFIXES
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.isolation import IsolatedChild
from pipeline.presets.training import object_views, olat, smoke, textured_256
from scene_templates.settings import SceneSettings
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides

SKIES = ("sun_and_sky", "clouds", "softboxes", "night")
"""Families of skies; the first has a sharp sun."""

_SEEN = ("sun_and_sky", "softboxes")
"""Families of skies that are visible to cameras."""

_MAPPED_SEED = 20_261_125
_SKY_ROWS = 128

_ROUGH = (0.4, 1.0)
_CALM = {
    "num_views": 1,
    "textures.share": 0.8,
    "textures.surfaces.roughness_clip": _ROUGH,
    "materials.roughness_clip": _ROUGH,
}
"""Changes that leave out mirrors, whose caustics would be too noisy for a comparison."""


def given_scenes(folder: Path | None) -> Mapping[str, Path]:
    """Return the RenderFormer and glTF files of a folder by the name of their scene.

    Raises:
        TrilightError: the folder holds neither a glTF file nor a JSON file of a scene.
    """
    if folder is None:
        return {}
    root = folder.resolve()
    trees = [path for suffix in GLTF_SUFFIXES for path in sorted(root.glob(f"*{suffix}"))]
    described = [path for path in sorted(root.glob("*.json")) if _holds_a_scene(path)]
    if not described and not trees:
        raise TrilightError(
            f"--scenes {folder}: it holds no scene; expected RenderFormer scenes (*.json) or glTF."
        )
    return {path.name: path for path in trees} | {path.stem: path for path in described}


def read_given(path: Path) -> Scene:
    """Return the scene of a file, as `trilight render` reads it; runs in a render child."""
    return load_source(scene_source(str(path))).scene


def sampled_scene(child: IsolatedChild, scene_index: int) -> Scene:
    """Return a scene of the preset `smoke` with one camera, composed in a render child.

    Raises:
        Rejected: every attempt at it was rejected.
    """
    settings = dataclasses.replace(smoke().scenes, num_views=1)
    return first_composed(child, settings, scene_index)


def mapped_scene(child: IsolatedChild, name: str) -> Scene:
    """Return the scene of a name, with one camera.

    Args:
        name: `surfaces N`, a scene of `textured-256`, or `sky` and one of SKIES.

    Raises:
        Rejected: none can be composed.
    """
    kind, _, which = name.partition(" ")
    number = int(which) if kind == "surfaces" else 10 + SKIES.index(which)
    settings: SceneSettings = apply_overrides(textured_256().scenes, _CALM)
    if kind == "sky":
        sky = {
            "skies.share": 1.0,
            "skies.over_lamps_log": (2.0, 2.0),
            "skies.seen_share": float(which in _SEEN),
            "skies.maps.families": (which,),
            "skies.maps.height": _SKY_ROWS,
        }
        settings = apply_overrides(settings, sky)
    return first_composed(child, settings, number, seed=_MAPPED_SEED)


def object_alone(child: IsolatedChild, scene_index: int, num_views: int) -> Scene:
    """Return a scene of the preset `object-views`, composed in a render child.

    Raises:
        Rejected: every attempt at it was rejected.
    """
    settings = dataclasses.replace(object_views().scenes, num_views=num_views)
    return first_composed(child, settings, scene_index)


def lights_apart(child: IsolatedChild, scene_index: int) -> Scene:
    """Return a scene of the preset `olat` with one camera; as `object_alone`."""
    return first_composed(child, dataclasses.replace(olat().scenes, num_views=1), scene_index)


def _holds_a_scene(path: Path) -> bool:
    """Return whether a file has objects and a camera, which templates lack."""
    try:
        record = json.loads(path.read_bytes())
    except ValueError:
        return False
    return isinstance(record, dict) and bool(record.get("objects")) and bool(record.get("cameras"))
