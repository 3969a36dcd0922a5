"""A layout of your own: a corridor, of a floor and two walls that face each other.

    trilight generate tiny --extend template.py --set scenes.families=corridor --out data/corridor

A template is data: which sides of the room it has, from where it is seen, and from where it is lit.
A family draws from it: how the room is placed, how many objects of which size it holds.
"""

from trilight.extend import FAMILIES, TEMPLATES, Family, Sector, SharedRoom, Template

TEMPLATES.register(
    "corridor",
    Template(
        name="corridor",
        # of floor, wall0 (+Y), wall1 (+X) and wall2 (-X); the room is open at -Y and at the top
        parts=("floor", "wall1", "wall2"),
        # azimuth 270 is -Y: we look into the corridor, and never at the back of a wall
        cameras=Sector(azimuth_deg=270, half_width_deg=25, elevation_deg=(3, 60)),
        lights=Sector(azimuth_deg=270, half_width_deg=60, elevation_deg=(20, 90)),
    ),
)


def corridor() -> Family:
    """Return a longer and narrower room than the others have, with one or two objects in it."""
    return Family(
        name="corridor",
        template="corridor",
        shell=SharedRoom(scale=(0.8, 1.1), square_share=1.0),
        num_objects=(1, 2),
        object_scale=(0.6, 1.2),
    )


FAMILIES.register("corridor", corridor)
