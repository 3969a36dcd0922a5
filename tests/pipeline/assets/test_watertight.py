"""Watertight meshes: closed, oriented, manifold and near the source, or refused with the reason."""

import json
from collections.abc import Iterator
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.assets import watertight
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.quality.measure import Surface, require_watertight
from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.settings.described import settings_record
from tests.command_line import trilight
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    book,
    cleaned,
    cube,
    flip_some,
    grid,
    joined,
    knot,
    mesh_of,
    moved,
    prepare,
    reason_of,
    sphere,
    with_faces,
    write_obj,
)

METHOD = methods_of("faithful", watertight=True)[0]
WATERTIGHT = AssetSettings(budgets=(1400, 240), watertight=True)
CELLS = 24
"""Of the grid, instead of 128: the laws are those of any grid, and hundreds of nodes are quick."""


@pytest.fixture(autouse=True, scope="module")
def _coarse_grid() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watertight, "_CELLS", CELLS)
        yield


def is_watertight(mesh: TriangleMesh) -> bool:
    """As trimesh judges it, after it has merged equal positions; and each vertex has one fan."""
    other = trimesh.Trimesh(mesh.positions, mesh.faces)
    if not (other.is_watertight and other.is_winding_consistent and other.volume > 0):
        return False
    # the edges opposite a vertex must be one closed walk around it
    follows: list[dict[int, int]] = [{} for _ in other.vertices]
    for a, b, c in other.faces.tolist():
        for vertex, start, end in ((a, b, c), (b, c, a), (c, a, b)):
            follows[vertex][start] = end
    for walk in filter(None, follows):
        first = here = next(iter(walk))
        steps = 0
        while steps == 0 or here != first:
            here = walk[here]
            steps += 1
        if steps != len(walk):
            return False
    return True


def pierced(mesh: TriangleMesh, *, faces: int) -> TriangleMesh:
    return with_faces(mesh, mesh.faces[faces:])


BALL = sphere(rings=12, columns=24)
TOUCHING = joined(moved(cube(), 0.5, -0.25), moved(cube(), 0.5, 0.25))
CROSSING = joined(cube(2), moved(cube(2), [0.3, 0.3, 1.4]))
SHAPES = {
    "sphere": sphere(rings=8, columns=12),
    "knot": knot(segments=40),
    "sheet": grid(4),
    "bowl": pierced(BALL, faces=len(BALL.faces) // 2),
    "book": book(5),
    "touching": TOUCHING,
    "nested": joined(cube(2), moved(cube(2), 0.4)),
    "crossing": CROSSING,
}


@st.composite
def spoiled(draw: st.DrawFn) -> TriangleMesh:
    """A shape that may be open, self-intersecting, doubled, and flipped in part."""
    mesh = SHAPES[draw(st.sampled_from(sorted(SHAPES)))]
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    if draw(st.booleans(), "open"):
        mesh = with_faces(mesh, mesh.faces[rng.random(len(mesh.faces)) < 0.8])
    if draw(st.booleans(), "self-intersecting"):
        mesh = joined(mesh, moved(mesh, 0.7, rng.normal(0, 0.1, 3)))
    if draw(st.booleans(), "doubled"):
        mesh = joined(mesh, with_faces(mesh, mesh.faces[:, ::-1]), moved(mesh, 1, 1e-5))
    return flip_some(mesh, draw(st.sampled_from((0.0, 0.3, 1.0))), rng)


@settings(max_examples=25)
@given(mesh=spoiled(), fills=st.booleans())
def test_a_surface_around_anything_is_closed_oriented_and_manifold(
    mesh: TriangleMesh, fills: bool
) -> None:
    source = cleaned(mesh)
    around = watertight.surface_around(source, fills=fills)
    require_watertight(around)
    assert is_watertight(around)
    squared = igl.point_mesh_squared_distance(around.positions, source.positions, source.faces)[0]
    # a quarter of a cell where distances are linear; between crowded triangles they are not
    assert 0 < squared.min() and np.sqrt(np.median(squared)) < 0.27 / CELLS
    assert np.sqrt(squared.max()) < 0.5 / CELLS


@for_each(
    "name, mesh, method",
    [
        ("closed already", BALL, "source"),
        ("two of its triangles away", pierced(BALL, faces=2), f"capped {METHOD}"),
        ("flipped", flip_some(BALL, 0.5, np.random.default_rng(1)), "source"),
        ("doubled", joined(BALL, with_faces(BALL, BALL.faces[:, ::-1])), "source"),
        ("crossing itself, closed", CROSSING, "source"),
        ("touching at a corner", TOUCHING, f"solid {METHOD}"),
        ("open", SHAPES["bowl"], f"solid {METHOD}"),
    ],
)
def test_levels_are_watertight_and_near_the_source(
    name: str, mesh: TriangleMesh, method: str, tmp_path: Path
) -> None:
    asset = prepare(write_obj(tmp_path / "a.obj", mesh), WATERTIGHT, METHOD)
    assert asset.levels[0].record.method == method, name
    surface = Surface(orient_outward(cleaned(mesh))[0], np.random.default_rng(9).random((8192, 3)))
    for level in asset.levels:
        quality = level.record.quality
        assert is_watertight(mesh_of(level)) and quality.open_edges == 0
        assert len(level.faces) <= level.record.budget
        other = surface.hausdorff_deviation(mesh_of(level)).two_way(98.6)
        assert other <= quality.error_p99 + 1e-14
        assert quality.error_p99 <= WATERTIGHT.gate.max_error_p99


def test_what_cannot_be_had_is_refused_with_the_reason(tmp_path: Path) -> None:
    # a cube in a cube, which a solid one would lose, and a sheet above them
    walled = joined(SHAPES["nested"], moved(grid(2), 1, [0, 0, 0.8]))
    path = write_obj(tmp_path / "a.obj", walled)
    assert prepare(path, WATERTIGHT, METHOD).levels[0].record.method == f"hollow {METHOD}"
    strict = AssetSettings(budgets=(1400,), watertight=True, gate=GateSettings(max_error_p99=1e-4))
    assert reason_of(path, strict, METHOD) == "error_over_bound"
    with pytest.raises(Rejected, match="made watertight: p99 distance .* expected <= 0.01%"):
        prepare(path, strict, METHOD)
    with pytest.raises(Rejected, match="0 edges without .*, 1 vertices where surfaces") as refusal:
        require_watertight(cleaned(TOUCHING))
    assert refusal.value.reason == "not_watertight"
    with pytest.raises(Rejected, match="3 edges without a second triangle"):
        require_watertight(cleaned(pierced(BALL, faces=1)))


def test_the_command_and_the_record(tmp_path: Path) -> None:
    assert "watertight" not in settings_record(AssetSettings())
    assert settings_record(WATERTIGHT)["watertight"] is True
    (tmp_path / "in").mkdir()
    write_obj(tmp_path / "in/a.obj", pierced(BALL, faces=2))
    words = ["assets", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--json"]
    result = trilight([*words, "--watertight", "--budget", "200"])
    assert result.exit_code == 0, result.exception
    (row,) = json.loads(result.stdout)["objects"]
    assert (row["method"], row["quality"]["open_edges"]) == (f"capped {METHOD}", 0)
    assert not row["source"]["watertight"]
    assert trimesh.load_mesh(tmp_path / "out" / row["path"]).is_watertight
