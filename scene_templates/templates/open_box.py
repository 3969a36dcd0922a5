"""A floor and three walls without a ceiling, seen and lit through the open front (-Y) and top."""

from scene_templates.templates.sectors import Sector
from scene_templates.templates.template import Template

OPEN_BOX = Template(
    name="open_box",
    parts=("floor", "wall0", "wall1", "wall2"),
    # Farther to the side, a camera would look at the back of the nearer wall.
    cameras=Sector(azimuth_deg=270, half_width_deg=30, elevation_deg=(3, 87)),
    # Lower, the side walls would keep an outer light from the floor.
    lights=Sector(azimuth_deg=270, half_width_deg=75, elevation_deg=(15, 90)),
)
