"""Furniture: tables, stools, chairs, benches and shelves, joined from beveled boards and legs.

Many separate closed components with flat faces, as in most hand-made models.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import Mesh, beam, box, join, lathe, scale_and_move


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
        # boards of a chair's back or of a bench-like top; 1 is a plain one
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
        return [scale_and_move(lathe(outline, 32), [0, 0, high - half])]
    if params.kind == "chair" or params.slats == 1:
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
    feet = [(-x, -y), (x, -y), (x, y), (-x, y)]
    out = np.sign(np.array(feet)) * params.splay
    high = params.height - 0.5 * params.board
    tops = [np.array([*foot, high]) for foot in feet]
    ends = [np.array([*(np.array(foot) + add), 0.0]) for foot, add in zip(feet, out, strict=True)]
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
