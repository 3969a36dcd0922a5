"""Procedural textures and subdivided triangles in composed scenes: they change nothing else."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.scenes.pieces import ScenePiece, emitter_piece, object_piece, shell_piece
from pipeline.scenes.shading import flat_shaded
from pipeline.scenes.subdivision import fill_triangles, subdivide
from pipeline.scenes.textured_pieces import cube_coordinates, with_drawn_textures
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Emitter, Layout, ObjectPlacement, Pose, ShellPart
from scene_templates.rooms import PATCH_FACES, SIDES, patch
from scene_templates.rotations import rotate_points
from scene_templates.settings import SceneSettings
from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.textures import TextureSettings
from storage.records.material import default_rows
from storage.records.scene import Scene, SceneObject
from storage.seeds import SceneKey
from storage.settings.changes import changed
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import LOOK, first_scene, small_pool
from tests.scene_templates.balls import STILL
from tests.scene_templates.statistics import require_plausible, share

SMALL = SurfaceMapSettings(size=8)
PLAIN = SceneSettings(families=DEFAULT_FAMILIES, num_views=1)
TEXTURED = dataclasses.replace(PLAIN, textures=TextureSettings(share=0.5, surfaces=SMALL))


def _scene(settings: SceneSettings, index: int) -> Scene:
    return first_scene(settings, small_pool(), seed=0, scene_index=index)


def test_textures_change_no_other_draw() -> None:
    for index in range(6):
        plain, textured = _scene(PLAIN, index), _scene(TEXTURED, index)
        for name in ("vertex_positions", "vertex_normals", "faces", "object_index", "c2w"):
            assert np.array_equal(getattr(plain, name), getattr(textured, name)), name
        emitting = plain.triangle_emits
        for scene in (plain, textured):
            assert np.array_equal(scene.triangle_emits, emitting)
        assert plain.uv is None and textured.provenance == plain.provenance


def test_as_many_surfaces_are_textured_as_stated() -> None:
    found = []
    for index in range(30):
        scene = _scene(TEXTURED, index)
        for row, entry in enumerate(scene.objects):
            if entry.kind == "emitter":
                continue
            mine = scene.material_index[scene.object_index == row]
            index_M3 = scene.material_textures
            found.append(index_M3 is not None and bool((index_M3[mine] >= 0).any()))
    require_plausible({"textured": share(found, 0.5)})


@for_each("side", range(6))
def test_the_sides_of_a_cube_show_a_texture_upright_and_unmirrored(side: int) -> None:
    axis, sign = side // 2, 1 if side % 2 == 0 else -1
    normal = sign * np.eye(3)[axis]
    up = np.array([0.0, 1, 0]) if axis == 2 else np.array([0.0, 0, 1])
    right = np.cross(up, normal)
    corners = np.array([[normal, normal + right, normal + up]])
    found = cube_coordinates(corners)[0]
    assert np.allclose(found[1] - found[0], [1, 0]) and np.allclose(found[2] - found[0], [0, 1])


def test_floors_are_one_flat_chart_of_the_stated_width() -> None:
    """Texture coordinates go with the place on the floor as one similarity: no seam, no stretch."""
    settings = changed(TEXTURED, {"textures.share": 1.0})
    for index in range(4):
        scene = _scene(settings, index)
        assert scene.uv is not None
        floor = next(row for row, entry in enumerate(scene.objects) if entry.name == "floor")
        mine = scene.object_index == floor
        places = scene.vertex_positions[scene.faces[mine].ravel()].astype(np.float64)
        uv = scene.uv.reshape(-1, 3, 2)[mine].reshape(-1, 2)
        known = np.column_stack([places[:, :2], np.ones(len(places))])
        fit, *_ = np.linalg.lstsq(known, uv.astype(np.float64), rcond=None)
        assert np.abs(known @ fit - uv).max() < 1e-5  # float32 coordinates
        lengths = np.linalg.norm(fit[:2], axis=0)
        assert np.isclose(lengths[0], lengths[1], rtol=1e-4) and np.linalg.det(fit[:2]) > 0
        assert 1 / 1.6 - 1e-3 <= lengths[0] <= 1 / 0.4 + 1e-3


def test_an_objects_texture_turns_with_it() -> None:
    """The same box has the same coordinates however it is posed, but for float32."""
    corners = np.eye(3)[[[0, 1, 2], [2, 1, 0]]] + np.arange(3) * 0.1
    found = []
    for rotation in (np.eye(3), Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()):
        centre = np.array([0.3, -0.2, 0.5])
        placed = rotate_points(corners.reshape(-1, 3), rotation) + centre
        faces = np.arange(6, dtype=np.uint32).reshape(-1, 3)
        piece = ScenePiece(
            entry=SceneObject(name="box", kind="object"),
            mesh=flat_shaded(placed.astype(np.float32), faces),
            materials=default_rows(1),
            material_index=np.zeros(2, np.int64),
        )
        pose = Pose(centre=centre, radius=1.0, rotation=rotation)
        placement = ObjectPlacement(pose=pose, surface=LOOK)
        layout = Layout(shell=(), objects=(placement,), emitters=())
        textures = TextureSettings(share=1.0, surfaces=SMALL)
        (textured,) = with_drawn_textures([piece], layout, textures, SceneKey(0, 0))
        assert textured.skin is not None
        found.append(textured.skin.uv)
    assert np.abs(found[0] - found[1]).max() < 1e-5


def test_an_objects_texture_is_never_mirrored_and_hardly_stretched() -> None:
    scene = _scene(changed(TEXTURED, {"textures.share": 1.0}), 1)
    assert scene.uv is not None and scene.material_textures is not None
    row = next(row for row, entry in enumerate(scene.objects) if entry.kind == "object")
    mine = scene.object_index == row
    corners = scene.vertex_positions[scene.faces[mine]].astype(np.float64)
    uv = scene.uv.reshape(-1, 3, 2)[mine].astype(np.float64)
    edges, steps = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    on_surface = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    on_texture = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    ratio = on_texture / on_surface
    # A projection shrinks areas by the cosine to the nearest of six directions: at least 1/sqrt(3).
    assert (ratio > 0).all() and ratio.max() / ratio.min() < np.sqrt(3) * 1.01


ROUNDING = 1e-6
"""Positions below 1 are float32, good to 6e-8; areas and distances are a few sums of them."""


def _piece(mesh: trimesh.Trimesh, *, smooth: bool) -> ScenePiece:
    entry = SceneObject(name="it", kind="object", uid="made/it")
    positions = (0.5 * mesh.vertices).astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    rng = np.random.default_rng(0)
    look = dataclasses.replace(LOOK, smooth=smooth, colours="triangles" if smooth else "one")
    return object_piece(entry, positions, faces, look, rng, 30.0)


def _open_and_odd() -> trimesh.Trimesh:
    """Three sheets on one edge, which no two-sided surface has, and a needle beside them."""
    sheets = np.array([[0, 0, 0], [1, 0, 0], [0.4, 1, 0], [0.5, -0.2, 1], [0.3, -0.9, -0.4]])
    needle = np.array([[0, 0, 2], [3, 0, 2], [3, 1e-3, 2]])
    faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4], [5, 6, 7]]
    return trimesh.Trimesh(np.concatenate([sheets, needle]), faces, process=False)


CLOSED = {
    "box": trimesh.creation.box(extents=(1, 2, 0.5)),
    "ball": trimesh.creation.icosphere(1),
    "ring": trimesh.creation.torus(0.5, 0.2, 9, 7),
    "cone": trimesh.creation.cone(0.5, 1, sections=11),
}
ALL = {**CLOSED, "odd": _open_and_odd()}

COUNTS = (13, 200, 701)


def _corners(piece: ScenePiece) -> NDArray[np.float64]:
    return piece.mesh.positions[piece.mesh.faces].astype(np.float64)


def _areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(np.linalg.norm(cross, axis=1) / 2)


def _edges(piece: ScenePiece) -> dict[frozenset[bytes], int]:
    """How many faces each edge has, by the bytes of its ends: as a renderer meets them."""
    found: dict[frozenset[bytes], int] = {}
    positions = piece.mesh.positions + np.float32(0)  # one zero, not two
    for face in piece.mesh.faces:
        ends = [positions[vertex].tobytes() for vertex in face]
        for pair in zip(ends, ends[1:] + ends[:1], strict=True):
            found[frozenset(pair)] = found.get(frozenset(pair), 0) + 1
    return found


def test_the_number_is_met_to_within_one_edge_and_what_was_closed_stays_closed() -> None:
    """No vertex in the middle of a neighbour's edge: through such a seam light may leak."""
    for name, smooth in itertools.product(ALL, (False, True)):
        piece = _piece(ALL[name], smooth=smooth)
        had, edges = len(piece.mesh.faces), set(_edges(piece).values())
        assert edges == {2} or name not in CLOSED
        for count in COUNTS:
            after = subdivide(piece, count)
            where = (name, smooth, count)
            if count <= had:
                assert len(after.mesh.faces) == had, where
            else:
                assert count - max(edges) < len(after.mesh.faces) <= count, where
            assert set(_edges(after).values()) == {2} or name not in CLOSED, where


