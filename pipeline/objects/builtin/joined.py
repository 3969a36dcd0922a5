"""Families of objects that are joined of many components: furniture, trees and potted plants.

- Furniture is joined from beveled boards and legs: flat faces, as in most hand-made models.
- Trees are a trunk that branches, with crowns of leaf masses, tiers like a fir's, or bare: closed
  components of very different size that hide and shade each other.
- Leaves of plants are open sheets, curved and folded, on stems in a pot. This is the one family
  that is not closed: most hand-made models have two-sided sheets for thin objects, so renderers
  must handle them.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import (
    Mesh,
    beam,
    box,
    icosphere,
    join,
    lathe,
    sheet_faces,
    sphere_faces,
    tube,
)
from storage.seeds import rng_for


class _Furniture:
    """Shape of a random piece of furniture; lengths are roughly in meters."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.kind = str(rng.choice(["table", "round", "chair", "chair", "shelf"]))
        width, depth, height = {
            "table": ((0.7, 1.8), (0.5, 0.9), (0.4, 0.8)),
            "round": ((0.35, 1.1), (0.3, 0.4), (0.42, 0.8)),
            "chair": ((0.4, 0.55), (0.4, 0.5), (0.4, 0.5)),
            "shelf": ((0.6, 1.2), (0.22, 0.36), (0.8, 1.8)),
        }[self.kind]
        self.boards = rng.integers(2, 6)  # boards of a shelf between its top and bottom
        books = np.column_stack([rng.uniform(0.02, 0.06, 60), rng.uniform(0.5, 0.92, 60)])
        self.width = rng.uniform(*width)  # along x
        self.depth = rng.uniform(*depth)  # along y; unused for round tops
        self.height = rng.uniform(*height)  # of the top, the seat or the shelf
        self.board = rng.uniform(0.025, 0.06)  # thickness of boards
        self.leg = rng.uniform(0.018, 0.035)  # half thickness of legs at the top
        self.leg_style = str(rng.choice(["square", "tapered", "turned"]))
        # how far feet stand outside the tops of their legs
        self.splay = float(rng.choice([0.0, rng.uniform(0.02, 0.09)]))
        self.stretchers = rng.random() < 0.5  # whether bars join the legs near the floor
        self.back = rng.uniform(0.35, 0.65)  # height of a chair's back over its seat
        # boards of a chair's back or of a bench-like top
        self.slats = int(rng.integers(3, 8))
        self.level_slats = rng.random() < 0.4  # whether the back's boards lie level
        # thickness and height of the books on a shelf, from its lowest board upwards
        self.books = books[: int(rng.integers(15, 60))]


def sample_furniture(rng: np.random.Generator) -> Mesh:
    """Return a random piece of furniture: closed components that reach into each other.

    The kinds are a table, `round` (a round top), a chair (a seat with a back) and a shelf.
    """
    params = _Furniture(rng)
    if params.kind == "shelf":
        return join(_shelf(params))
    back = _back(params) if params.kind == "chair" else []
    return join([*_top(params), *_legs(params), *back])


def _top(params: _Furniture) -> list[Mesh]:
    """Return the top or seat: a disk, a board, or slats on two battens."""
    high = params.height
    half = params.board / 2
    if params.kind == "round":
        radius = params.width / 2
        cut = 0.3 * params.board
        outline = [(radius - cut, -half), (radius, cut - half)]
        outline += [(r, -z) for r, z in reversed(outline)]
        positions, faces = lathe(outline, 32)
        return [(positions + np.array([0, 0, high - half]), faces)]
    if params.kind == "chair":
        size = [params.width / 2, params.depth / 2, half]
        return [box([0, 0, high - half], size, 0.25 * params.board)]
    step = params.depth / params.slats
    parts = [
        box(
            [0, (number + 0.5) * step - params.depth / 2, high - half],
            [params.width / 2, 0.42 * step, half],
            0.15 * half,
        )
        for number in range(params.slats)
    ]
    for side in (-1, 1):
        center = [side * 0.3 * params.width, 0, high - 1.9 * half]
        parts.append(box(center, [0.02, 0.45 * params.depth, half], 0.15 * half))
    return parts


