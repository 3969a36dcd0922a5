"""Scenes for the tests of what is traced, as `LitScene` has them."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.hits.lit_scene import LitScene
from model.hits.textures import surface_textures
from model.hits.view_inputs import Channel, view_inputs
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import Environment, Texture
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere

FLOOR = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
WALL = [[-2, 1.5, 0], [2, 1.5, 0], [2, 1.5, 3], [-2, 1.5, 3]]
LAMP = [[-0.3, -0.4, 2.2], [0.4, -0.2, 2.3], [0.0, 0.5, 2.1]]


def lit_scene(scene: Scene) -> LitScene:
    return LitScene(
        scene.vertex_positions[scene.faces],
        scene.vertex_normals[scene.faces],
        scene.materials[scene.material_index],
        surface_textures(scene),
        sky=scene.environment,
    )


def corner(
    *, roughness: float = 0.4, radiance: float = 30.0, sky: Environment | None = None
) -> Scene:
    """Return a floor and a wall with a box and a glossy ball under one lamp, or none for 0."""
    parts = [
        quad(FLOOR, material(diffuse=[0.6, 0.5, 0.4], specular=0.1, roughness=0.5)),
        quad(WALL, material(diffuse=[0.3, 0.5, 0.7])),
        box([-0.5, 0.3, 0.3], 0.6, material(diffuse=[0.7, 0.2, 0.2]), turn=0.4),
        sphere([0.5, -0.2, 0.4], 0.4, material(diffuse=0.1, specular=0.7, roughness=roughness)),
    ]
    if radiance:
        parts.append(light(LAMP, [radiance, 0.8 * radiance, 0.6 * radiance]))
    return join(parts, eye=(1.0, -3.0, 1.4), target=(0, 0, 0.4), fov_deg=38.0, sky=sky)


class ViewInputs(NamedTuple):
    """What `view_inputs` returns, by name."""

    pixels: NDArray
    anchor: NDArray
    gathered: NDArray


def traced(scene: Scene, resolution: int = 32, **changes: int) -> ViewInputs:
    lit, fov_deg = lit_scene(scene), float(scene.fov_deg[0])
    seed = changes.pop("seed", 0)
    return ViewInputs(*view_inputs(lit, scene.c2w[0], fov_deg, resolution, rays(**changes), seed))


def rays(
    *,
    rays_a_side: int = 2,
    anchors_a_side: int = 8,
    gather_rays: int = 16,
    sky_rays: int = 4,
    shades_each_ray: int = False,
) -> Any:
    """Stand for a network that reads so many rays, also more than one may."""
    return SimpleNamespace(
        hit_rays=rays_a_side,
        hit_anchors=anchors_a_side,
        gather_rays=gather_rays,
        sky_rays=sky_rays,
        denoises=lambda _: not shades_each_ray,
    )


def direct(inputs: ViewInputs) -> np.ndarray:
    """Return the direct light of a view [R, R, 3]."""
    shown = inputs.pixels[..., Channel.SHOWN_DIFFUSE]
    total: np.ndarray = shown + inputs.pixels[..., Channel.DIRECT_SPECULAR]
    return total


def textured(*, roughness: bool = True) -> Scene:
    """Return the corner with a coloured floor, and a ball of which the gloss is textured."""
    scene = corner()
    rng = np.random.default_rng(0)
    colours = Texture(texels=rng.integers(0, 200, (8, 8, 3), np.uint8), is_srgb=True)
    rough = Texture(texels=rng.uniform(0.2, 0.9, (4, 4, 1)).astype(np.float32))
    index = np.full((len(scene.materials), 3), -1, np.int32)
    index[0, 0] = 0
    if roughness:
        index[3, 2] = 1
    uv = 1.3 * scene.vertex_positions[scene.faces.ravel(), :2] - 0.4
    textures = (colours, rough)[: 1 + roughness]
    found = with_textures(scene, uv.astype(np.float32), textures, index)
    found.check()
    return found
