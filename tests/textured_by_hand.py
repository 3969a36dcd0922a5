"""Small textured and sky-lit scenes made by hand, for tests that need maps and not pictures."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.records.texture import Environment, MapSource, Texture
from tests.scenes_by_hand import FLOOR, tiny_sample, tiny_scene


def colour_texture(seed: int = 0, size: tuple[int, int] = (4, 6)) -> Texture:
    """Return random sRGB-encoded 8-bit colours that leave room for a specular albedo of 0.2."""
    texels = np.random.default_rng(seed).integers(0, 200, (*size, 3), np.uint8)
    return Texture(texels=texels, is_srgb=True, source=MapSource(name=f"colours {seed}"))


def number_texture(seed: int = 0) -> Texture:
    """Return random float32 numbers that half floats do not hold."""
    texels = np.random.default_rng(seed).random((3, 2, 1), np.float32)
    return Texture(texels=texels, source=MapSource(name="roughness", licence="CC-BY-4.0"))


def corner_uv(scene: Scene) -> NDArray[np.float32]:
    """Return coordinates [3T, 2] that reach beyond [0, 1]: x and y of the corners."""
    uv: NDArray[np.float32] = 0.7 * scene.vertex_positions[scene.faces.ravel(), :2]
    return uv.astype(np.float32)


def textured_scene(seed: int = 0, *textures: Texture, **changes: Any) -> Scene:
    """Return the tiny scene with a floor whose diffuse albedo and roughness are textured.

    Args:
        seed: of the colours.
        textures: other ones, diffuse first.
        changes: of other members.
    """
    scene = tiny_scene()
    chosen = textures or (colour_texture(seed), number_texture())
    index = np.full((len(scene.materials), 3), -1, np.int32)
    index[FLOOR, [0, 2]] = [0, 1]
    fields = {"uv": corner_uv(scene), "textures": chosen, "material_textures": index}
    return dataclasses.replace(scene, **{**fields, **changes})


def bumps(seed: int = 0, tilt: float = 0.5, size: tuple[int, int] = (5, 7)) -> Texture:
    """Return a normal map of independent texels, whose slopes are at most `tilt` each way."""
    slope = np.random.default_rng(seed).uniform(-tilt, tilt, (*size, 2))
    normal = np.concatenate([slope, np.ones((*size, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Texture(texels=np.round((normal + 1) / 2 * 255).astype(np.uint8))


def bumpy_scene(seed: int = 0, **changes: Any) -> Scene:
    """Return the textured scene, whose floor has a normal map of 8 bits too."""
    scene = textured_scene(seed)
    normals = np.full(len(scene.materials), -1, np.int32)
    normals[FLOOR] = len(scene.textures)
    maps = {"textures": (*scene.textures, bumps(seed)), "normal_textures": normals}
    return dataclasses.replace(scene, **{**maps, **changes})


def sky(seed: int = 0, **changes: Any) -> Environment:
    """Return a random map of 3 x 6 texels, with a sun of 1e6, that stands on its side."""
    radiance = np.random.default_rng(seed).random((3, 6, 3)).astype(np.float16).astype(np.float32)
    radiance[0, 1] = 1e6
    fields: dict[str, Any] = {
        "radiance_rgb": radiance,
        "rotation": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32),
        "source": MapSource(name=f"sky {seed}"),
    }
    return Environment(**{**fields, **changes})


def textured_sample(key: str = "000000000", seed: int = 0, **changes: Any) -> Sample:
    """Return a sample of the textured scene below a sky, with random pictures."""
    scene = textured_scene(seed, **{"environment": sky(), **changes})
    return dataclasses.replace(tiny_sample(key, seed=seed), scene=scene)
