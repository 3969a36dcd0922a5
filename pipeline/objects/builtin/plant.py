"""Potted plants: leaves are open sheets, curved and folded, on stems in a pot.

The one family that is not closed: most hand-made models have two-sided sheets for thin objects, so
renderers must handle them.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, join, lathe, sheet_faces, tube


@dataclass(frozen=True, kw_only=True)
class LeafParams:
    """Shape of one leaf; lengths are fractions of the leaf's length."""

    length: float  # from base to tip, along the midrib
    width: float  # largest width
    widest: float  # where along the midrib that is, in (0, 1)
    base: float  # width of the base, as a share of the largest
    arch_rad: float  # how far the midrib turns downwards from base to tip
    fold_rad: float  # how far each half is raised from the plane of the midrib
    teeth: int  # notches along each edge; 0 is a smooth one
    tooth_depth: float  # depth of the notches as a share of the width there, in [0, 1)
    rows: int  # rows of vertices from base to tip; at least twice the teeth


def leaf_sheet(leaf: LeafParams, rise_rad: float) -> Mesh:
    """Return one leaf: an open sheet of 8 (rows - 1) + 4 triangles from the origin towards x.

    The sheet faces upwards and ends in a point.
    """
    along = np.arange(leaf.rows) / leaf.rows
    across = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    slope = rise_rad - leaf.arch_rad * np.append(along, 1.0)
    steps = np.stack([np.cos(slope), 0 * slope, np.sin(slope)], axis=1) * leaf.length / leaf.rows
    rib = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
    half = 0.5 * leaf.length * leaf.width * _width(along, leaf)
    over = np.stack([-np.sin(slope), 0 * slope, np.cos(slope)], axis=1)[:-1]
    out = half[:, None] * across
    lift = np.abs(out) * np.sin(leaf.fold_rad)
    grid = rib[:-1, None] + lift[..., None] * over[:, None]
    grid[..., 1] += out * np.cos(leaf.fold_rad)
    last = (leaf.rows - 1) * 5 + np.arange(4)
    tip = np.stack([last + 1, last, np.full(4, leaf.rows * 5)], axis=1)
    faces = np.concatenate([sheet_faces(leaf.rows, 5)[:, ::-1], tip])
    return np.concatenate([grid.reshape(-1, 3), rib[-1:]]), faces


