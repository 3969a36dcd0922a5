"""Families of objects with one closed surface.

- Gears add sharp edges and flat faces, rocks large flat facets that meet at any angle.
- Vases are open vessels: they let light in, and their inside shades itself.
- Superquadrics (Barr 1981) go from boxes over ellipsoids to octahedra and stars, tapered, twisted.
- Torus knots are tubes along one closed strand, with ribs that wind around it.
- Sea shells (after Raup 1966) are a growing tube on a spiral about an axis, open at its mouth:
  smooth, with a visible inside, and detail that shrinks towards the tip.
- Lattices of square bars have thin parts, right angles and many holes; the surface is one piece.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.objects.builtin.solids import (
    Mesh,
    icosphere,
    sphere_faces,
    taper_and_twist,
    torus_faces,
)

_TOOTH = np.array([0.0, 0.0, 0.6, 1.0, 1.0, 0.6])
"""Relative height of the outline at six equal steps of one tooth: gap, flank, tip, flank."""


def sample_gear(rng: np.random.Generator) -> Mesh:
    """Return a random gear, spur, helical or beveled: a closed surface of 168 triangles per tooth.

    The cross section in a half plane through the axis is a closed loop; sweeping it around the axis
    while the teeth push its outer corners in and out gives a torus. Sharp edges and flat faces are
    what this family adds to the others.

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


def sample_rock(rng: np.random.Generator) -> Mesh:
    """Return a random rock: a closed surface, star-shaped about the origin, from a unit ball.

    Planes cut it, softly or sharply, with bumps and with layers: large flat facets that meet at any
    angle, unlike on a grid of rings.
    """
    kind = rng.choice(["pebble", "broken", "layered"])
    cuts = _rand_cuts(rng, int(rng.integers(9, 22)))
    sizes = rng.uniform(0.55, 1.0, 3)  # stretch along x, y and z
    # Bumps over the surface: waves per radius along x, y and z, and a phase.
    waves = rng.normal(size=(12, 4)) * [0.5, 0.5, 0.5, 3.0]
    sharpness = rng.uniform(5, 12) if kind == "pebble" else rng.uniform(16, 36)
    bump_height = rng.uniform(0.1, 0.4) if kind == "pebble" else rng.uniform(0.02, 0.1)
    layers = rng.uniform(1.6, 3.2) if kind == "layered" else 0.0  # per radius of height
    layer_depth = rng.uniform(0.06, 0.16)  # how far joints between layers are cut back
    frequency = rng.integers(*{"pebble": (5, 10), "broken": (9, 16)}.get(kind, (14, 18)))
    direction, faces = icosphere(int(frequency))
    # The hard surface is the nearest plane or the ball: the largest inverse distance. A norm of
    # these rounds its edges: 6 is a pebble, 30 a broken stone.
    inverse = np.maximum(direction @ cuts[:, :3].T, 0) / cuts[:, 3]
    every = np.concatenate([inverse, np.ones((len(direction), 1))], axis=1)
    radius = (every**sharpness).sum(axis=1) ** (-1 / sharpness)
    swing = np.sin(2 * np.pi * direction @ waves[:, :3].T + waves[:, 3]).mean(axis=1)
    radius = radius * (1 + bump_height * swing)
    if layers:
        height = layers * (radius * direction[:, 2] + 0.1 * direction[:, 0])
        # A narrow joint per layer: the fourth power of a wave is flat but near its crest.
        joint = np.cos(np.pi * height) ** 4
        radius = radius - layer_depth * joint * radius * (1 - direction[:, 2] ** 2)
    return direction * radius[:, None] * sizes, faces


