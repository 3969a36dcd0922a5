"""`draw_look`: which surfaces are textured, with what, and how a texture lies on them.

A user's own textures and maps (`OwnMaps`) are drawn beside the procedural ones. Two that are under
different share-alike licences, or one and an object, never meet in a scene: it could be shared
under neither.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range
from scene_templates.surfaces.maps import SurfaceMaps
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings, draw_surface
from storage.licences import mixed_share_alike
from storage.records.texture import MapSource
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class UserMap(Generic[Made]):
    """A texture or map that is read when it is drawn."""

    uid: str
    """Identifier in objects.lock.jsonl."""
    source: MapSource
    """Title, URL and license."""
    load: Callable[[], Made]


UserTexture = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32] | None]
"""Diffuse and specular albedo [H, W, 3], linear, the top row first; and roughness [H, W, 1], or
None where one number is to be drawn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnMaps:
    """User textures and skies that the scenes of a split may use."""

    textures: Sequence[UserMap[UserTexture]] = ()
    """The user's textures, sorted by uid."""
    skies: Sequence[UserMap[NDArray[np.float32]]] = ()
    """Maps [H, 2H, 3] of linear radiance, sorted by uid."""


NO_OWN_MAPS = OwnMaps()


def draw_user_map(
    rng: np.random.Generator,
    user_maps: Sequence[UserMap[Made]],
    share: float,
    licences: Sequence[str],
) -> UserMap[Made] | None:
    """Return one of a user's own, each equally likely, or None where a procedural one is taken.

    Nothing is drawn of `rng` where the share is 0 or there is none.

    Args:
        rng: the stream.
        user_maps: the textures or maps.
        share: probability of one.
        licences: of what is in the scene already.
    """
    if not (share and user_maps) or rng.random() >= share:
        return None
    meeting = [one for one in user_maps if not mixed_share_alike([*licences, one.source.licence])]
    return meeting[int(rng.integers(len(meeting)))] if meeting else None


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
        clip = settings.surfaces.roughness_clip
        diffuse_rgb, specular_rgb, rough = chosen.load()
        if rough is None:
            rough = np.full((*diffuse_rgb.shape[:2], 1), rng.uniform(*clip), np.float32)
        maps = SurfaceMaps(
            family=chosen.source.name,
            diffuse_rgb=diffuse_rgb,
            specular_rgb=specular_rgb,
            roughness=np.clip(rough, *clip).astype(np.float32),
            source=chosen.source,
        )
    return TexturedLook(
        maps=maps,
        tile_m=float(tile_m),
        quarter_turns=turns,
        shift_uv=(float(shift_u), float(shift_v)),
        uid=chosen.uid if chosen else "",
    )