def _legs(params: _Furniture) -> list[Mesh]:
    """Return four legs, the aprons under the top, and stretchers if any."""
    inset = 1.3 * params.leg + 0.6 * params.splay
    x = params.width / 2 - inset
    y = params.depth / 2 - inset
    if params.kind == "round":
        x = y = 0.62 * params.width / 2
    feet = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    high = params.height - 0.5 * params.board
    tops = np.column_stack([feet, np.full(4, high)])
    ends = np.column_stack([feet + np.sign(feet) * params.splay, np.zeros(4)])
    parts = [_leg(top, end, params) for top, end in zip(tops, ends, strict=True)]
    levels = [(params.height - params.board - 0.03, 0.01, 0.035)]
    if params.stretchers:
        levels.append((0.22 * params.height, 0.011, 0.014))
    for number in range(4):
        other = (number + 1) % 4
        for level, thick, tall in levels:
            fraction = level / high
            start, end = (ends[n] + fraction * (tops[n] - ends[n]) for n in (number, other))
            # Bars of one level cross inside the legs; unequal heights keep their faces apart.
            lift = np.array([0, 0, 0.004 * (number % 2)])
            parts.append(beam(start + lift, end + lift, (thick, tall), 0.003))
    return parts


_TURNED = (
    (0.0, 0.5), (0.02, 0.6), (0.05, 0.45), (0.3, 0.75), (0.48, 1.0), (0.56, 0.55), (0.6, 0.85),
    (0.64, 0.85), (0.68, 0.55), (0.76, 0.95), (0.8, 1.1), (1.0, 1.1),
)  # fmt: skip
"""Height and radius of a turned leg from foot to top, in its height and thickness."""


def _leg(top: NDArray[np.float64], foot: NDArray[np.float64], params: _Furniture) -> Mesh:
    """Return one leg between two points."""
    if params.leg_style == "turned":
        height = top[2] - foot[2]
        upright, faces = lathe([(r * params.leg, z * height) for z, r in _TURNED], 10)
        lean = (top - foot) / height
        lean[2] = 0.0
        return upright + foot + upright[:, 2:] * lean, faces
    taper = 0.5 if params.leg_style == "tapered" else 1.0
    return beam(top, foot, (params.leg, params.leg), 0.15 * params.leg, taper)


def _back(params: _Furniture) -> list[Mesh]:
    """Return two posts that lean back, and boards between them."""
    x = params.width / 2 - 1.4 * params.leg
    y = params.depth / 2 - 1.4 * params.leg
    low = params.height - 0.6 * params.board
    lean = 0.2 * params.back
    foot = np.array([x, y, low])
    head = np.array([x, y + lean, params.height + params.back])
    mirror = np.array([-1, 1, 1])
    post = (0.8 * params.leg, 0.8 * params.leg)
    parts = [beam(foot * side, head * side, post, 0.12 * params.leg) for side in (mirror, 1)]
    levels = np.linspace(0.3, 0.93, params.slats) if params.level_slats else np.array([0.93])
    tall = min(0.1, 0.2 / len(levels)) * params.back
    for fraction in levels:
        end = foot + fraction * (head - foot)
        parts.append(beam(end * mirror, end, (0.5 * params.leg, tall), 0.003))
    if params.level_slats:
        return parts
    bottom = foot + 0.02 * (head - foot)
    rail = foot + 0.93 * (head - foot)
    for number in range(params.slats):
        scale = np.array([(number + 1) / (params.slats + 1) * 2 - 1, 1, 1])
        wide = min(0.03, 0.6 * x / params.slats)
        parts.append(beam(bottom * scale, rail * scale, (wide, 0.25 * params.leg), 0.002))
    return parts


def _shelf(params: _Furniture) -> list[Mesh]:
    """Return two sides, boards between them, and books."""
    width = params.width / 2
    depth = params.depth / 2
    half = params.board / 2
    cut = 0.1 * params.board
    parts = [
        box([side * width, 0, params.height / 2], [half, depth, params.height / 2], cut)
        for side in (-1, 1)
    ]
    levels = np.linspace(0.06, params.height - half - 0.01, params.boards + 2)
    plank = [width, depth - 0.006, 0.8 * half]
    parts += [box([0, 0, level], plank, 0.8 * cut) for level in levels]
    bay = levels[1] - levels[0] - 2 * half
    offset = -width + half + 0.01
    storey = 0
    for thick, tall in params.books:
        if offset + thick > width - half - 0.01:
            offset = -width + half + 0.01
            storey += 1
        if storey > params.boards:
            break
        size = [thick / 2, 0.5 * depth * (0.8 + 0.4 * tall), bay * tall / 2]
        floor = levels[storey] + 0.8 * half - 0.003
        parts.append(box([offset + thick / 2, 0.05 * depth, floor + size[2]], size, 0.002))
        offset += thick + 0.003
    return parts


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


