"""Tubes along torus knots: one closed strand, with ribs that wind around it.

The thickness has a limit at which strands would meet or bends would fold.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, torus_faces

_KNOTS = ((1, 0), (2, 3), (3, 2), (1, 3), (2, 5), (3, 4), (1, 5), (4, 3), (5, 2), (1, 4))
"""Coprime windings around the axis and through the hole; (1, 0) is a plain ring."""


def torus_knot(
    *,
    windings: tuple[int, int],
    minor_radius: float,
    fill: float,
    segments: int,
    sides: int,
    ribs: int = 0,
    rib_depth: float = 0.0,
    rib_turns: int = 0,
    flatten: float = 1.0,
) -> Mesh:
    """Return the closed surface of 2 segments sides triangles.

    Args:
        windings: windings of the strand around the axis and through the hole; coprime.
        minor_radius: of the torus that the strand lies on, whose major radius is 1; in (0, 1).
        fill: thickness as a share of the thickest tube that neither meets itself nor folds.
        segments: vertices along the strand.
        sides: vertices around it; a multiple of the ribs makes them all alike.
        ribs: ridges of the cross section; 0 is round.
        rib_depth: depth of the ridges as a share of the tube's radius, in [0, 1).
        rib_turns: how often the ridges wind around the strand.
        flatten: width of the cross section across the torus, over its height; at most 1.
    """
    along = 2 * np.pi * np.arange(segments) / segments
    centre, outward = _strand(along, windings, minor_radius)
    tangent = np.roll(centre, -1, axis=0) - np.roll(centre, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(outward, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(tangent, across)
    around = 2 * np.pi * np.arange(sides) / sides
    phase = ribs * (around[None, :] + rib_turns * along[:, None])
    radius = 1 + (rib_depth * (0.5 * np.cos(phase) - 0.5) if ribs else 0 * phase)
    radius *= fill * _largest_radius(windings, minor_radius)
    offset = (radius * np.cos(around))[..., None] * up[:, None] + (
        flatten * radius * np.sin(around)
    )[..., None] * across[:, None]
    return (centre[:, None] + offset).reshape(-1, 3), torus_faces(segments, sides)


def sample_torus_knot(rng: np.random.Generator) -> Mesh:
    """Return a random knot."""
    windings = _KNOTS[rng.integers(len(_KNOTS))]
    ribs = int(rng.choice([0, 3, 4, 5]))
    return torus_knot(
        windings=windings,
        minor_radius=float(rng.uniform(0.3, 0.55)),
        fill=float(rng.uniform(0.45, 0.9)),
        ribs=ribs,
        rib_depth=float(rng.uniform(0.2, 0.6)),
        rib_turns=int(rng.integers(-3, 4)),
        flatten=float(rng.uniform(0.5, 1.0)),
        segments=int(rng.integers(64, 97)) + 8 * sum(windings),
        sides=12 - 12 % max(ribs, 1),
    )


def _strand(
    along: NDArray[np.float64], windings: tuple[int, int], minor_radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points of the strand and the normals of its torus there, [N, 3] each."""
    around_axis, through_hole = windings
    azimuth = around_axis * along
    tube = through_hole * along
    radial = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    upright = np.array([0.0, 0.0, 1.0])
    normal = np.cos(tube)[:, None] * radial + np.sin(tube)[:, None] * upright
    return radial + minor_radius * normal, normal


def _largest_radius(windings: tuple[int, int], minor_radius: float, points: int = 512) -> float:
    """Return the radius at which strands meet or a bend folds, from `points` of the strand."""
    centre, _ = _strand(2 * np.pi * np.arange(points) / points, windings, minor_radius)
    step = np.roll(centre, -1, axis=0) - centre
    length = np.linalg.norm(step, axis=1)
    change = np.linalg.norm(np.roll(step, -1, axis=0) - step, axis=1)
    bend = float((length**2 / np.maximum(change, 1e-12)).min())
    chord = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    position = np.cumsum(length)
    arc = np.abs(position[:, None] - position[None])
    arc = np.minimum(arc, position[-1] - arc)
    other_strand = chord < 0.5 * arc
    gap = float(chord[other_strand].min()) if other_strand.any() else np.inf
    return min(bend, 0.5 * gap)
