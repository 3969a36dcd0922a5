"""Maps of a scene. `draw_look`: which surfaces are textured, with what, and how a texture lies.

`scene_sky`: whether a scene has an environment map (sky), and which. Its draws have a random stream
of their own, so that a preset with skies has the objects, materials and lights that it has without
them, and the cameras too, but for views that only the sky lights.

A user's own textures and maps (`UserMap`) are drawn beside the procedural ones. Two that are under
different share-alike licences, or one and an object, never meet in a scene: it could be shared
under neither.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range
from scene_templates.exact import cosine, sine
from scene_templates.skies.procedural_skies import SkySettings, draw_sky
from scene_templates.surfaces.maps import SurfaceMaps
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings, draw_surface
from storage.licences import mixed_share_alike
from storage.records.texture import Environment, MapSource
from storage.seeds import SceneKey, rng_for
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@dataclass(frozen=True, kw_only=True, eq=False)
class UserMap:
    """A texture or map that is read when it is drawn."""

    uid: str
    """Identifier in objects.lock.jsonl."""
    source: MapSource
    """Title, URL and license."""
    load: Callable[[], Mapping[str, NDArray[np.float32]]]
    """Returns its arrays, linear, the top row first: "radiance" [H, 2H, 3] of a map; "diffuse" and
    "specular" albedo [H, W, 3] of a texture, and "roughness" [H, W, 1], without which one number is
    drawn."""


UserMaps = Mapping[str, Sequence[UserMap]]
"""User textures and skies that the scenes of a split may use, sorted by uid, by the names of their
kinds in a lock (storage.records.objects)."""


def draw_user_map(
    rng: np.random.Generator,
    user_maps: Sequence[UserMap],
    share: float,
    licences: Sequence[str],
) -> UserMap | None:
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
    user_textures: Sequence[UserMap] = (),
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
        arrays = chosen.load()
        if (rough := arrays.get("roughness")) is None:
            rough = np.full((*arrays["diffuse"].shape[:2], 1), rng.uniform(*clip), np.float32)
        maps = SurfaceMaps(
            diffuse_rgb=arrays["diffuse"],
            specular_rgb=arrays["specular"],
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


LEAST_DISTANCE = 0.5
"""Emitters count as this far from the middle of the room at least, half of its width."""


def scene_sky(
    settings: SkySettings,
    emitters: NDArray[np.float64],
    radiance_rgb: NDArray[np.float64],
    scene_key: SceneKey,
    *,
    user_skies: Sequence[UserMap] = (),
    licences: Sequence[str] = (),
) -> tuple[Environment, dict[str, Any], str] | None:
    """Return the sky of a scene, or None where it has none.

    Args:
        settings: the ranges to draw from.
        emitters: [N, 3, 3] corners of the emitting triangles, around the middle of the room; if
            there are none, the drawn strength is the mean radiance of the sky.
        radiance_rgb: [N, 3] their radiance.
        scene_key: its attempt decides which sky, not whether there is one.
        user_skies: the user's own maps.
        licences: of what is in the scene already.

    Returns:
        The map; provenance entries: family, over_lamps and azimuth_deg; and the identifier of a
        user's map in objects.lock.jsonl, empty for a procedural one.
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
        radiance = chosen.load()["radiance"]
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
    origin = {"family": family, "over_lamps": over_lamps, "azimuth_deg": azimuth_deg}
    return environment, origin, chosen.uid if chosen else ""


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
