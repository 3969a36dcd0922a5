"""`OwnMaps`: the textures and maps of a user's own that scenes of one split may take.

They are drawn beside the procedural ones. Two that are under different share-alike licences, or one
and an object, never meet in a scene: it could be shared under neither.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from scene_templates.surfaces.maps import SurfaceMaps
from storage.licences import mixed_share_alike
from storage.records.texture import MapSource

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


def user_surface(
    chosen: UserMap[UserTexture], rng: np.random.Generator, roughness_clip: tuple[float, float]
) -> SurfaceMaps:
    """Return a user's surface; a roughness that is missing is uniform in `roughness_clip`."""
    diffuse_rgb, specular_rgb, rough = chosen.load()
    if rough is None:
        rough = np.full((*diffuse_rgb.shape[:2], 1), rng.uniform(*roughness_clip), np.float32)
    return SurfaceMaps(
        family=chosen.source.name,
        diffuse_rgb=diffuse_rgb,
        specular_rgb=specular_rgb,
        roughness=np.clip(rough, *roughness_clip).astype(np.float32),
        parameters={},
        source=chosen.source,
    )


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
