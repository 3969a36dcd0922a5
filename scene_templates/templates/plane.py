"""Objects over a floor, seen and lit from all around."""

from scene_templates.templates.sectors import Sector
from scene_templates.templates.template import Template

PLANE = Template(
    name="plane",
    parts=("floor",),
    cameras=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(3, 87)),
    # Below 10 degrees a light grazes the floor, and half of the emitters see it edge-on.
    lights=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(10, 90)),
)
