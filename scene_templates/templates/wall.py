"""A floor and one wall at +X, seen and lit from the -X half."""

from scene_templates.templates.sectors import Sector
from scene_templates.templates.template import Template

WALL = Template(
    name="wall",
    parts=("floor", "wall1"),
    # Beyond 75 degrees to the side the wall is seen edge-on.
    cameras=Sector(azimuth_deg=180, half_width_deg=75, elevation_deg=(3, 87)),
    lights=Sector(azimuth_deg=180, half_width_deg=90, elevation_deg=(10, 90)),
)
