"""`scene_sky`: whether a scene has an environment map (sky), and which.

Its draws have a random stream of their own, so that a preset with skies has the objects, materials
and lights that it has without them, and the cameras too, but for views that only the sky lights.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import cosine, sine
from scene_templates.skies.procedural_skies import SkySettings, draw_sky
from scene_templates.textures import UserMap, draw_user_map
from storage.records.environment import Environment
from storage.records.texture import MapSource
from storage.seeds import SceneKey, rng_for

LEAST_DISTANCE = 0.5
"""Emitters count as this far from the middle of the room at least, half of its width."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneSky:
    """The sky of a scene."""

    environment: Environment
    origin: dict[str, Any]
    """Provenance entries: family, over_lamps and azimuth_deg."""
    uid: str = ""
    """Identifier of a user's map in objects.lock.jsonl; empty for a procedural one."""


def scene_sky(
    settings: SkySettings,
    emitters: NDArray[np.float64],
    radiance_rgb: NDArray[np.float64],
    scene_key: SceneKey,
    *,
    user_skies: Sequence[UserMap[NDArray[np.float32]]] = (),
    licences: Sequence[str] = (),
) -> SceneSky | None:
    """Return the sky of a scene, or None where it has none.

    Args:
        settings: the ranges to draw from.
        emitters: [N, 3, 3] corners of the emitting triangles, around the middle of the room; if
            there are none, the drawn strength is the mean radiance of the sky.
        radiance_rgb: [N, 3] their radiance.
        scene_key: its attempt decides which sky, not whether there is one.
        user_skies: the user's own maps.
        licences: of what is in the scene already.
    """
    if rng_for(scene_key.seed, "has sky", scene_key.index).random() >= settings.share:
        return None
    rng = scene_key.rng("sky")
    place = scene_key.rng("own sky")
    chosen = draw_user_map(place, user_skies, settings.own_share, licences)
    if chosen is None:
        family, radiance = draw_sky(rng, settings.maps)
        source = MapSource(name=family)
    else:
        family = "own"
        radiance = chosen.load()
        source = chosen.source
    low, high = (math.log(bound) for bound in settings.over_lamps_log)
    over_lamps = math.exp(rng.uniform(low, high))
    azimuth_rad = float(rng.uniform(0, 2 * math.pi))
    is_seen = bool(rng.random() < settings.seen_share)
    mean = _mean_radiance(radiance)
    lamps = lamp_irradiance(emitters, radiance_rgb) if len(emitters) else math.pi
    target_radiance = over_lamps * lamps / math.pi
    with np.errstate(over="ignore"):  # a scene's laws refuse infinite radiance by name
        scaled = (radiance * np.float32(target_radiance / mean)).astype(np.float32)
    environment = Environment(
        radiance_rgb=scaled,
        rotation=_about_z(azimuth_rad),
        is_seen=is_seen,
        source=source,
    )
    azimuth_deg = math.degrees(azimuth_rad)
    return SceneSky(
        environment=environment,
        origin={"family": family, "over_lamps": over_lamps, "azimuth_deg": azimuth_deg},
        uid=chosen.uid if chosen else "",
    )


def lamp_irradiance(emitters: NDArray[np.float64], radiance_rgb: NDArray[np.float64]) -> float:
    """Return the sum over triangles of area x mean radiance / distance^2 from the origin."""
    edges = emitters[:, 1:] - emitters[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    distance_sq = np.square(emitters.mean(axis=1)).sum(axis=1)
    far = np.maximum(distance_sq, LEAST_DISTANCE**2)
    return float((area * radiance_rgb.mean(axis=1) / far).sum())


def _mean_radiance(radiance_rgb: NDArray[np.float32]) -> float:
    """Return the mean of a map [H, 2 H, 3] over the sphere and the channels."""
    grey = radiance_rgb.astype(np.float64).mean(axis=(1, 2))
    edges = np.cos(np.pi * np.arange(len(grey) + 1) / len(grey))
    return float((grey * (edges[:-1] - edges[1:])).sum() / 2)


def _about_z(angle_rad: float) -> NDArray[np.float32]:
    c = float(cosine(angle_rad))
    s = float(sine(angle_rad))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
