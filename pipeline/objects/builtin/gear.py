"""Gears: spur, helical and beveled, with a hub, a thinner web and a bore.

The cross section in a half plane through the axis is a closed loop; sweeping it around the axis
while the teeth push its outer corners in and out gives a torus. Sharp edges and flat faces are what
this family adds to the others.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.objects.builtin.grids import Mesh, torus_faces

_TOOTH = np.array([0.0, 0.0, 0.6, 1.0, 1.0, 0.6])
"""Relative height of the outline at six equal steps of one tooth: gap, flank, tip, flank."""


@dataclass(frozen=True, kw_only=True)
class GearParams:
    """Shape of one gear; lengths are in radii of its tips."""

    teeth: int  # number of teeth
    tooth_depth: float  # from tip to root, in (0, 0.4)
    half_thickness: float  # of the rim
    chamfer: float  # how far the edges of the teeth are cut back
    bore: float
    """Radius of the hole; with `hub_width` and `rim_width` it must stay inside the roots."""
    hub_width: float  # width of the ring around the bore
    hub_height: float  # half height of that ring, over `half_thickness`
    rim_width: float  # width of the ring below the roots
    web_height: float  # half height between hub and rim, over `half_thickness`
    helix_rad: float  # turn of the teeth from the middle to the top
    cone: float  # relative growth of the outline from the middle to the top: a bevel gear


def gear(params: GearParams) -> Mesh:
    """Return the closed surface of 168 triangles per tooth."""
    root = 1 - params.tooth_depth
    hub = params.bore + params.hub_width
    rim = root - params.rim_width
    half = params.half_thickness
    cut = params.chamfer
    hub_z = half * params.hub_height
    web_z = half * params.web_height
    upper = [(1.0, half - cut), (1 - cut, half), (rim, half), (rim, web_z)]
    upper += [(hub, web_z), (hub, hub_z), (params.bore, hub_z)]
    section = np.array(upper + [(radius, -height) for radius, height in reversed(upper)])
    toothed = np.isin(np.arange(len(section)), (0, 1, 12, 13))
    rows = len(_TOOTH) * params.teeth
    drop = params.tooth_depth * (1 - np.tile(_TOOTH, params.teeth))
    level = section[:, 1] / half
    angle = 2 * np.pi * np.arange(rows)[:, None] / rows + params.helix_rad * level * toothed
    radius = section[:, 0] - drop[:, None] * toothed
    radius = np.where(toothed, radius * (1 + params.cone * level), radius)
    height = np.broadcast_to(section[:, 1], radius.shape)
    grid = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    return grid.reshape(-1, 3), torus_faces(rows, len(section))


def sample_gear(rng: np.random.Generator) -> Mesh:
    """Return a random gear."""
    kind = rng.choice(["spur", "helical", "bevel"])
    half = float(rng.uniform(0.08, 0.35))
    return gear(
        GearParams(
            teeth=int(rng.integers(7, 19)),
            tooth_depth=float(rng.uniform(0.12, 0.25)),
            half_thickness=half,
            chamfer=float(rng.uniform(0.01, 0.04)),
            bore=float(rng.uniform(0.08, 0.2)),
            hub_width=float(rng.uniform(0.06, 0.14)),
            hub_height=float(rng.uniform(0.9, 1.8)),
            rim_width=float(rng.uniform(0.14, 0.2)),
            web_height=float(rng.uniform(0.25, 0.8)),
            helix_rad=float(rng.uniform(-0.35, 0.35)) if kind == "helical" else 0.0,
            cone=float(rng.uniform(-0.15, 0.15)) if kind == "bevel" else 0.0,
        )
    )
