"""`SkySettings`: which scenes have an environment map, and how strongly it lights them."""

from dataclasses import field
from typing import Annotated

from scene_templates.checks import Range
from scene_templates.skies.draw import SkyMapSettings
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@checked("scene settings")
class SkySettings:
    """Share and strength of the skies of scenes."""

    share: Share = 0.0
    """Share of the scenes that have a sky beside their emitters."""
    own_share: Share = 0.0
    """Share of those skies that are of your own folder (`--skies`), each equally likely; the others
    are procedural, and so are all in a split to which none of the folder belongs."""
    over_lamps_log: Annotated[Range, Within(1e-6, 1e6)] = (0.02, 1.0)
    """Range, log-uniform, of the irradiance that a sky of constant radiance, the mean of the map,
    has on a surface, over that of all emitters at the middle of the room on surfaces that face
    them. It takes the place of `maps.mean_radiance`. In a scene without emitters it is the mean
    radiance itself."""
    seen_share: Share = 0.0
    """Share of the skies that cameras see behind everything."""
    maps: SkyMapSettings = field(default_factory=SkyMapSettings)
    """What procedural maps are drawn from. The height holds for your own too, as the most rows."""
