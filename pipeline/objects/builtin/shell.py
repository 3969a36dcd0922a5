"""Sea shells (after Raup 1966): a growing tube on a spiral about an axis, open at its mouth.

Smooth, with a visible inside, and detail that shrinks towards the tip.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, sphere_faces


class _Shell:
    """Shape of a random shell; lengths are in distances of the mouth's center from the axis."""

    def __init__(self, rng: np.random.Generator) -> None:
        kind = str(rng.choice(["nautilus", "snail", "turret", "whelk"]))
        growth, drop, tube, stretch, turns = {
            "nautilus": ((2.2, 3.2), (0.0, 0.15), (0.6, 0.8), (0.8, 1.1), (2.2, 3.0)),
            "snail": ((1.6, 2.1), (0.8, 1.5), (0.75, 0.95), (0.9, 1.2), (3.0, 4.2)),
            "turret": ((1.22, 1.45), (3.0, 7.0), (0.8, 1.1), (0.9, 1.4), (5.0, 8.0)),
            "whelk": ((1.5, 1.9), (1.8, 2.8), (0.9, 1.1), (1.4, 2.0), (3.5, 4.8)),
        }[kind]
        self.turns = rng.uniform(*turns)  # about the axis
        self.cords = int(rng.choice([0, 0, 5, 7]))  # ridges along the tube, around its section
        # vertices of a ring
        self.columns = int(rng.integers(14, 19)) if not self.cords else 3 * self.cords
        # At most about 5500 triangles, whatever the random parameters.
        most = int(2700 / (self.columns * (self.turns + 0.5)))
        self.growth = rng.uniform(*growth)  # size over that one turn before; above 1
        # how far the mouth lies below the tip: 0 is a flat spiral, 4 a turret
        self.drop = rng.uniform(*drop)
        self.tube = rng.uniform(*tube)  # radius of the mouth across; about 1 fills the middle
        self.stretch = rng.uniform(*stretch)  # height of the mouth over its width
        self.ribs = int(rng.choice([0, 6, 9, 12]))  # ribs across the tube per turn
        self.rib_height = rng.uniform(0.1, 0.28)  # in radii of the tube
        self.cord_height = rng.uniform(0.06, 0.14)  # in radii of the tube
        # how much higher the ribs are at the shoulder than elsewhere
        self.spines = float(rng.choice([0.0, 0.0, rng.uniform(1.0, 2.5)]))
        self.wall = rng.uniform(0.06, 0.14)  # thickness at the mouth, in radii of the tube
        # rotation of the axis from upright: pi / 2 is a shell that lies on the ground
        self.lean_rad = float(rng.choice([0.0, rng.uniform(0.8, 1.7), rng.uniform(1.7, 2.4)]))
        self.rings_per_turn = min(int(rng.integers(22, 37)), most)


def sample_shell(rng: np.random.Generator) -> Mesh:
    """Return a random shell: outside, lip, and the inside of the last half turn, closed.

    Turns lie on each other as in nature, so the surface meets itself where they touch.
    """
    params = _Shell(rng)
    rings = int(params.turns * params.rings_per_turn)
    inside = params.rings_per_turn // 2
    winding = np.linspace(-params.turns, 0, rings)
    outer = _rings(winding, 1 + _relief(winding, params), params)
    # The lip's two edges lie on one ring of angles, the mouth's.
    back = winding[: -inside - 1 : -1]
    fade = np.linspace(1 - params.wall, 0.5 * (1 - params.wall), inside)[:, None]
    inner = _rings(back, np.broadcast_to(fade, (inside, params.columns)), params)
    poles = np.stack([outer[0].mean(axis=0), inner[-1].mean(axis=0)])
    grid = np.concatenate([outer, inner]).reshape(-1, 3)
    cosine = np.cos(params.lean_rad)
    sine = np.sin(params.lean_rad)
    lean = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    faces = sphere_faces(rings + inside, params.columns)
    return np.concatenate([grid, poles]) @ lean.T, faces


def _relief(winding: NDArray[np.float64], params: _Shell) -> NDArray[np.float64]:
    """Return the height [rings, columns] of ribs, spines and cords, at least 0."""
    around = 2 * np.pi * np.arange(params.columns) / params.columns
    relief = np.zeros((len(winding), params.columns))
    if params.ribs:
        crest = (0.5 + 0.5 * np.cos(2 * np.pi * params.ribs * winding)) ** 2
        shoulder = np.maximum(np.cos(around + 0.7), 0) ** 6
        relief += params.rib_height * crest[:, None] * (1 + params.spines * shoulder)
    if params.cords:
        relief += params.cord_height * (0.5 + 0.5 * np.cos(params.cords * around))
    return relief


def _rings(
    winding: NDArray[np.float64], radius: NDArray[np.float64], params: _Shell
) -> NDArray[np.float64]:
    """Return points [rings, columns, 3] of the tube at `winding` [rings]; 0 is the mouth."""
    angle = 2 * np.pi * winding
    size = params.growth**winding
    around = 2 * np.pi * np.arange(params.columns) / params.columns
    outwards = 1 + params.tube * radius * np.cos(around)
    height = -params.drop - params.tube * params.stretch * radius * np.sin(around)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    grid = np.concatenate([outwards[..., None] * flat[:, None], height[..., None]], axis=2)
    return grid * size[:, None, None]