def _branches(
    params: _Tree, rng: np.random.Generator
) -> tuple[list[Mesh], list[NDArray[np.float64]]]:
    """Return all branches as tubes, and the ends [3] of branches without children.

    Children grow along the trunk, but near the ends of other branches.
    """
    up = np.array([0.0, 0.0, 1.0])
    parts: list[Mesh] = []
    ends: list[NDArray[np.float64]] = []

    def grow(
        foot: NDArray[np.float64],
        direction: NDArray[np.float64],
        length: float,
        radius: float,
        order: int,
    ) -> None:
        fractions = np.linspace(0, 1, _RINGS[order])[:, None]
        bend = rng.normal(size=3) * 0.12 + params.rise * (order > 0) * up
        path = foot + length * (fractions * direction + 0.5 * fractions**2 * bend)
        radii = radius * (1 - _TAPER * fractions[:, 0])
        radii[0] *= 1.0 if order else 1.5
        parts.append(tube(path, radii, _SIDES[order]))
        if order == len(params.children):
            ends.append(path[-1])
            return
        count = params.children[order]
        first = rng.uniform(0, 2 * np.pi)
        children = []
        for number in range(count):
            along = 0.98 - 0.05 * number if order else 0.55 + 0.43 * number / max(count - 1, 1)
            step = along * (len(path) - 1)
            index = min(int(step), len(path) - 2)
            ahead = path[index + 1] - path[index]
            spacing = (2 * np.pi / count if order else _GOLDEN) * number
            azimuth = first + spacing + rng.uniform(-0.3, 0.3)
            heading = _branch_direction(ahead, params.spread_rad * rng.uniform(0.75, 1.2), azimuth)
            reach = params.shrink * rng.uniform(0.85, 1.1) * length
            # Thinner than the parent there, which hides the foot.
            thickness = 0.75 * radius * (1 - _TAPER * along)
            start = path[index] + (step - index) * ahead
            children.append((start, heading, reach, thickness, order + 1))
        for child in reversed(children):  # after all draws of this branch
            grow(*child)

    grow(0 * up, up, 1.0, params.thickness, 0)
    return parts, ends


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


class _Plant:
    """Shape of a random plant; measures of a leaf but its length are fractions of it."""

    def __init__(self, rng: np.random.Generator) -> None:
        kind = str(rng.choice(["agave", "grass", "palm", "broad", "herb"]))
        leaf, leaves, stems, stalks, rises = {
            "agave": ((0.75, 0.24, 0.4, 0.7), (14, 27), (0.0, 0.0), (0.0, 0.0), (1.4, 0.3)),
            "grass": ((1.1, 0.07, 0.4, 0.7), (28, 45), (0.0, 0.0), (0.0, 0.0), (1.5, 0.8)),
            "palm": ((1.0, 0.34, 0.45, 0.2), (9, 15), (0.7, 1.5), (0.0, 0.0), (1.2, 0.2)),
            "broad": ((0.6, 0.75, 0.35, 0.3), (7, 14), (0.0, 0.5), (0.35, 0.7), (1.3, 0.6)),
            "herb": ((0.4, 0.45, 0.45, 0.1), (16, 29), (0.6, 1.1), (0.03, 0.1), (0.9, 0.1)),
        }[kind]
        # where along the midrib the leaf is widest, and its base as a share of that width
        length, width, self.widest, self.base = leaf
        # notches along each edge; 0 is a smooth one
        self.teeth = {"palm": 14, "broad": int(rng.choice([0, 4]))}.get(kind, 0)
        self.tooth_depth = 0.75 if kind == "palm" else 0.4  # as a share of the width there
        self.length = length * rng.uniform(0.8, 1.25)  # of the largest leaf, base to tip
        self.width = width * rng.uniform(0.8, 1.25)  # largest width
        # how far the midrib turns downwards, and each half is raised from its plane
        self.arch_rad = rng.uniform(*((0.5, 1.1) if kind in ("agave", "broad") else (1, 2)))
        self.fold_rad = rng.uniform(0.15, 0.6)
        self.rows = max(2 * self.teeth, int(rng.integers(9, 13)))  # of vertices, base to tip
        self.leaves = int(rng.integers(*leaves))
        self.stem = rng.uniform(*stems)  # height of the stem above the pot; 0 is a rosette
        self.stalk = rng.uniform(*stalks)  # length of each leaf's own stalk; 0 is none
        self.steepest_rad = rises[0] + rng.uniform(-0.1, 0.1)  # rise of the uppermost leaf
        self.flattest_rad = rises[1] + rng.uniform(-0.2, 0.2)  # rise of the lowest leaf
        self.smallest = rng.uniform(0.4, 0.8)  # size of the uppermost leaf over the largest
        self.pot_height = rng.uniform(0.22, 0.42)
        self.pot_foot = 0.28 * rng.uniform(0.55, 1.0)  # radius of the pot's foot