def _rand_cuts(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return planes [count, 4]: unit directions, even but for noise, and their distances."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + np.sqrt(5)) * index + rng.uniform(0, 6)
    ring = np.sqrt(1 - z * z)
    spread = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    spread += rng.normal(size=spread.shape) * 0.35
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    return np.column_stack([spread, rng.uniform(0.55, 0.9, count)])


def sample_vase(rng: np.random.Generator) -> Mesh:
    """Return a random vase: a closed surface (outside, lip, inside).

    Its wall of even thickness is lathed around a smooth profile, plain, fluted or swirled. Unlike
    closed bodies, open vessels let light in, and their inside shades itself.
    """
    # Outer radii at equal heights from foot to lip, joined by a smooth curve.
    radii = rng.uniform(0.16, 0.55, int(rng.integers(4, 7)))
    flutes = int(rng.choice([0, 0, 5, 6, 8, 10]))  # folds around the vase; 0 is plain
    columns = int(rng.integers(28, 45))
    columns -= columns % max(flutes, 1)  # so that all flutes are alike
    height = rng.uniform(0.7, 1.6)
    wall = rng.uniform(0.025, 0.06)  # thickness of wall and bottom
    flute_depth = rng.uniform(0.1, 0.35)  # as a share of the radius
    swirl_rad = rng.uniform(-0.8, 0.8)  # turn of the folds from foot to lip
    rings = int(rng.integers(14, 21))  # from foot to lip
    level = np.linspace(0, 1, rings)
    inner_height = wall + (height - wall) * level
    inner = _smooth(radii, inner_height / height) - wall
    radius = np.concatenate([_smooth(radii, level), inner[::-1]])
    heights = np.concatenate([height * level, inner_height[::-1]])
    azimuth = 2 * np.pi * np.arange(columns) / columns
    phase = flutes * (azimuth[None] + swirl_rad * heights[:, None] / height)
    fold = 1 - flute_depth * (0.5 - 0.5 * np.cos(phase)) * bool(flutes)
    folded = radius[:, None] * fold
    upright = np.broadcast_to(heights[:, None], folded.shape)
    grid = np.stack([folded * np.cos(azimuth), folded * np.sin(azimuth), upright], axis=-1)
    poles = [[0.0, 0.0, 0.0], [0.0, 0.0, wall]]
    return np.concatenate([grid.reshape(-1, 3), poles]), sphere_faces(2 * rings, columns)


def _smooth(values: NDArray[np.float64], where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate a Catmull-Rom curve through equally spaced `values` at positions in [0, 1].

    The curve may overshoot the values by an eighth of their differences; callers leave a margin.
    """
    padded = np.concatenate([[2 * values[0] - values[1]], values, [2 * values[-1] - values[-2]]])
    position = np.clip(where, 0, 1) * (len(values) - 1)
    segment = np.minimum(position.astype(np.int64), len(values) - 2)
    step = (position - segment)[:, None] ** np.arange(4)
    basis = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
    return np.einsum("nk,kj,nj->n", step, basis, padded[segment[:, None] + np.arange(4)])


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

    The polar form spreads vertices evenly for all exponents; the textbook form crowds them at the
    edges of boxes.

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
    around = 2 * np.pi * np.arange(params.columns) / params.columns
    relief = np.zeros((rings, params.columns))  # height of ribs, spines and cords, at least 0
    if params.ribs:
        crest = (0.5 + 0.5 * np.cos(2 * np.pi * params.ribs * winding)) ** 2
        shoulder = np.maximum(np.cos(around + 0.7), 0) ** 6
        relief += params.rib_height * crest[:, None] * (1 + params.spines * shoulder)
    if params.cords:
        relief += params.cord_height * (0.5 + 0.5 * np.cos(params.cords * around))
    outer = _rings(winding, 1 + relief, params)
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


class _Lattice:
    """Shape of a random lattice."""

    def __init__(self, rng: np.random.Generator) -> None:
        kind = str(rng.choice(["frame", "crate", "tower", "cage", "grille"]))
        low, high = {
            "frame": ((2, 1, 1), (3, 2, 2)),
            "crate": ((3, 3, 2), (5, 4, 3)),
            "tower": ((1, 1, 5), (2, 2, 7)),
            "cage": ((2, 2, 3), (4, 3, 3)),
            "grille": ((5, 0, 3), (8, 0, 5)),
        }[kind]
        # holes along x, y and z; 0 is a grille, one bar thick that way
        self.cells = [int(rng.integers(a, b + 1)) for a, b in zip(low, high, strict=True)]
        self.half_sizes = rng.uniform(0.6, 1.0, 3)  # half extents, before it is warped
        if kind == "tower":
            self.half_sizes *= [0.4, 0.4, 1.3]
        if kind == "grille":
            self.half_sizes *= [1.0, 0.06, 1.0]
        taper = rng.uniform(-0.75, 0.0) if kind == "tower" or rng.random() < 0.5 else 0.0
        bend = float(rng.choice([0.0, rng.uniform(1.0, 3.5)])) if kind == "grille" else 0.0
        # Holes cannot be decimated away: a lattice of many bars has no triangles to spare.
        fine = np.prod(np.add(self.cells, 1)) <= 40 and (kind in ("frame", "tower") or bend > 0)
        self.splits = 2 if fine else 1  # pieces of a bar between two crossings; more bend better
        self.bar = rng.uniform(0.14, 0.36)  # thickness of a bar, in steps of the lattice
        self.hollow = kind in ("crate", "tower", "cage")  # True for bars on the outside only
        self.crate = kind == "crate"  # the lowest layer is a plate and the highest a mere rim
        # from 0, a box, to 1, a ball
        self.roundness = rng.uniform(0.6, 1.0) if kind == "cage" else 0.0
        self.taper = taper if kind in ("tower", "frame") else 0.0
        self.twist_rad = rng.uniform(-0.7, 0.7) if kind == "tower" else 0.0
        self.bend_rad = bend  # angle of the arc about z that x is laid along; 0 is straight


def sample_lattice(rng: np.random.Generator) -> Mesh:
    """Return a random lattice: a closed surface of about 10 splits triangles per bar."""
    params = _Lattice(rng)
    planes, bars = zip(*(_steps(cells, params) for cells in params.cells), strict=True)
    x, y, z = np.meshgrid(*bars, indexing="ij")
    solid = x.astype(np.int64) + y + z >= 2
    if params.hollow:
        outside = np.zeros(solid.shape, bool)
        for axis in range(3):
            edge = np.moveaxis(outside, axis, 0)
            edge[[0, -1]] = True
        solid &= outside
    if params.crate:
        solid[:, :, 0] = True
        solid[1:-1, 1:-1, -1] = False
    corner, faces = _surface(solid)
    unit = np.stack([np.array(planes[axis])[corner[:, axis]] for axis in range(3)], axis=1)
    return _warp(unit, params), faces


def _steps(cells: int, params: _Lattice) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the positions of grid planes [N + 1] from -1 to 1, and which steps [N] are bars."""
    gap = [(1 - params.bar) / params.splits] * params.splits
    widths = np.array([params.bar] + [*gap, params.bar] * cells)
    bars = np.array([True] + ([False] * params.splits + [True]) * cells)
    planes = np.concatenate([[0.0], np.cumsum(widths)])
    return 2 * planes / planes[-1] - 1, bars


def _surface(solid: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the grid points [V, 3] and the faces between solid and empty cells.

    Cells that share only an edge would give that edge four faces; bars that meet at crossings never
    do.
    """
    padded = np.pad(solid, 1).astype(np.int64)
    shape = tuple(size + 1 for size in solid.shape)
    quads = []
    for axis in range(3):
        b = (axis + 1) % 3
        c = (axis + 2) % 3
        change = np.diff(padded, axis=axis)
        for sign in (1, -1):
            # A cell begins where occupancy rises: its face looks down the axis.
            base = np.argwhere(change == sign)
            base[:, [b, c]] -= 1
            first, second = np.eye(3, dtype=np.int64)[[c, b] if sign > 0 else [b, c]]
            corners = base[:, None] + np.stack([0 * first, first, first + second, second])
            quads.append(np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape))
    used, flat = np.unique(np.concatenate(quads), return_inverse=True)
    points = np.stack(np.unravel_index(used, shape), axis=1)
    return points, flat.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _warp(unit: NDArray[np.float64], params: _Lattice) -> NDArray[np.float64]:
    """Round, scale, taper, twist and bend points [V, 3] of the cube from -1 to 1."""
    largest = np.abs(unit).max(axis=1, keepdims=True)
    length = np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    ball = unit * largest / length
    points = (unit + params.roundness * (ball - unit)) * params.half_sizes
    taper_and_twist(points, unit[:, 2], params.taper, params.twist_rad)
    if params.bend_rad:
        radius = 2 * params.half_sizes[0] / params.bend_rad
        arc_angle = points[:, 0] / radius
        x = radius - points[:, 1]
        points[:, 0] = x * np.sin(arc_angle)
        points[:, 1] = radius - x * np.cos(arc_angle)
    return points
