"""Scenes with textures and skies that are compared with another renderer, always the same ones."""

import dataclasses

import numpy as np

from infra.bench.subjects.named_scenes import first_composed
from pipeline.builds.training import textured_256
from scene_templates.settings import SceneSettings
from scene_templates.skies.draw import SkyMapSettings, draw_sky
from storage.conventions import look_at_c2w
from storage.errors import Rejected
from storage.records.environment import Environment
from storage.records.scene import Scene
from storage.records.texture import MapSource
from storage.seeds import rng_for
from storage.settings.changes import changed

TEXTURED = tuple(f"surfaces {row}" for row in range(2))
"""Scenes of `textured-256`: procedural surfaces on half of what there is."""

SKIES = ("sun_and_sky", "clouds", "softboxes", "night")
"""Families of the skies: the first has a sharp sun."""

_SEEN = ("sun_and_sky", "softboxes")
"""Those that cameras see too."""

_SEED = 20_261_125
_SKY_ROWS = 128

_ROUGH = (0.4, 1.0)
_CALM = {
    "num_views": 1,
    "textures.share": 0.8,
    "textures.surfaces.roughness_clip": _ROUGH,
    "materials.roughness_clip": _ROUGH,
}
"""Changes that leave out mirrors, whose caustics would drown in noise what is compared here."""


def mapped_scene(name: str) -> Scene:
    """Return the scene of a name, with one camera; runs in a render child with objects.

    Args:
        name: one of TEXTURED, or `sky` and one of SKIES.

    Raises:
        Rejected: none can be composed.
    """
    kind, _, which = name.partition(" ")
    number = int(which) if kind == "surfaces" else 10 + SKIES.index(which)
    settings: SceneSettings = changed(textured_256().scenes, _CALM)
    if kind == "sky":
        sky = {
            "skies.share": 1.0,
            "skies.over_lamps_log": (2.0, 2.0),
            "skies.seen_share": float(which in _SEEN),
            "skies.maps.families": (which,),
            "skies.maps.height": _SKY_ROWS,
        }
        settings = changed(settings, sky)
    scene, _ = first_composed(settings, number, seed=_SEED)
    if scene is None:
        raise Rejected("no_scene", f"{name}: every attempt was rejected")
    return scene


def below_a_sun(scene: Scene) -> Scene:
    """Return a scene below a sky with a sun, in the middle of a camera that looks down on it."""
    sky = draw_sky(
        rng_for(_SEED, "sky", 0),
        SkyMapSettings(families=("sun_and_sky",), height=_SKY_ROWS, mean_radiance=(0.5, 0.5)),
    )
    points = scene.vertex_positions.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    eye = (low + high) / 2 + np.linalg.norm(high - low) * np.array([0.7, -1.2, 0.9])
    pose = look_at_c2w(eye=eye, target=(low + high) / 2, up=[0, 0, 1])
    return dataclasses.replace(
        scene.with_cameras(pose[None].astype(np.float32), np.array([38], np.float32)),
        environment=Environment(radiance_rgb=sky.radiance_rgb, source=MapSource(name=sky.family)),
    )
