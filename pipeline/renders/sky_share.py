"""Fraction of light samples that go to the environment map; the others go to lamps.

Lamps weigh area x radiance. In that unit a map weighs 2 pi R^2 times its mean radiance, with R the
radius of the scene. But most of a smooth map is found by directions that the surface draws, and
samples that pick it are taken from the lamps: picked by its whole power, a bright constant map had
twice the error. So a map weighs what it has in peaks, its mean less its median, and at least as
much as the average lamp (study S29).
"""

import numpy as np

from storage.records.environment import Environment
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.sky_texels import row_solid_angles


def shining_sky(scene: Scene) -> Environment | None:
    """Return the environment of a scene, or None where there is none, or one without any light."""
    sky = scene.environment
    return sky if sky is not None and sky.radiance_rgb.any() else None


def sky_share(scene: Scene, sky: Environment) -> float:
    """Return the share of the picks that go to the environment: above 0, and 1 without lamps."""
    power = lamp_power(scene)
    lamps = len(np.unique(scene.object_index[scene.triangle_emits]))
    if not power > 0:
        return 1.0
    weight = max(2 * np.pi * surface_radius(scene) ** 2 * peaked_radiance(sky), power / lamps)
    return float(weight / (weight + power))


def lamp_power(scene: Scene) -> float:
    """Return the sum over emitting triangles of area x mean radiance of the three channels."""
    emits = scene.triangle_emits
    corners = scene.vertex_positions[scene.faces[emits]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    radiance = scene.materials[scene.material_index[emits]][:, EMISSION].astype(np.float64)
    return float((0.5 * np.linalg.norm(normal, axis=1) * radiance.mean(axis=1)).sum())


def surface_radius(scene: Scene) -> float:
    """Return the radius of the sphere around the bounding box of all surfaces, emitters not."""
    corners = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
    return float(0.5 * np.linalg.norm(np.ptp(corners.astype(np.float64), axis=0)))


def peaked_radiance(sky: Environment) -> float:
    """Return the mean radiance of a map over the sphere, less its median over the sphere."""
    grey = sky.radiance_rgb.mean(axis=-1, dtype=np.float64)
    weight = np.broadcast_to(row_solid_angles(len(grey))[:, None], grey.shape) / (4 * np.pi)
    order = np.argsort(grey, axis=None, kind="stable")
    below = np.cumsum(weight.ravel()[order])
    median = grey.ravel()[order][min(np.searchsorted(below, 0.5), len(order) - 1)]
    return max(0.0, float((grey * weight).sum() - median))
