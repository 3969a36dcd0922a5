"""Laws of all built-in families, and the digests of their first objects."""

import itertools
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.objects.builtin import surfaces
from pipeline.objects.builtin.solids import Mesh
from pipeline.objects.builtin.surfaces import torus_knot
from pipeline.objects.generated import FAMILIES
from storage.digests import sha256_hex
from storage.seeds import rng_for
from tests.for_each import case, for_each

SAMPLES = 12
"""Objects of each family."""
WITH_SHEETS = ("plant",)
"""Families some of whose parts are open on purpose."""


def volume(mesh: Mesh) -> float:
    a, b, c = mesh[0][mesh[1]].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


@cache
def made(family: str, number: int) -> Mesh:
    return FAMILIES[family](rng_for(0, f"builtin/{family}", number))


def parts_of(mesh: Mesh) -> list[Mesh]:
    """The pieces that share no vertex, each with vertices of its own."""
    positions, faces = mesh
    label = np.arange(len(positions))
    while True:
        lowest = label.copy()
        np.minimum.at(lowest, faces.ravel(), np.repeat(label[faces].min(axis=1), 3))
        lowest = lowest[lowest]
        if np.array_equal(lowest, label):
            break
        label = lowest
    parts = []
    for name in np.unique(label):
        used, flat = np.unique(faces[label[faces[:, 0]] == name], return_inverse=True)
        parts.append((positions[used], flat.reshape(-1, 3)))
    return parts


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge has two faces; raises where faces of an edge disagree."""
    edges = mesh[1][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = {(int(a), int(b)) for a, b in edges}
    # A directed edge that occurs twice has a third face, or two that face opposite sides.
    assert len(forward) == len(edges)
    return forward == {(b, a) for a, b in forward}


DRAWN = {
    "superquadric": "a47789a3c4c30a9a",
    "torus_knot": "f164ebd196304ed0",
    "gear": "53d71a0a816d6e86",
    "vase": "925509848d4e8bc8",
    "rock": "ef611186ded0cc33",
    "shell": "8ef7a3a8a6f23d60",
    "furniture": "e48adfc6fbe33412",
    "tree": "08f54e524195b510",
    "lattice": "7d5837fedc53da22",
    "plant": "563dccf4471f8da3",
}
"""Digest of the first objects of each family: published sets hold them."""


def test_objects_stay_what_they_are() -> None:
    """Object i is of family i modulo their number: another order gives other datasets."""
    found = {}
    for family in FAMILIES:
        meshes = [made(family, number) for number in range(2 * SAMPLES)]
        # to a cell of the mesh stage: processors differ in the sixteenth digit of exp and sin
        cells = [np.rint(positions * 2**20).astype(np.int64) for positions, _ in meshes]
        faces = [faces.astype(np.int64) for _, faces in meshes]
        found[family] = sha256_hex(np.concatenate([*cells, *faces]).tobytes())[:16]
    assert list(found.items()) == list(DRAWN.items())


@pytest.mark.parametrize("family", FAMILIES)
def test_every_object_keeps_the_laws(family: str) -> None:
    for number in range(SAMPLES):
        with case(number):
            mesh = made(family, number)
            positions, faces = mesh
            assert np.isfinite(positions).all()
            assert 300 <= len(faces) <= 6000
            assert faces.min() == 0 and len(np.unique(faces)) == len(positions)
            # No face is without area or there twice.
            unit = positions / np.ptp(positions, axis=0).max()
            a, b, c = unit[faces].transpose(1, 0, 2)
            assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9).all()
            assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
            # The mesh stage welds what shares a cell of 2^-20: then parts would share edges.
            cells = np.rint(unit.astype(np.float32).astype(np.float64) * 2**20)
            assert len(np.unique(cells, axis=0)) == len(cells)
            # Closed parts face outward.
            parts = parts_of(mesh)
            closed = [part for part in parts if is_closed(part)]
            assert all(volume(part) > 0 for part in closed)
            assert closed and (len(closed) < len(parts)) == (family in WITH_SHEETS)
            # No part floats.
            boxes = np.array([(p.min(axis=0), p.max(axis=0)) for p, _ in parts])
            low, high = boxes[:, 0], boxes[:, 1]
            outside = (low[:, None] > high[None]) | (low[None] > high[:, None])
            apart = np.asarray(outside.any(axis=2))
            reached = {0}
            for _ in boxes:
                reached = {
                    int(part) for part in np.flatnonzero(~apart[sorted(reached)].all(axis=0))
                }
            assert len(reached) == len(boxes)


@for_each("windings", [(2, 3), (3, 2), (2, 5), (3, 4), (1, 5), (4, 3), (5, 2)])
def test_strands_of_a_knot_do_not_meet(windings: tuple[int, int]) -> None:
    positions, _ = torus_knot(windings=windings, minor_radius=0.4, fill=0.95, segments=240, sides=8)
    rings = positions.reshape(240, 8, 3)
    centre = rings.mean(axis=1)
    tube = np.linalg.norm(rings - centre[:, None], axis=2).max()
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    apart = np.abs(np.arange(240)[:, None] - np.arange(240)[None])
    apart = np.minimum(apart, 240 - apart)
    step = np.linalg.norm(centre - np.roll(centre, 1, axis=0), axis=1).min()
    far_along = apart * step > np.pi * tube
    assert distance[far_along].min() > 2 * tube * 0.99


def _lattice(cells: tuple[int, int, int], **changes: object) -> Mesh:
    shape: dict[str, object] = {
        "half_sizes": (1.0, 0.8, 0.6), "bar": 0.25, "hollow": False, "crate": False, "splits": 1,
        "roundness": 0.0, "taper": 0.0, "twist_rad": 0.0, "bend_rad": 0.0,
    }  # fmt: skip
    stated = SimpleNamespace(cells=cells, **(shape | changes))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces, "_Lattice", lambda _: stated)
        return surfaces.sample_lattice(rng_for(0, "any"))


@for_each(
    "cells, splits",
    itertools.product([(1, 1, 1), (2, 1, 3), (3, 3, 2), (4, 0, 3), (1, 0, 1)], [1, 3]),
)
def test_a_lattice_has_the_genus_of_its_graph(cells: tuple[int, int, int], splits: int) -> None:
    mesh = _lattice(cells, splits=splits)
    x, y, z = cells
    crossings = (x + 1) * (y + 1) * (z + 1)
    bars = x * (y + 1) * (z + 1) + y * (x + 1) * (z + 1) + z * (x + 1) * (y + 1)
    assert is_closed(mesh) and len(parts_of(mesh)) == 1
    assert len(mesh[0]) - len(mesh[1]) // 2 == 2 * (crossings - bars)
    # Every side of every piece of a bar is a quad, and so is every side of a crossing without bar.
    assert len(mesh[1]) == 2 * (4 * bars * splits + 6 * crossings - 2 * bars)
