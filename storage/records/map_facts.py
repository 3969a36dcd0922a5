"""The numbers of the textures and of the sky of one scene that a report counts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.environment import Environment
from storage.records.scene import Scene
from storage.records.sky_texels import row_solid_angles
from storage.records.texture import CONSTANT, NORMAL, TEXTURED


@dataclass(frozen=True, kw_only=True)
class SkyFacts:
    """Brightness of an environment map, and how concentrated its light is."""

    mean_radiance: float
    """Over the sphere and the three channels."""
    peak: float
    """The brightest texel, over that mean; 0 of a black map."""
    half_light_deg: float
    """Angle across a disc with the solid angle of the brightest texels that hold half of the light:
    180 of a constant map, half a degree of a sun like ours; 0 of a black map."""


def sky_facts(sky: Environment) -> SkyFacts:
    """Return the facts of a lawful map."""
    grey = sky.radiance_rgb.mean(axis=-1, dtype=np.float64)
    angle = np.broadcast_to(row_solid_angles(len(grey))[:, None], grey.shape).ravel()
    light = grey.ravel() * angle
    total = float(light.sum())
    if not total > 0:
        return SkyFacts(mean_radiance=0.0, peak=0.0, half_light_deg=0.0)
    order = np.argsort(-grey, axis=None, kind="stable")
    reached = np.cumsum(light[order])
    solid = np.cumsum(angle[order])
    half = np.interp(total / 2, np.append(0.0, reached), np.append(0.0, solid))
    return SkyFacts(
        mean_radiance=total / (4 * np.pi),
        peak=float(grey.max()) * 4 * np.pi / total,
        half_light_deg=float(np.degrees(2 * np.arccos(np.clip(1 - half / (2 * np.pi), -1, 1)))),
    )


def texture_families(scene: Scene) -> set[str]:
    """Return what the textures of a scene are called, without the name of their column."""
    names = set()
    for texture in scene.textures:
        name, _, column = texture.source.name.rpartition(" ")
        is_column = name and column in (*TEXTURED, NORMAL)
        names.add(name if is_column else texture.source.name)
    return names


def textured_objects(scene: Scene) -> set[int]:
    """Return the rows of `Scene.objects` of which a triangle has a texture."""
    if scene.material_textures is None:
        return set()
    textured: NDArray[np.bool_] = np.any(scene.material_textures != CONSTANT, axis=1)
    if scene.normal_textures is not None:
        textured |= scene.normal_textures != CONSTANT
    return set(np.unique(scene.object_index[textured[scene.material_index]]).tolist())
