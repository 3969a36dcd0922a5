"""The textures and the sky of a scene on its page: small pictures with their rights."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.html import Cell, Markup, element, image, outside_link, png_uri, table
from storage.conventions import preview_srgb8, srgb8
from storage.records.environment import Environment
from storage.records.map_facts import sky_facts
from storage.records.scene import Scene
from storage.records.texture import TEXTURED, Texture

MAPS_STYLE = """
.maps { display: flex; flex-wrap: wrap; gap: .8rem; margin-bottom: 1.2rem }
.maps figure { width: min-content } .maps figure img { width: auto; height: 112px }
"""
"""Style sheet of `maps_section`."""

_SIDE_PX = 112
_MOST_SHOWN = 48
"""Most textures shown as pictures; the table has all."""


def maps_section(scene: Scene) -> list[Markup]:
    """Return pictures of the textures and of the sky with their rights, if there are any."""
    figures = []
    rows = list[list[Cell]]()
    for row, texture in enumerate(scene.textures):
        role = " and ".join(_columns(scene, row))
        rows.append([texture.source.name, f"texture: {role}", *_rest(texture.texels, texture)])
        if row < _MOST_SHOWN:
            name = texture.source.name
            caption = name if name.endswith(role) else f"{name} ({role})"
            figures.append(_figure(_texture_pixels(texture), caption))
    if (sky := scene.environment) is not None:
        seen = "environment, seen" if sky.is_seen else "environment, hidden from cameras"
        rows.append([sky.source.name, seen, *_rest(sky.radiance_rgb, sky)])
        figures.append(_figure(_sky_pixels(sky), _sky_caption(sky, seen)))
    if not rows:
        return []
    head = ("name", "what", "texels", "licence", "attribution", "source")
    heading = element("h2", "Textures and environment")
    return [heading, element("div", *figures, class_="maps"), table(head, rows, numbers=0)]


def _figure(pixels: NDArray[np.uint8], caption: str) -> Markup:
    return element("figure", image(png_uri(pixels), caption), element("figcaption", caption))


def _columns(scene: Scene, row: int) -> list[str]:
    assert scene.material_textures is not None
    used = (scene.material_textures == row).any(axis=0)
    return [name for name, uses in zip(TEXTURED, used, strict=True) if uses]


def _rest(values: NDArray, one: Texture | Environment) -> list[Cell]:
    source = one.source
    return [
        f"{values.shape[1]} x {values.shape[0]}",
        source.licence,
        source.attribution,
        outside_link(source.source_url),
    ]


def _texture_pixels(texture: Texture) -> NDArray[np.uint8]:
    """Return the pixels of a texture, top row first; linear values are converted to sRGB."""
    height, width = texture.texels.shape[:2]
    step = max(1, height // _SIDE_PX, width // (4 * _SIDE_PX))
    linear = texture.linear(texture.texels[::-1][::step, ::step])
    return srgb8(linear if texture.channels == 3 else linear[..., 0])


def _sky_pixels(sky: Environment) -> NDArray[np.uint8]:
    """Return the pixels of a sky, exposed by its mean: a sun is white, the rest visible."""
    facts = sky_facts(sky)
    scale = 0.5 / facts.mean_radiance if facts.mean_radiance else 1.0
    pixels = preview_srgb8((sky.radiance_rgb * np.float32(scale)).astype(np.float32))
    size = (2 * _SIDE_PX, _SIDE_PX)
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


def _sky_caption(sky: Environment, seen: str) -> str:
    facts = sky_facts(sky)
    return (
        f"{sky.source.name} ({seen}): mean radiance {facts.mean_radiance:.3g}, brightest texel "
        f"{facts.peak:.3g} times that, half of the light from {facts.half_light_deg:.1f} degrees"
    )
