"""`draw_look`: which surfaces are textured, with what, and how a texture lies on them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range
from scene_templates.surfaces.maps import SurfaceMaps
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings, draw_surface
from scene_templates.user_maps import UserMap, UserTexture, draw_user_map, user_surface
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

MOST_TEXTURED = 64
"""Most objects, floors and walls of a scene that have a texture: three maps of each are stored."""


@checked("scene settings")
class TextureSettings:
    """How many surfaces are textured, and how."""

    share: Share = 0.0
    """Share of the objects, floors and walls that have a texture in the place of their drawn
    colors and roughness. Of more than 64, the first ones are."""
    own_share: Share = 0.0
    """Share of those textures that are of your own folder (`--textures`), each equally likely; the
    others are procedural, and so are all in a split to which none of the folder belongs."""
    tile_m: Annotated[Range, Within(0.05, 100, unit="m")] = (0.4, 1.6)
    """Range of the width of a texture on a surface, in meters; it repeats after that."""
    surfaces: SurfaceMapSettings = field(default_factory=SurfaceMapSettings)
    """Families of procedural textures. The size holds for your own too, as the most texels along a
    side, and so does the range of roughness, which is uniform where no picture says it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedLook:
    """A texture, and how it lies on a surface."""

    maps: SurfaceMaps
    """One repetition of the texture."""
    tile_m: float
    """Width of one repetition in meters."""
    quarter_turns: int
    """Quarter turns counter-clockwise, 0 to 3."""
    shift_uv: tuple[float, float]
    """Texture coordinates of the surface's own origin, each uniform in [0, 1)."""
    uid: str = ""
    """Identifier of a user's texture in objects.lock.jsonl; empty for a procedural one."""

    def uv(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return texture coordinates of places [..., 2] on a flat side: to the right and up."""
        x = places_m[..., 0] / self.tile_m
        y = places_m[..., 1] / self.tile_m
        for _ in range(self.quarter_turns):
            x, y = y, -x  # the picture turns counter-clockwise where coordinates turn clockwise
        rows, columns = self.maps.diffuse_rgb.shape[:2]
        if rows != columns:  # texels are square on the surface
            y = y * (columns / rows)
        return np.stack([x + self.shift_uv[0], y + self.shift_uv[1]], axis=-1)


def draw_look(
    rng: np.random.Generator,
    settings: TextureSettings,
    user_textures: Sequence[UserMap[UserTexture]] = (),
    licences: Sequence[str] = (),
) -> TexturedLook | None:
    """Return the texture of a surface, or None where it has none.

    Whether it has one is drawn first: another `share` changes no texture that is there still.

    Args:
        rng: the stream of this surface.
        settings: the shares and the ranges.
        user_textures: a user's own textures.
        licences: of what is in the scene already.
    """
    if rng.random() >= settings.share:
        return None
    tile_m = rng.uniform(*settings.tile_m)
    turns = int(rng.integers(4))
    shift_u, shift_v = rng.random(2)
    chosen = draw_user_map(rng, user_textures, settings.own_share, licences)
    if chosen is None:
        maps = draw_surface(rng, settings.surfaces)
    else:
        maps = user_surface(chosen, rng, settings.surfaces.roughness_clip)
    return TexturedLook(
        maps=maps,
        tile_m=float(tile_m),
        quarter_turns=turns,
        shift_uv=(float(shift_u), float(shift_v)),
        uid=chosen.uid if chosen else "",
    )
