"""Superquadrics (Barr 1981): from boxes over ellipsoids to octahedra and stars, tapered, twisted.

The polar form spreads vertices evenly for all exponents; the textbook form crowds them at the edges
of boxes.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, sphere_faces, taper_and_twist


def superquadric(
    *,
    exponent_profile: float,
    exponent_plan: float,
    half_sizes: tuple[float, float, float],
    rings: int,
    columns: int,
    taper: float = 0.0,
    twist_rad: float = 0.0,
) -> Mesh:
    """Return the closed surface of 2 rings columns triangles.

    Args:
        exponent_profile: roundness of the upright outline: 0.1 a box, 1 an ellipse, 2 a rhomb,
            above 2 a star.
        exponent_plan: roundness seen from above, likewise.
        half_sizes: half extents along x, y and z, before taper and twist.
        rings: rings between the poles.
        columns: vertices of a ring; a multiple of 8 puts some on the edges of a box.
        taper: as in `taper_and_twist`.
        twist_rad: as in `taper_and_twist`.
    """
    latitude = np.pi * (np.arange(1, rings + 1) / (rings + 1) - 0.5)
    longitude = 2 * np.pi * np.arange(columns) / columns
    profile = _superellipse(latitude, exponent_profile)
    plan = _superellipse(longitude, exponent_plan)
    height = np.repeat(profile[:, 1], columns)
    flat = (profile[:, None, :1] * plan[None, :, :]).reshape(-1, 2)
    unit = np.concatenate([np.column_stack([flat, height]), [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    positions = unit * np.array(half_sizes)
    taper_and_twist(positions, unit[:, 2], taper, twist_rad)
    return positions, sphere_faces(rings, columns)


def sample_superquadric(rng: np.random.Generator) -> Mesh:
    """Return a random superquadric."""
    box = rng.random() < 0.5
    exponents = np.exp(rng.uniform(np.log(0.12), np.log(0.6 if box else 3.2), 2))
    sizes = rng.uniform(0.35, 1.0, 3)
    return superquadric(
        exponent_profile=float(exponents[0]),
        exponent_plan=float(exponents[1]),
        half_sizes=(float(sizes[0]), float(sizes[1]), float(sizes[2])),
        taper=float(rng.choice([0.0, rng.uniform(-0.6, 0.6)])),
        twist_rad=float(rng.choice([0.0, rng.uniform(-1.2, 1.2)])),
        rings=int(rng.integers(11, 24)),
        columns=8 * int(rng.integers(2, 6)),
    )


def _superellipse(angle: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """Return the points of |x|^(2/e) + |y|^(2/e) = 1 in the directions `angle`, [N, 2]."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    power = 2 / exponent
    radius = (np.abs(cosine) ** power + np.abs(sine) ** power) ** (-1 / power)
    return np.stack([radius * cosine, radius * sine], axis=1)