@for_each("name", ALL)
def test_the_surface_stays_where_it_is_with_its_materials(name: str) -> None:
    """Each part lies in one old triangle: in its plane, inside it, of its material and side."""
    piece = _piece(ALL[name], smooth=True)
    after = subdivide(piece, 200)
    old, new = _corners(piece), _corners(after)
    assert abs(_areas(new).sum() / _areas(old).sum() - 1) < ROUNDING
    owner = np.array([_owner(old, corners) for corners in new])
    assert (np.bincount(owner, minlength=len(old)) > 0).all()
    assert np.array_equal(piece.materials, after.materials)
    assert np.array_equal(piece.material_index[owner], after.material_index)
    assert np.array_equal(piece.mesh.groups[owner], after.mesh.groups)
    for row, area in enumerate(_areas(old)):
        assert abs(_areas(new)[owner == row].sum() - area) < ROUNDING
    facing = np.sum(_unit_normals(old)[owner] * _unit_normals(new), axis=1)
    # The needle is 0.5 mm wide: rounding of 6e-8 turns its smallest parts by a few 1e-4.
    assert facing.min() > 0.999


def _unit_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(cross / np.linalg.norm(cross, axis=1, keepdims=True))


def _owner(old: NDArray[np.float64], corners: NDArray[np.float64]) -> int:
    """The old triangle that holds all three corners, by barycentric coordinates and height."""
    normal = _unit_normals(old)
    a, b, c = old[:, 0], old[:, 1], old[:, 2]
    worst = np.zeros(len(old))
    doubled = 2 * _areas(old)
    for point in corners:
        height = np.abs(np.sum((point - a) * normal, axis=1))
        inside = [
            np.sum(np.cross(q - p, point - p) * normal, axis=1) / doubled
            for p, q in ((a, b), (b, c), (c, a))
        ]
        # In units of the triangle a rounding of 1e-7 is 2e-4 of the needle's width.
        outside = np.maximum(-np.min(inside, axis=0) - 1e-3, 0)
        worst = np.maximum(worst, height + outside)
    nearest = int(worst.argmin())
    assert worst[nearest] < ROUNDING
    return nearest


