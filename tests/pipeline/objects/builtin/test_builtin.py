"""Laws of all built-in families: closed parts that face outward, no two objects alike."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.generated import FAMILIES
from storage.digests import sha256_hex
from storage.seeds import rng_for

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


def test_the_order_of_families_is_kept() -> None:
    """Object i is of family i modulo their number: another order gives other datasets."""
    assert list(FAMILIES) == [
        "superquadric", "torus_knot", "gear", "vase",
        "rock", "shell", "furniture", "tree", "lattice", "plant",
    ]  # fmt: skip


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
    found = {}
    for family in FAMILIES:
        meshes = [made(family, number) for number in range(2 * SAMPLES)]
        # to a cell of the mesh stage: processors differ in the sixteenth digit of exp and sin
        cells = [np.rint(positions * 2**20).astype(np.int64) for positions, _ in meshes]
        faces = [faces.astype(np.int64) for _, faces in meshes]
        found[family] = sha256_hex(np.concatenate([*cells, *faces]).tobytes())[:16]
    assert found == DRAWN


@pytest.mark.parametrize("family", FAMILIES)
def test_every_object_keeps_the_laws(family: str) -> None:
    for number in range(SAMPLES):
        mesh = made(family, number)
        parts = parts_of(mesh)
        try:
            _require_closed_parts(mesh, parts, family in WITH_SHEETS)
            _require_good_faces(mesh)
            _require_no_floating_part(parts)
        except AssertionError as error:
            raise AssertionError(f"{family} {number}") from error


def _require_closed_parts(mesh: Mesh, parts: list[Mesh], with_sheets: bool) -> None:
    """Closed parts face outward."""
    positions, faces = mesh
    assert np.isfinite(positions).all()
    assert 300 <= len(faces) <= 6000
    assert faces.min() == 0 and len(np.unique(faces)) == len(positions)
    closed = [part for part in parts if is_closed(part)]
    assert all(volume(part) > 0 for part in closed)
    assert closed and (len(closed) < len(parts)) == with_sheets


def _require_good_faces(mesh: Mesh) -> None:
    """None is without area or there twice."""
    positions, faces = mesh
    unit = positions / np.ptp(positions, axis=0).max()
    a, b, c = unit[faces].transpose(1, 0, 2)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9).all()
    # The mesh stage welds what shares a cell of 2^-20: then parts would share edges.
    cells = np.rint(unit.astype(np.float32).astype(np.float64) * 2**20)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)


def _require_no_floating_part(parts: list[Mesh]) -> None:
    boxes = np.array([(p.min(axis=0), p.max(axis=0)) for p, _ in parts])
    low, high = boxes[:, 0], boxes[:, 1]
    apart = np.asarray(((low[:, None] > high[None]) | (low[None] > high[:, None])).any(axis=2))
    reached = {0}
    for _ in boxes:
        reached = {int(part) for part in np.flatnonzero(~apart[sorted(reached)].all(axis=0))}
    assert len(reached) == len(boxes)


def test_equal_generators_give_equal_objects() -> None:
    for family in FAMILIES:
        first, again = made(family, 0), FAMILIES[family](rng_for(0, f"builtin/{family}", 0))
        assert np.array_equal(first[0], again[0]) and np.array_equal(first[1], again[1]), family


def spread(mesh: Mesh) -> NDArray[np.float64]:
    """Nine quantiles of the area along each axis of the unit box: 27 numbers that tell shapes."""
    positions, faces = mesh
    low, high = positions.min(axis=0), positions.max(axis=0)
    a, b, c = ((positions - low) / (high - low).max())[faces].transpose(1, 0, 2)
    area, centres = np.linalg.norm(np.cross(b - a, c - a), axis=1), (a + b + c) / 3
    levels = np.linspace(0.1, 0.9, 9) * area.sum()
    rows = []
    for axis in centres.T:
        order = np.argsort(axis, kind="stable")
        rows.append(np.interp(levels, np.cumsum(area[order]), axis[order]))
    return np.concatenate(rows)


def test_other_generators_give_other_shapes() -> None:
    for family in FAMILIES:
        known = np.stack([spread(made(family, number)) for number in range(SAMPLES)])
        apart = np.abs(known[:, None] - known[None]).max(axis=2)[np.triu_indices(SAMPLES, 1)]
        # Shares of the object's size by which some of its surface lies elsewhere: the closest two
        # of twelve, and the usual two.
        assert apart.min() > 0.01, family
        assert np.median(apart) > 0.06, family


def test_sizes_vary_and_some_objects_are_large() -> None:
    sizes = {family: [len(made(family, n)[1]) for n in range(SAMPLES)] for family in FAMILIES}
    assert all(len(set(counts)) >= 4 for counts in sizes.values())
    assert max(max(counts) for counts in sizes.values()) > 4000
    assert min(min(counts) for counts in sizes.values()) < 700


def test_families_differ_in_kind() -> None:
    """Genus and number of parts tell bodies, rings and lattices from what is put together."""

    def fullness(mesh: Mesh) -> float:
        return volume(mesh) / float(np.prod(np.ptp(mesh[0], axis=0)))

    def euler(mesh: Mesh) -> int:
        return len(mesh[0]) - len(mesh[1]) // 2

    kinds = {family: [made(family, number) for number in range(SAMPLES)] for family in FAMILIES}
    parts = {family: [len(parts_of(mesh)) for mesh in meshes] for family, meshes in kinds.items()}
    one = {"superquadric": 2, "vase": 2, "rock": 2, "shell": 2, "torus_knot": 0, "gear": 0}
    assert {family: {euler(mesh) for mesh in kinds[family]} for family in one} == {
        family: {number} for family, number in one.items()
    }
    assert all(set(parts[family]) == {1} for family in (*one, "lattice"))
    # A genus of 4 or more: as many holes as the faces of a cube, two of them the same.
    assert all(euler(mesh) <= 2 - 2 * 4 for mesh in kinds["lattice"])
    assert all(min(parts[family]) >= 4 for family in ("furniture", "tree", "plant"))
    median = {k: float(np.median([fullness(mesh) for mesh in v])) for k, v in kinds.items()}
    assert median["vase"] < 0.5 * median["superquadric"]
    assert median["torus_knot"] < 0.5 * median["gear"]
    assert median["furniture"] < 0.5 * median["rock"]
