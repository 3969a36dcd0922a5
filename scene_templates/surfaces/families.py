"""The families of surfaces, by name; extensions may add to them.

A family is a function of the draws of one surface and its texels. All that it draws has a name and
a stated range, and noises and patterns take a stream of their own, so that the same seed gives the
same surface at every size.
"""

from collections.abc import Callable

from scene_templates.surfaces.draws import SurfaceDraws
from scene_templates.surfaces.grown import cobbles, concrete, marble, planks, terrazzo, wood
from scene_templates.surfaces.laid import bricks, checker, hexagons, stripes, tiles
from scene_templates.surfaces.made import brushed_metal, camouflage, fabric, rust
from scene_templates.surfaces.maps import Finish
from scene_templates.surfaces.texels import Texels
from storage.registry import Registry

SurfaceFamily = Callable[[SurfaceDraws, Texels], Finish]

_OURS: dict[str, SurfaceFamily] = {
    "checker": checker,
    "stripes": stripes,
    "bricks": bricks,
    "tiles": tiles,
    "hexagons": hexagons,
    "planks": planks,
    "wood": wood,
    "marble": marble,
    "terrazzo": terrazzo,
    "cobbles": cobbles,
    "concrete": concrete,
    "rust": rust,
    "brushed_metal": brushed_metal,
    "fabric": fabric,
    "camouflage": camouflage,
}

OUR_SURFACES = tuple(_OURS)
"""What surfaces are drawn from unless the settings say otherwise; registering another does not
change it."""

SURFACES: Registry[SurfaceFamily] = Registry("surface", Callable, _OURS, decides=("data",))
"""Every name that `SurfaceMapSettings.families` admits."""
