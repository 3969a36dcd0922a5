"""The families of skies, by name; extensions may add to them.

A family is a function of the draws of one sky and its texels. All that it draws has a name and a
stated range, and its noises take streams of their own, so that the same seed gives the same sky at
every size.
"""

from collections.abc import Callable

from scene_templates.exact import Numbers
from scene_templates.skies.draws import SkyDraws
from scene_templates.skies.indoors import constant, gradient, lobes, softboxes, window_wall
from scene_templates.skies.outdoors import clouds, night, sun_and_sky
from scene_templates.skies.texels import SkyTexels
from storage.registry import Registry

SkyFamily = Callable[[SkyDraws, SkyTexels], Numbers]

_OURS: dict[str, SkyFamily] = {
    "sun_and_sky": sun_and_sky,
    "clouds": clouds,
    "night": night,
    "softboxes": softboxes,
    "window_wall": window_wall,
    "lobes": lobes,
    "gradient": gradient,
    "constant": constant,
}

OUR_SKIES = tuple(_OURS)
"""What skies are drawn from unless the settings say otherwise; registering another does not change
it."""

SKIES: Registry[SkyFamily] = Registry("sky", Callable, _OURS, decides=("data",))
"""Every name that `SkyMapSettings.families` admits."""
