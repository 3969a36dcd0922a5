"""A floor and two walls at +X and +Y, seen from the quarter opposite them."""

from scene_templates.templates.sectors import Sector
from scene_templates.templates.template import Template

CORNER = Template(
    name="corner",
    parts=("floor", "wall0", "wall1"),
    cameras=Sector(azimuth_deg=225, half_width_deg=45, elevation_deg=(3, 87)),
    # A half-turn, as published: the outer lights graze one wall from behind and shine over it.
    lights=Sector(azimuth_deg=225, half_width_deg=90, elevation_deg=(10, 90)),
)
