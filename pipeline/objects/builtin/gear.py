"""Gears: spur, helical and beveled, with a hub, a thinner web and a bore.

The cross section in a half plane through the axis is a closed loop; sweeping it around the axis
while the teeth push its outer corners in and out gives a torus. Sharp edges and flat faces are what
this family adds to the others.
"""

import numpy as np

from pipeline.objects.builtin.solids import Mesh, torus_faces

_TOOTH = np.array([0.0, 0.0, 0.6, 1.0, 1.0, 0.6])
"""Relative height of the outline at six equal steps of one tooth: gap, flank, tip, flank."""


def sample_gear(rng: np.random.Generator) -> Mesh:
    """Return a random gear: a closed surface of 168 triangles per tooth.

    Lengths are in radii of its tips; the web, the hub and its bore stay inside the roots.
    """
    kind = rng.choice(["spur", "helical", "bevel"])
    half = rng.uniform(0.08, 0.35)  # half thickness of the rim
    teeth = int(rng.integers(7, 19))
    tooth_depth = rng.uniform(0.12, 0.25)  # from tip to root
    cut = rng.uniform(0.01, 0.04)  # how far the edges of the teeth are cut back
    bore = rng.uniform(0.08, 0.2)  # radius of the hole
    hub = bore + rng.uniform(0.06, 0.14)  # radius of the ring around the bore
    hub_z = half * rng.uniform(0.9, 1.8)  # half height of that ring
    rim = 1 - tooth_depth - rng.uniform(0.14, 0.2)  # inner radius of the ring below the roots
    web_z = half * rng.uniform(0.25, 0.8)  # half height between hub and rim
    # Turn of the teeth from the middle to the top, and relative growth of the outline.
    helix_rad = rng.uniform(-0.35, 0.35) if kind == "helical" else 0.0
    cone = rng.uniform(-0.15, 0.15) if kind == "bevel" else 0.0
    upper = [(1.0, half - cut), (1 - cut, half), (rim, half), (rim, web_z)]
    upper += [(hub, web_z), (hub, hub_z), (bore, hub_z)]
    section = np.array(upper + [(radius, -height) for radius, height in reversed(upper)])
    toothed = np.isin(np.arange(len(section)), (0, 1, 12, 13))
    rows = len(_TOOTH) * teeth
    drop = tooth_depth * (1 - np.tile(_TOOTH, teeth))
    level = section[:, 1] / half
    angle = 2 * np.pi * np.arange(rows)[:, None] / rows + helix_rad * level * toothed
    radius = section[:, 0] - drop[:, None] * toothed
    radius = np.where(toothed, radius * (1 + cone * level), radius)
    height = np.broadcast_to(section[:, 1], radius.shape)
    grid = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    return grid.reshape(-1, 3), torus_faces(rows, len(section))
