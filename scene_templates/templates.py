"""The four layouts as data: which walls they have, and from where they are seen and lit."""

from scene_templates.sectors import Sector
from scene_templates.template import Template
from storage.registry import Registry

PLANE = Template(
    name="plane",
    parts=("floor",),
    cameras=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(3, 87)),
    # Below 10 degrees a light grazes the floor, and half of the emitters see it edge-on.
    lights=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(10, 90)),
)
"""Objects over a floor, seen and lit from all around."""

WALL = Template(
    name="wall",
    parts=("floor", "wall1"),
    # Beyond 75 degrees to the side the wall is seen edge-on.
    cameras=Sector(azimuth_deg=180, half_width_deg=75, elevation_deg=(3, 87)),
    lights=Sector(azimuth_deg=180, half_width_deg=90, elevation_deg=(10, 90)),
)
"""A floor and one wall at +X, seen and lit from the -X half."""

CORNER = Template(
    name="corner",
    parts=("floor", "wall0", "wall1"),
    cameras=Sector(azimuth_deg=225, half_width_deg=45, elevation_deg=(3, 87)),
    # A half-turn, as published: the outer lights graze one wall from behind and shine over it.
    lights=Sector(azimuth_deg=225, half_width_deg=90, elevation_deg=(10, 90)),
)
"""A floor and two walls at +X and +Y, seen from the quarter opposite them."""

OPEN_BOX = Template(
    name="open_box",
    parts=("floor", "wall0", "wall1", "wall2"),
    # Farther to the side, a camera would look at the back of the nearer wall.
    cameras=Sector(azimuth_deg=270, half_width_deg=30, elevation_deg=(3, 87)),
    # Lower, the side walls would keep an outer light from the floor.
    lights=Sector(azimuth_deg=270, half_width_deg=75, elevation_deg=(15, 90)),
)
"""A floor and three walls without a ceiling, seen and lit through the open front (-Y) and top."""

TEMPLATES: Registry[Template] = Registry(
    "template",
    Template,
    {template.name: template for template in (PLANE, WALL, CORNER, OPEN_BOX)},
    decides=("data",),
)
"""Every name that `Family.template` admits."""
