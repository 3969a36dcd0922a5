"""The textures and the sky of a scene on its page: small pictures with their rights."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.pages import png_uri
from storage.conventions import preview_srgb8, srgb8
from storage.records.environment import Environment
from storage.records.map_facts import sky_facts
from storage.records.scene import Scene
from storage.records.texture import TEXTURED, MapSource, Texture

_SIDE_PX = 112
_MOST_SHOWN = 48
"""Most textures shown as pictures; the table has all."""


class ShownMap(NamedTuple):
    """A texture or a sky, as a page shows it."""

    source: MapSource
    what: str
    """Columns of the material that it gives, or whether cameras see the sky."""
    size: str
    """Width and height in texels."""
    caption: str
    picture: str | None
    """Address of the picture; None beyond the most that are shown."""


def shown_maps(scene: Scene) -> list[ShownMap]:
    """Return the textures and the sky of a scene, if there are any."""
    maps = []
    for row, texture in enumerate(scene.textures):
        assert scene.material_textures is not None
        used = (scene.material_textures == row).any(axis=0)
        role = " and ".join(name for name, uses in zip(TEXTURED, used, strict=True) if uses)
        name = texture.source.name
        caption = name if name.endswith(role) else f"{name} ({role})"
        picture = png_uri(_texture_pixels(texture)) if row < _MOST_SHOWN else None
        size = _size(texture.texels)
        maps.append(ShownMap(texture.source, f"texture: {role}", size, caption, picture))
    if (sky := scene.environment) is not None:
        seen = "environment, seen" if sky.is_seen else "environment, hidden from cameras"
        facts = sky_facts(sky)
        caption = (
            f"{sky.source.name} ({seen}): mean radiance {facts.mean_radiance:.3g}, brightest texel "
            f"{facts.peak:.3g} times that, half of the light from {facts.half_light_deg:.1f} "
            "degrees"
        )
        picture = png_uri(_sky_pixels(sky, facts.mean_radiance))
        maps.append(ShownMap(sky.source, seen, _size(sky.radiance_rgb), caption, picture))
    return maps


def _size(values: NDArray) -> str:
    return f"{values.shape[1]} x {values.shape[0]}"


def _texture_pixels(texture: Texture) -> NDArray[np.uint8]:
    """Return the pixels of a texture, top row first; linear values are converted to sRGB."""
    height, width = texture.texels.shape[:2]
    step = max(1, height // _SIDE_PX, width // (4 * _SIDE_PX))
    linear = texture.linear(texture.texels[::-1][::step, ::step])
    return srgb8(linear if texture.channels == 3 else linear[..., 0])


def _sky_pixels(sky: Environment, mean_radiance: float) -> NDArray[np.uint8]:
    """Return the pixels of a sky, exposed by its mean: a sun is white, the rest visible."""
    scale = 0.5 / mean_radiance if mean_radiance else 1.0
    pixels = preview_srgb8((sky.radiance_rgb * np.float32(scale)).astype(np.float32))
    size = (2 * _SIDE_PX, _SIDE_PX)
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))