def test_an_edge_of_three_faces_is_halved_in_all_three() -> None:
    piece = _piece(_open_and_odd(), smooth=False)
    after = _edges(subdivide(piece, 900))
    before = list(_edges(piece).values())
    assert before.count(3) == 1
    assert list(after.values()).count(3) >= 8
    assert set(after.values()) == {1, 2, 3}


@pytest.mark.parametrize("name", ["ball", "ring"])
def test_shading_stays_as_it_was(name: str) -> None:
    """Normals are unit, and in the middle of an edge the mean of its ends: as interpolated."""
    piece = _piece(CLOSED[name], smooth=True)
    after = subdivide(piece, 600)
    assert np.abs(np.linalg.norm(after.mesh.normals, axis=1) - 1).max() < ROUNDING
    # The vertices of before come first; of a sharp edge there are several in one place.
    before = len(piece.mesh.positions)
    assert np.array_equal(after.mesh.positions[:before], piece.mesh.positions)
    assert np.abs(after.mesh.normals[:before] - piece.mesh.normals).max() < ROUNDING
    flat = subdivide(_piece(CLOSED[name], smooth=False), 600)
    geometric = _unit_normals(_corners(flat))
    assert np.abs(flat.mesh.normals[flat.mesh.faces] - geometric[:, None]).max() < 1e-4


def test_the_longest_edges_are_halved_first() -> None:
    """A plank of twelve long triangles gets ever shorter ones."""
    piece = _piece(trimesh.creation.box(extents=(4, 0.2, 0.2)), smooth=False)
    before = np.inf
    for count in (50, 200, 1000):
        corners = _corners(subdivide(piece, count))
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        assert edges.max() < before / 1.5
        before = edges.max()
    assert before < 4.005 / 20  # of the diagonal of the plank as it was


def _shell() -> ScenePiece:
    part = ShellPart(
        name="floor",
        positions=patch(SIDES["floor"], STILL),
        faces=PATCH_FACES,
        surface=LOOK,
    )
    return shell_piece(part, np.random.default_rng(0), 30.0)


def _light() -> ScenePiece:
    triangle = np.array([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2.0]])
    return emitter_piece(
        Emitter(triangle=triangle, radiance_rgb=(9.0, 9.0, 9.0), reflectance=0.0), 0
    )


@pytest.mark.parametrize("fill_to", [1000, 2048])
def test_a_scene_is_filled_by_its_objects_alone(fill_to: int) -> None:
    pieces = [_shell(), _piece(CLOSED["box"], smooth=False), _piece(CLOSED["ball"], smooth=True)]
    pieces.append(_light())
    after = fill_triangles(pieces, fill_to)
    assert [after[0], after[3]] == [pieces[0], pieces[3]]
    total = sum(len(piece.mesh.faces) for piece in after)
    # Short by less than the two faces of an edge for each object, and by what its share rounds off.
    assert fill_to - 2 * 3 < total <= fill_to
    box, ball = (len(piece.mesh.faces) for piece in after[1:3])
    # In proportion to what they had, 12 and 80, to the same few.
    assert abs(box / (box + ball) - 12 / 92) < 4 / fill_to


def test_nothing_to_fill_stays_as_it_is() -> None:
    bare = [_shell(), _light()]
    assert fill_triangles(bare, 5000) == bare
    full = [_shell(), _piece(CLOSED["ball"], smooth=False)]
    same = fill_triangles(full, 208)
    assert [len(piece.mesh.faces) for piece in same] == [128, 80]
    assert np.array_equal(_corners(same[1]), _corners(full[1]))
    assert dataclasses.replace(same[1].entry) == full[1].entry