def sample_plant(rng: np.random.Generator) -> Mesh:
    """Return a random plant: a closed pot, closed stems, and one open sheet per leaf.

    The rim of its pot has a radius of about 0.3.
    """
    kind = str(rng.choice(["agave", "grass", "palm", "broad", "herb"]))
    leaf, numbers, stems, stalks, rises = {
        "agave": ((0.75, 0.24, 0.4, 0.7), (14, 27), (0.0, 0.0), (0.0, 0.0), (1.4, 0.3)),
        "grass": ((1.1, 0.07, 0.4, 0.7), (28, 45), (0.0, 0.0), (0.0, 0.0), (1.5, 0.8)),
        "palm": ((1.0, 0.34, 0.45, 0.2), (9, 15), (0.7, 1.5), (0.0, 0.0), (1.2, 0.2)),
        "broad": ((0.6, 0.75, 0.35, 0.3), (7, 14), (0.0, 0.5), (0.35, 0.7), (1.3, 0.6)),
        "herb": ((0.4, 0.45, 0.45, 0.1), (16, 29), (0.6, 1.1), (0.03, 0.1), (0.9, 0.1)),
    }[kind]
    length, width, widest, base = leaf
    teeth = {"palm": 14, "broad": int(rng.choice([0, 4]))}.get(kind, 0)
    shape = LeafParams(
        length=float(length * rng.uniform(0.8, 1.25)),
        width=float(width * rng.uniform(0.8, 1.25)),
        widest=widest,
        base=base,
        arch_rad=float(rng.uniform(0.5, 1.1) if kind in ("agave", "broad") else rng.uniform(1, 2)),
        fold_rad=float(rng.uniform(0.15, 0.6)),
        teeth=teeth,
        tooth_depth=0.75 if kind == "palm" else 0.4,
        rows=max(2 * teeth, int(rng.integers(9, 13))),
    )
    leaves = int(rng.integers(*numbers))
    stem = rng.uniform(*stems)  # height of the stem above the pot; 0 is a rosette
    stalk = rng.uniform(*stalks)  # length of each leaf's own stalk; 0 is none
    steepest_rad = rises[0] + rng.uniform(-0.1, 0.1)  # rise of the uppermost leaf
    flattest_rad = rises[1] + rng.uniform(-0.2, 0.2)  # rise of the lowest leaf
    smallest = rng.uniform(0.4, 0.8)  # size of the uppermost leaf, as a share of the largest
    pot_height = rng.uniform(0.22, 0.42)
    parts = [_pot(pot_height, pot_foot=rng.uniform(0.55, 1.0))]
    top = pot_height - 0.03
    if stem:
        bend = np.linspace(0, 1, 10)
        path = np.stack([0.1 * stem * bend**2, 0 * bend, stem * bend], axis=1)
        path[:, 2] += top - 0.02
        parts.append(tube(path, 0.045 - 0.02 * bend, 8))
    for number in range(leaves):
        fraction = (number + 0.5) / leaves
        azimuth = number * np.pi * (3 - np.sqrt(5))
        rise = flattest_rad + fraction * (steepest_rad - flattest_rad)
        level = (0.35 + 0.65 * fraction) * stem
        foot = np.array([0.1 * level**2 / stem if stem else 0.0, 0.0, top + level])
        size = 1 - fraction * (1 - smallest)
        scaled = replace(shape, length=shape.length * size)
        parts += _leaf_on_stalk(scaled, stalk * size, foot, azimuth, rise)
    return join(parts)


def _width(along: NDArray[np.float64], leaf: LeafParams) -> NDArray[np.float64]:
    """Return half widths [N] over the largest: a smooth rise, a smooth fall, and notches."""
    rising = leaf.base + (1 - leaf.base) * np.sin(0.5 * np.pi * along / leaf.widest)
    falling = np.sin(0.5 * np.pi * (1 - along) / (1 - leaf.widest)) ** 0.8
    width = np.where(along < leaf.widest, rising, falling)
    if leaf.teeth:
        width = width * (1 - leaf.tooth_depth * (np.arange(len(along)) % 2))
    return width


def _leaf_on_stalk(
    leaf: LeafParams, stalk: float, foot: NDArray[np.float64], azimuth: float, rise: float
) -> list[Mesh]:
    """Return a leaf that starts at `foot` or at the end of its stalk, and the stalk if any."""
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    direction = np.cos(rise) * ahead + np.array([0.0, 0.0, np.sin(rise)])
    # Without a stalk it begins just inside the stem or the earth.
    start = foot + (direction * stalk if stalk else 0.025 * ahead - [0.0, 0.0, 0.01])
    # A leaf at the end of a stalk hangs from it, the others go on in their own direction.
    positions, faces = leaf_sheet(leaf, rise - 0.5 if stalk > 0.2 else rise)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    turned = positions @ np.stack([ahead, aside, [0.0, 0.0, 1.0]])
    parts: list[Mesh] = [(turned + start, faces)]
    if stalk:
        path = foot + np.linspace(-0.02, stalk + 0.02, 5)[:, None] * direction
        parts.append(tube(path, np.linspace(0.014, 0.008, 5) * (1 + stalk), 5))
    return parts


def _pot(height: float, pot_foot: float) -> Mesh:
    """Return a pot with a rim, filled with earth to just below it.

    `pot_foot` is the radius of its foot over that of its rim.
    """
    foot = 0.28 * pot_foot
    outline = [(0.9 * foot, 0.0), (foot, 0.02), (0.28, height - 0.1), (0.31, height - 0.09)]
    outline += [(0.31, height), (0.28, height), (0.27, height - 0.03), (0.14, height - 0.025)]
    return lathe(outline, 20)
