"""Trees: a trunk that branches, with crowns of leaf masses, tiers like a fir's, or bare.

Many closed components of very different size that hide and shade each other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, icosphere, join, sphere_faces, tube
from storage.seeds import rng_for

_GOLDEN = np.pi * (3 - np.sqrt(5))
_SIDES = (9, 6, 5, 4)
_RINGS = (9, 6, 4, 3)
"""Sides and rings of the branches of each order, from the trunk on."""
_TAPER = 0.55
"""Fraction of its radius that a branch loses towards its end."""
_TIER = np.array([[0.2, 0.12], [0.7, 0.02], [1.0, -0.1], [0.62, 0.2], [0.3, 0.55], [0.08, 0.92]])
"""Radius and height of a tier's rings: inside, rim, and the cone above."""


class _Tree:
    """Shape of a random tree; the trunk is about 1 high."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.crown = str(rng.choice(["masses", "masses", "tiers", "bare"]))
        # branches on the trunk, on each of its branches, and so on; at most three numbers
        self.children = [int(rng.integers(3, 5)), int(rng.integers(2, 4))]
        if self.crown == "bare":
            self.children = [self.children[0], 2, int(rng.integers(2, 4))]
        self.spread_rad = rng.uniform(0.5, 1.0)  # between a branch and the one it grows from
        self.shrink = rng.uniform(0.45, 0.65)  # length of a branch over that of the one below
        thickness = (0.08, 0.13) if self.crown == "bare" else (0.06, 0.1)
        self.thickness = rng.uniform(*thickness)  # radius of the trunk's foot
        # how strongly branches bend upwards: 0 is straight, negative ones droop
        self.rise = rng.uniform(-0.2, 0.6)
        self.mass = rng.uniform(0.25, 0.38)  # radius of a mass of leaves at the end of a branch
        self.tiers = int(rng.integers(3, 7))
        self.folds = int(rng.integers(6, 11))  # folds around a tier
        self.variant = int(rng.integers(1 << 31))  # picks the irregularities


def sample_tree(rng: np.random.Generator) -> Mesh:
    """Return a random tree: closed components, which are branches, and masses or tiers."""
    params = _Tree(rng)
    rng = rng_for(params.variant, "tree")
    if params.crown == "tiers":
        path = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 0.9], 6)
        trunk = tube(path, params.thickness * np.linspace(1, 0.5, 6), 10)
        return join([trunk, *_tiers(params, rng)])
    parts, ends = _branches(params, rng)
    if params.crown == "masses":
        parts += [_mass(end, params, rng) for end in ends]
    return join(parts)


@dataclass(frozen=True, kw_only=True)
class _Branch:
    """Parameters of one branch: foot [3], direction [3], length, radius and order."""

    foot: NDArray[np.float64]
    direction: NDArray[np.float64]
    length: float
    radius: float
    order: int


def _branches(
    params: _Tree, rng: np.random.Generator
) -> tuple[list[Mesh], list[NDArray[np.float64]]]:
    """Return all branches as tubes, and the ends [3] of branches without children."""
    up = np.array([0.0, 0.0, 1.0])
    waiting = [_Branch(foot=0 * up, direction=up, length=1.0, radius=params.thickness, order=0)]
    parts: list[Mesh] = []
    ends: list[NDArray[np.float64]] = []
    while waiting:
        branch = waiting.pop()
        order = branch.order
        fraction = np.linspace(0, 1, _RINGS[order])[:, None]
        bend = rng.normal(size=3) * 0.12 + params.rise * (order > 0) * up
        path = branch.foot + branch.length * (
            fraction * branch.direction + 0.5 * fraction**2 * bend
        )
        radii = branch.radius * (1 - _TAPER * fraction[:, 0])
        radii[0] *= 1.0 if order else 1.5
        parts.append(tube(path, radii, _SIDES[order]))
        if order < len(params.children):
            waiting += _children(branch, path, params, rng)
        else:
            ends.append(path[-1])
    return parts, ends


def _children(
    parent: _Branch, path: NDArray[np.float64], params: _Tree, rng: np.random.Generator
) -> list[_Branch]:
    """Return the children of a branch: along the trunk, but near the ends of other branches."""
    count = params.children[parent.order]
    trunk = parent.order == 0
    first = rng.uniform(0, 2 * np.pi)
    branches = []
    for number in range(count):
        fraction = 0.55 + 0.43 * number / max(count - 1, 1) if trunk else 0.98 - 0.05 * number
        step = fraction * (len(path) - 1)
        index = min(int(step), len(path) - 2)
        ahead = path[index + 1] - path[index]
        azimuth = (
            first + (_GOLDEN if trunk else 2 * np.pi / count) * number + rng.uniform(-0.3, 0.3)
        )
        spread = params.spread_rad * rng.uniform(0.75, 1.2)
        branches.append(
            _Branch(
                foot=path[index] + (step - index) * ahead,
                direction=_branch_direction(ahead, spread, azimuth),
                length=params.shrink * rng.uniform(0.85, 1.1) * parent.length,
                # Thinner than the parent there, which hides the foot.
                radius=0.75 * parent.radius * (1 - _TAPER * fraction),
                order=parent.order + 1,
            )
        )
    return branches


def _branch_direction(
    axis: NDArray[np.float64], spread: float, azimuth: float
) -> NDArray[np.float64]:
    """Return the direction at the angle `spread` from `axis`, rotated about it by `azimuth`."""
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    across = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(axis, side)
    return np.cos(spread) * axis + np.sin(spread) * across


def _mass(centre: NDArray[np.float64], params: _Tree, rng: np.random.Generator) -> Mesh:
    """Return one mass of leaves: a flat ball with dents, of 180 triangles or 320."""
    direction, faces = icosphere(3 if np.prod(params.children) > 10 else 4)
    waves = rng.normal(size=(6, 3)) * 4
    swing = np.sin(direction @ waves.T + rng.uniform(0, 6, 6)).mean(axis=1)
    radius = params.mass * rng.uniform(0.8, 1.25) * (1 + 0.5 * swing)
    return centre + direction * radius[:, None] * np.array([1.1, 1.1, 0.8]), faces


def _tiers(params: _Tree, rng: np.random.Generator) -> list[Mesh]:
    """Return folded cones with hanging rims, each of which reaches into the next."""
    columns = 4 * params.folds
    azimuth = 2 * np.pi * np.arange(columns) / columns
    reach = _TIER[:, :1]
    rim = _TIER[:, :1] > 0.9
    parts = []
    for number in range(params.tiers):
        fraction = number / params.tiers
        size = (1 - fraction) ** 0.8 * (0.25 + params.mass)
        height = 1.7 / params.tiers * (1.25 - 0.4 * fraction)
        fold = 0.14 * np.cos(params.folds * azimuth + rng.uniform(0, 6))
        fold += rng.normal(size=columns) * 0.02
        radius = reach * (1 + fold * reach) * size
        level = 0.3 + 1.4 * fraction
        upright = level + _TIER[:, 1:] * height - 0.12 * size * fold * rim
        grid = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), upright], axis=2)
        poles = [[0.0, 0.0, level + 0.14 * height], [0.0, 0.0, level + height]]
        faces = sphere_faces(len(_TIER), columns)
        parts.append((np.concatenate([grid.reshape(-1, 3), poles]), faces))
    return parts
