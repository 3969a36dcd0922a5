"""Superquadrics (Barr 1981): from boxes over ellipsoids to octahedra and stars, tapered, twisted.

The polar form spreads vertices evenly for all exponents; the textbook form crowds them at the edges
of boxes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh, sphere_faces
from pipeline.objects.builtin.solids import taper_and_twist


@dataclass(frozen=True, kw_only=True)
class SuperquadricParams:
    """Shape of one superquadric."""

    exponent_profile: float
    """Roundness of the upright outline: 0.1 a box, 1 an ellipse, 2 a rhomb, above 2 a star."""
    exponent_plan: float  # roundness seen from above, likewise
    half_sizes: tuple[float, float, float]  # half extents along x, y and z, before taper and twist
    taper: float  # relative growth of width from the middle to the top, in (-1, 1)
    twist_rad: float  # turn about z from the middle to the top
    rings: int  # rings between the poles
    columns: int  # vertices of a ring; a multiple of 8 puts some on the edges of a box


def superquadric(params: SuperquadricParams) -> Mesh:
    """Return the closed surface of 2 rings columns triangles."""
    latitude = np.pi * (np.arange(1, params.rings + 1) / (params.rings + 1) - 0.5)
    longitude = 2 * np.pi * np.arange(params.columns) / params.columns
    profile = _superellipse(latitude, params.exponent_profile)
    plan = _superellipse(longitude, params.exponent_plan)
    height = np.repeat(profile[:, 1], params.columns)
    rings = (profile[:, None, :1] * plan[None, :, :]).reshape(-1, 2)
    unit = np.concatenate([np.column_stack([rings, height]), [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    positions = unit * np.array(params.half_sizes)
    taper_and_twist(positions, unit[:, 2], params.taper, params.twist_rad)
    return positions, sphere_faces(params.rings, params.columns)


def sample_superquadric(rng: np.random.Generator) -> Mesh:
    """Return a random superquadric."""
    box = rng.random() < 0.5
    exponents = np.exp(rng.uniform(np.log(0.12), np.log(0.6 if box else 3.2), 2))
    sizes = rng.uniform(0.35, 1.0, 3)
    return superquadric(
        SuperquadricParams(
            exponent_profile=float(exponents[0]),
            exponent_plan=float(exponents[1]),
            half_sizes=(float(sizes[0]), float(sizes[1]), float(sizes[2])),
            taper=float(rng.choice([0.0, rng.uniform(-0.6, 0.6)])),
            twist_rad=float(rng.choice([0.0, rng.uniform(-1.2, 1.2)])),
            rings=int(rng.integers(11, 24)),
            columns=8 * int(rng.integers(2, 6)),
        )
    )


def _superellipse(angle: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """Return the points of |x|^(2/e) + |y|^(2/e) = 1 in the directions `angle`, [N, 2]."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    power = 2 / exponent
    radius = (np.abs(cosine) ** power + np.abs(sine) ** power) ** (-1 / power)
    return np.stack([radius * cosine, radius * sine], axis=1)