def sample_plant(rng: np.random.Generator) -> Mesh:
    """Return a random plant: a closed pot, closed stems, and one open sheet per leaf.

    The rim of its pot has a radius of about 0.3.
    """
    params = _Plant(rng)
    high = params.pot_height
    outline = [(0.9 * params.pot_foot, 0.0), (params.pot_foot, 0.02), (0.28, high - 0.1)]
    outline += [(0.31, high - 0.09), (0.31, high), (0.28, high)]  # rim
    outline += [(0.27, high - 0.03), (0.14, high - 0.025)]  # earth to just below it
    parts = [lathe(outline, 20)]
    top = high - 0.03
    if stem := params.stem:
        bend = np.linspace(0, 1, 10)
        path = np.stack([0.1 * stem * bend**2, 0 * bend, stem * bend], axis=1)
        path[:, 2] += top - 0.02
        parts.append(tube(path, 0.045 - 0.02 * bend, 8))
    for number in range(params.leaves):
        fraction = (number + 0.5) / params.leaves
        rise = params.flattest_rad + fraction * (params.steepest_rad - params.flattest_rad)
        level = (0.35 + 0.65 * fraction) * stem
        foot = np.array([0.1 * level**2 / stem if stem else 0.0, 0.0, top + level])
        size = 1 - fraction * (1 - params.smallest)
        azimuth = number * np.pi * (3 - np.sqrt(5))
        parts += _leaf_on_stalk(params, size, foot, azimuth, rise)
    return join(parts)


def _leaf_on_stalk(
    params: _Plant, size: float, foot: NDArray[np.float64], azimuth: float, rise: float
) -> list[Mesh]:
    """Return a leaf that starts at `foot` or at the end of its stalk, and the stalk if any."""
    stalk = params.stalk * size
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    direction = np.cos(rise) * ahead + np.array([0.0, 0.0, np.sin(rise)])
    # Without a stalk it begins just inside the stem or the earth.
    start = foot + (direction * stalk if stalk else 0.025 * ahead - [0.0, 0.0, 0.01])
    # A leaf at the end of a stalk hangs from it, the others go on in their own direction.
    positions, faces = _leaf(params, params.length * size, rise - 0.5 if stalk > 0.2 else rise)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    turned = positions @ np.stack([ahead, aside, [0.0, 0.0, 1.0]])
    parts: list[Mesh] = [(turned + start, faces)]
    if stalk:
        path = foot + np.linspace(-0.02, stalk + 0.02, 5)[:, None] * direction
        parts.append(tube(path, np.linspace(0.014, 0.008, 5) * (1 + stalk), 5))
    return parts


def _leaf(params: _Plant, length: float, rise_rad: float) -> Mesh:
    """Return one leaf: an open sheet of 8 (rows - 1) + 4 triangles from the origin towards x.

    The sheet faces upwards and ends in a point.
    """
    along = np.arange(params.rows) / params.rows
    across = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    slope = rise_rad - params.arch_rad * np.append(along, 1.0)
    steps = np.stack([np.cos(slope), 0 * slope, np.sin(slope)], axis=1) * length / params.rows
    rib = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
    rising = params.base + (1 - params.base) * np.sin(0.5 * np.pi * along / params.widest)
    falling = np.sin(0.5 * np.pi * (1 - along) / (1 - params.widest)) ** 0.8
    width = np.where(along < params.widest, rising, falling)
    if params.teeth:
        width = width * (1 - params.tooth_depth * (np.arange(params.rows) % 2))
    half = 0.5 * length * params.width * width
    over = np.stack([-np.sin(slope), 0 * slope, np.cos(slope)], axis=1)[:-1]
    out = half[:, None] * across
    lift = np.abs(out) * np.sin(params.fold_rad)
    grid = rib[:-1, None] + lift[..., None] * over[:, None]
    grid[..., 1] += out * np.cos(params.fold_rad)
    last = (params.rows - 1) * 5 + np.arange(4)
    tip = np.stack([last + 1, last, np.full(4, params.rows * 5)], axis=1)
    faces = np.concatenate([sheet_faces(params.rows, 5)[:, ::-1], tip])
    return np.concatenate([grid.reshape(-1, 3), rib[-1:]]), faces
