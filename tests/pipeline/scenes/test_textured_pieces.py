"""Textures, materials and light of objects, and subdivided triangles: nothing else changes."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from model.hits.textures import surface_textures
from pipeline.scenes.compose import fill_triangles, subdivide
from pipeline.scenes.pieces import (
    ScenePiece,
    Skin,
    concatenate_pieces,
    cube_coordinates,
    emitter_piece,
    source_skins,
    with_drawn_textures,
    with_source_emission,
)
from pipeline.scenes.redrawn import with_new_lights
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.layout import Emitter, Layout, ObjectPlacement, Pose
from scene_templates.rotations import rotate_points
from scene_templates.scene_maps import TextureSettings
from scene_templates.settings import SceneSettings
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings
from storage.conventions import look_at_c2w
from storage.errors import Rejected
from storage.records.asset import Level, LevelSkin, SkinQuality
from storage.records.lookup import texture_values
from storage.records.material import EMISSION
from storage.records.objects import locked_uids
from storage.records.packed_maps import pack_map
from storage.records.passes import view_passes
from storage.records.retextured import without_constant_textures, without_normal_maps
from storage.records.scene import Scene
from storage.records.scene_facts import texture_families
from storage.records.scene_file import scene_digest
from storage.records.texture import Texture
from storage.seeds import SceneKey
from storage.settings.overrides import apply_overrides
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import prepare
from tests.pipeline.assets.source_materials.textured_kit import (
    CORNERS,
    KEEP,
    QUARTERS,
    picture_bytes,
    textured_glb,
)
from tests.pipeline.scenes.small_pool import (
    LOOK,
    first_scene,
    floor_piece,
    piece_of,
    pooled,
    small_pool,
)
from tests.scene_templates.balls import DEFAULTS
from tests.scene_templates.statistics import require_plausible, share
from tests.textured_by_hand import bumps

SMALL = SurfaceMapSettings(size=8)
PLAIN = dataclasses.replace(DEFAULTS, num_views=1)
TEXTURED = dataclasses.replace(PLAIN, textures=TextureSettings(share=0.5, surfaces=SMALL))
OWN = apply_overrides(PLAIN, {"materials.source": "object"})
GLOWS = apply_overrides(OWN, {"materials.own_emission": 0.5})
QUALITY = SkinQuality(
    colour_error=0.0,
    colour_error_p95=0.0,
    missed_cells=0.0,
    torn_seams=0.0,
    texels_per_length=1.0,
)


def _scene(settings: SceneSettings, index: int, pool: list[PooledAsset] | None = None) -> Scene:
    return first_scene(settings, pool or small_pool(), seed=0, scene_index=index)


def _skinned(level: Level, seed: int = 0, every: int = 0, *, mapped: bool = False) -> Level:
    """Return a level with noise on it, whose every so-manieth triangle emits, ever redder."""
    drawn = np.random.default_rng(seed).uniform(0, 0.5, (4, 4, 7)).astype(np.float32)
    parts = {"diffuse": slice(0, 3), "specular": slice(3, 6), "roughness": slice(6, 7)}
    packed = {name: pack_map(Texture(texels=drawn[..., part])) for name, part in parts.items()}
    if mapped:
        packed["normal"] = pack_map(bumps(seed))
    uv = np.random.default_rng(seed).random((len(level.faces), 3, 2)).astype(np.float32)
    skin = LevelSkin(uv=uv, packed=packed, quality=QUALITY)
    if every:
        emission = np.zeros((len(level.faces), 3), np.float32)
        emission[::every] = np.linspace([1, 0.5, 0.2], [3, 0.1, 0], len(emission[::every]))
        skin = dataclasses.replace(skin, emission=emission)
    return dataclasses.replace(level, skin=skin)


def _pool(every: int = 0, *, mapped: bool = False) -> list[PooledAsset]:
    """All but the first object have a skin at every level."""
    bare, *others = small_pool()
    skinned = [bare]
    for seed, entry in enumerate(others):
        levels = tuple(_skinned(each, seed, every, mapped=mapped) for each in entry.asset.levels)
        asset = dataclasses.replace(entry.asset, levels=levels)
        skinned.append(dataclasses.replace(entry, asset=asset))
    return skinned


def test_textures_and_own_materials_change_no_other_draw() -> None:
    for index in range(5):
        plain, drawn = (_scene(settings, index) for settings in (PLAIN, TEXTURED))
        own = _scene(OWN, index, _pool())
        for scene in (drawn, own):
            for name in ("vertex_positions", "vertex_normals", "faces", "object_index", "c2w"):
                assert np.array_equal(getattr(plain, name), getattr(scene, name)), name
            assert np.array_equal(scene.triangle_emits, plain.triangle_emits)
        assert plain.uv is None and drawn.provenance == plain.provenance
        assert own.material_textures is not None
        for row, entry in enumerate(own.objects):
            mine = own.object_index == row
            textured = (own.material_textures[own.material_index[mine]] >= 0).any()
            assert textured == (entry.kind == "object" and entry.uid != "made/ball"), entry
            if not textured:
                before = plain.materials[plain.material_index[mine]]
                assert np.array_equal(before, own.materials[own.material_index[mine]])


def test_as_many_surfaces_and_objects_are_textured_as_stated() -> None:
    drawn = []
    for index in range(30):
        scene = _scene(TEXTURED, index)
        for row, entry in enumerate(scene.objects):
            if entry.kind != "emitter":
                mine = scene.material_index[scene.object_index == row]
                textures = scene.material_textures
                drawn.append(textures is not None and bool((textures[mine] >= 0).any()))
    some = apply_overrides(OWN, {"materials.own_share": 0.3})
    entries = _pool()[1:]
    levels = [entry.asset.levels[0] for entry in entries]
    own = []
    for index in range(60):
        key = SceneKey(0, index)
        own += [skin is not None for skin in source_skins(entries, levels, some.materials, key)]
        assert all(source_skins(entries, levels, OWN.materials, key))
    require_plausible({"textured": share(drawn, 0.5), "own": share(own, 0.3)})


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
    settings = apply_overrides(TEXTURED, {"textures.share": 1.0})
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
        piece = piece_of(placed.astype(np.float32), np.arange(6, dtype=np.uint32).reshape(-1, 3))
        pose = Pose(centre=centre, radius=1.0, rotation=rotation)
        placement = ObjectPlacement(pose=pose, surface=LOOK)
        layout = Layout(shell=(), objects=(placement,), emitters=())
        textures = TextureSettings(share=1.0, surfaces=SMALL)
        (textured,) = with_drawn_textures([piece], layout, textures, SceneKey(0, 0))
        assert textured.skin is not None
        found.append(textured.skin.uv)
    assert np.abs(found[0] - found[1]).max() < 1e-5


ROUNDING = 1e-6
"""Positions below 1 are float32, good to 6e-8; areas and distances are a few sums of them."""


def _piece(mesh: trimesh.Trimesh, *, smooth: bool) -> ScenePiece:
    positions, faces = (0.5 * mesh.vertices).astype(np.float32), mesh.faces.astype(np.uint32)
    look = dataclasses.replace(LOOK, smooth=smooth, colours="triangles" if smooth else "one")
    return piece_of(positions, faces, look)


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


def _corners(piece: ScenePiece) -> NDArray[np.float64]:
    return piece.mesh.positions[piece.mesh.faces].astype(np.float64)


def _faces_of_edges(piece: ScenePiece) -> list[int]:
    """How many faces each edge has, by the places of its ends: as a renderer meets them."""
    corners = piece.mesh.positions[piece.mesh.faces].reshape(-1, 3)
    rows = np.unique(corners, axis=0, return_inverse=True)[1].reshape(-1, 3)
    ends = np.sort(np.stack([rows, np.roll(rows, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_counts=True)[1].tolist()


def test_the_number_is_met_to_within_one_edge_and_what_was_closed_stays_closed() -> None:
    """No vertex in the middle of a neighbour's edge: through such a seam light may leak."""
    for name, smooth, count in itertools.product(ALL, (False, True), (13, 200, 701)):
        piece = _piece(ALL[name], smooth=smooth)
        had, edges = len(piece.mesh.faces), set(_faces_of_edges(piece))
        after, where = subdivide(piece, count), (name, smooth, count)
        if count <= had:
            assert len(after.mesh.faces) == had, where
        else:
            assert count - max(edges) < len(after.mesh.faces) <= count, where
        assert name not in CLOSED or edges == set(_faces_of_edges(after)) == {2}, where
    odd = _piece(ALL["odd"], smooth=False)  # an edge of three faces is halved in all three
    before, halved = map(_faces_of_edges, (odd, subdivide(odd, 900)))
    assert before.count(3) == 1 and halved.count(3) >= 8 and set(halved) == {1, 2, 3}


@for_each("name", ALL)
def test_the_surface_stays_where_it_is_with_its_materials(name: str) -> None:
    """Each part lies in one old triangle: in its plane, inside it, of its material and side."""
    piece = _piece(ALL[name], smooth=True)
    after = subdivide(piece, 200)
    old, new = _corners(piece), _corners(after)
    assert abs(trimesh.triangles.area(new).sum() / trimesh.triangles.area(old).sum() - 1) < ROUNDING
    owner = np.array([_owner(old, corners) for corners in new])
    assert (np.bincount(owner, minlength=len(old)) > 0).all()
    assert np.array_equal(piece.materials, after.materials)
    assert np.array_equal(piece.material_index[owner], after.material_index)
    assert np.array_equal(piece.mesh.groups[owner], after.mesh.groups)
    for row, area in enumerate(trimesh.triangles.area(old)):
        assert abs(trimesh.triangles.area(new)[owner == row].sum() - area) < ROUNDING
    facing = np.sum(_unit_normals(old)[owner] * _unit_normals(new), axis=1)
    # The needle is 0.5 mm wide: rounding of 6e-8 turns its smallest parts by a few 1e-4.
    assert facing.min() > 0.999


def _unit_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    cross = trimesh.triangles.cross(corners)
    return np.asarray(cross / np.linalg.norm(cross, axis=1, keepdims=True))


def _owner(old: NDArray[np.float64], corners: NDArray[np.float64]) -> int:
    """The old triangle that holds all three corners."""
    distances = [
        np.linalg.norm(trimesh.triangles.closest_point(old, points) - points, axis=1)
        for points in np.repeat(corners[:, None], len(old), axis=1)
    ]
    worst = np.max(distances, axis=0)
    nearest = int(worst.argmin())
    assert worst[nearest] < ROUNDING
    return nearest


def test_shading_stays_as_it_was() -> None:
    """Normals are unit, and in the middle of an edge the mean of its ends: as interpolated."""
    for name in ("ball", "ring"):
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


def test_a_scene_is_filled_by_its_objects_alone() -> None:
    floor = floor_piece(LOOK, np.random.default_rng(0))
    lamp = _lamp(np.array([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2.0]]), (9.0, 9.0, 9.0))
    box, ball = _piece(CLOSED["box"], smooth=False), _piece(CLOSED["ball"], smooth=True)
    pieces = [floor, box, ball, lamp]
    for fill_to in (1000, 2048):
        after = fill_triangles(pieces, fill_to)
        assert [after[0], after[3]] == [pieces[0], pieces[3]]
        first, second = (len(piece.mesh.faces) for piece in after[1:3])
        # Short by less than the two faces of an edge for each object, and by what its share
        # rounds off.
        assert fill_to - 2 * 3 < 128 + first + second + 1 <= fill_to
        # In proportion to what they had, 12 and 80, to the same few.
        assert abs(first / (first + second) - 12 / 92) < 4 / fill_to
    bare = [floor, lamp]
    assert fill_triangles(bare, 5000) == bare
    same = fill_triangles([floor, ball], 208)
    assert [len(piece.mesh.faces) for piece in same] == [128, 80]
    assert np.array_equal(_corners(same[1]), _corners(ball)) and same[1].entry == ball.entry


def test_textures_have_the_rights_and_the_means_of_their_objects() -> None:
    scene = _scene(OWN, 1, _pool())
    owners = {entry.uid: entry for entry in scene.objects if entry.uid}
    assert scene.textures and scene.material_textures is not None
    for texture in scene.textures:
        owner, source = owners[texture.source.name.rsplit(" ", 1)[0]], texture.source
        for name in ("licence", "attribution", "source_url"):
            assert getattr(source, name) == getattr(owner, name), name
    both = apply_overrides(OWN, {"textures.share": 1.0, "textures.surfaces.size": 8})
    drawn = _scene(both, 1, _pool())
    assert {texture.source.name.startswith("made/") for texture in drawn.textures} == {True, False}
    assert {texture.sha256 for texture in scene.textures} <= {t.sha256 for t in drawn.textures}
    row = int(np.flatnonzero(scene.material_textures[:, 0] >= 0)[0])
    texture = scene.textures[scene.material_textures[row, 0]]
    assert np.array_equal(scene.materials[row, :3], texture.mean)
    assert texture_values(texture, np.zeros(2)).shape == (3,)


def test_an_object_whose_textures_break_a_law_costs_scenes_by_its_name() -> None:
    entries, level = _pool()[1:2], _skinned(small_pool()[1].asset.levels[0])
    assert level.skin is not None
    broken = pack_map(Texture(texels=np.full((1, 1, 3), np.nan, np.float32)))
    skin = dataclasses.replace(level.skin, packed={**level.skin.packed, "diffuse": broken})
    levels = [dataclasses.replace(level, skin=skin)]
    with pytest.raises(Rejected, match=f"^law_broken: object {entries[0].locked.uid}: .*diffuse"):
        source_skins(entries, levels, OWN.materials, SceneKey(0, 0))


def test_a_normal_map_comes_with_the_rights_of_its_object_and_changes_nothing_else() -> None:
    """Networks read the same surfaces, and parts without a map say so."""
    plain, scene = _scene(OWN, 1, _pool()), _scene(OWN, 1, _pool(mapped=True))
    scene.check()
    assert scene.normal_textures is not None and scene.material_textures is not None
    textured = (scene.material_textures >= 0).all(axis=1)
    assert textured.any() and np.array_equal(scene.normal_textures >= 0, textured)
    for row in scene.normal_textures[textured]:
        assert scene.textures[row].source.name.endswith(" normal")
    assert texture_families(scene) == texture_families(plain)
    assert scene_digest(without_normal_maps(scene)) == scene_digest(plain)
    triangle, weights = np.arange(scene.num_triangles), np.full((3, scene.num_triangles), 1 / 3)
    columns = plain.materials[plain.material_index]
    ours, theirs = map(surface_textures, (scene, plain))
    assert ours is not None and theirs is not None
    wanted = theirs.materials(triangle, weights, columns)
    assert np.array_equal(ours.materials(triangle, weights, columns), wanted)


def test_subdivision_moves_no_colour() -> None:
    level = _skinned(small_pool()[1].asset.levels[0])
    assert level.skin is not None
    entries = [pooled("a", [trimesh.creation.box()])]
    (skin,) = source_skins(entries, [level], OWN.materials, SceneKey(0, 0))
    assert skin is not None
    whole = piece_of(level.positions, level.faces, skin=skin)
    more = subdivide(whole, 100)
    assert more.skin is not None and len(more.mesh.faces) > 90
    old, new = _corners(whole), _corners(more)
    owner = np.array([_owner(old, corners) for corners in new])
    weights = trimesh.triangles.points_to_barycentric(old[owner], new.mean(axis=1))
    before = skin.uv.reshape(-1, 3, 2).astype(np.float64)[owner]
    uv = more.skin.uv.reshape(-1, 3, 2).astype(np.float64).mean(axis=1)
    assert np.abs(np.einsum("tc,tcd->td", weights, before) - uv).max() < 1e-5  # float32 positions


def test_a_picture_has_the_colours_of_a_file_in_their_corners(tmp_path: Path) -> None:
    """Red at the lower left, as the file's picture has it; tracers follow these passes."""
    asset = prepare(textured_glb(tmp_path / "a.glb", picture_bytes(CORNERS)), KEEP)
    level, entry = asset.levels[0], PooledAsset(locked=small_pool()[0].locked, asset=asset)
    (skin,) = source_skins([entry], [level], OWN.materials, SceneKey(0, 0))
    assert skin is not None
    square = piece_of(level.positions, level.faces, skin=skin)
    scene = Scene(
        **concatenate_pieces([square]),
        c2w=look_at_c2w(eye=[0, -2, 0], target=[0, 0, 0], up=[0, 0, 1])[None].astype(np.float32),
        fov_deg=np.array([30], np.float32),
        objects=(square.entry,),
        provenance={"template": "none"},
    )
    for each in (scene, without_constant_textures(scene)):
        seen = view_passes(each, ["material_diffuse"], resolution=32)["material_diffuse"]
        width = 16 / (2 * np.tan(np.radians(15)))  # pixels for each metre
        for (right, up), colour in QUARTERS.items():
            there, lit = seen[int(16 - up * width), int(16 + right * width)], np.array(colour) > 0
            assert there[lit].min() > 4 * there[~lit].max(initial=0), (right, up, there)


QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def powers(scene: Scene) -> dict[bool, float]:
    """Area times mean radiance by whether an emitter is a lamp."""
    power = trimesh.triangles.area(scene.vertex_positions[scene.faces].astype(float))
    power *= scene.materials[scene.material_index, EMISSION].mean(axis=1)
    lamp = np.array([entry.is_lamp for entry in scene.objects])[scene.object_index]
    return {True: float(power[lamp].sum()), False: float(power[~lamp].sum())}


def test_parts_that_emit_give_the_stated_share_of_light() -> None:
    found = 0
    for index in range(4):
        dark, lit = _scene(OWN, index, _pool(every=4)), _scene(GLOWS, index, _pool(every=4))
        assert scene_digest(dark) == scene_digest(_scene(OWN, index, _pool())), "nobody asked"
        ours, theirs = (
            np.sort(each.vertex_positions[each.faces].reshape(-1, 9), axis=0)
            for each in (dark, lit)
        )
        assert np.array_equal(ours, theirs) and np.array_equal(dark.c2w, lit.c2w)
        own = [entry for entry in lit.objects if entry.kind == "emitter" and entry.uid]
        assert not [entry for entry in dark.objects if entry.kind == "emitter" and entry.uid]
        skinned = {entry.uid for entry in dark.objects if entry.uid} - {"made/ball"}
        assert {entry.uid for entry in own} == skinned
        owners = {entry.uid: entry for entry in lit.objects if entry.kind == "object"}
        assert all(entry.licence == owners[entry.uid].licence for entry in own)
        power = powers(lit)
        emits = lit.materials[:, EMISSION]
        lamps = [row for row, entry in enumerate(lit.objects) if entry.is_lamp]
        of_lamps = emits[lit.material_index[np.isin(lit.object_index, lamps)]]
        is_bound = emits.max() <= of_lamps.max() * (1 + 1e-6)
        assert is_bound and power[False] <= 0.5 * power[True] * (1 + 1e-5)
        found += power[False] == pytest.approx(0.5 * power[True], rel=1e-4)
        assert power[True] == pytest.approx(powers(dark)[True], rel=1e-6)
    assert found >= 2


def _object(emission: list[list[float]]) -> ScenePiece:
    """A square of two triangles that emit so much."""
    colour, number = (Texture(texels=np.full((1, 1, k), 0.1, np.float32)) for k in (3, 1))
    skin = Skin(
        uv=np.zeros((6, 2), np.float32),
        textures=(colour, colour, number),
        emission=np.array(emission, np.float32),
    )
    return piece_of(QUAD, FACES, skin=skin, name="screen")


def _lamp(corners: np.ndarray, radiance: tuple[float, float, float]) -> ScenePiece:
    emitter = Emitter(triangle=corners.astype(np.float64), radiance_rgb=radiance, reflectance=0.2)
    return emitter_piece(emitter, 0)


def test_an_emissive_triangle_is_the_same_lamp_to_the_last_bit() -> None:
    """Positions, normals and materials; pictures are a function of these."""
    lamp = _lamp(QUAD[FACES[0]] + [0, 0, 2], (8.0, 8.0, 8.0))
    piece = _object([[2, 1, 0], [0, 0, 0]])
    (left,), (own,) = with_source_emission([piece], [lamp], share=0.25)
    power = 0.25 * 8.0  # areas are equal, and (2 + 1 + 0) / 3 is 1
    ours = concatenate_pieces([own])
    twin = concatenate_pieces([_lamp(QUAD[FACES[0]], (2 * power, power, 0.0))])
    for name in ("vertex_positions", "vertex_normals", "faces", "materials", "material_index"):
        assert np.array_equal(ours[name], twin[name]), name
    assert len(left.mesh.faces) == 1 and left.skin is not None and len(left.skin.uv) == 3
    assert np.array_equal(left.mesh.positions, QUAD[FACES[1]])
    assert own.entry.kind == "emitter" and own.entry.uid == "made/screen"


def test_no_part_outshines_the_brightest_lamp_and_what_emits_stays_in_its_place() -> None:
    lamp = _lamp(QUAD[FACES[0]] * 10, (3.0, 2.0, 1.0))
    _, (own,) = with_source_emission([_object([[7, 0, 0], [0, 0, 0]])], [lamp], share=1.0)
    assert own.materials[0, EMISSION] == pytest.approx([3, 0, 0])
    pieces, more = with_source_emission([_object([[1, 0, 0], [0, 1, 0]])], [lamp], share=0.1)
    assert [piece.entry.kind for piece in pieces] == ["emitter"] and not more
    assert len(pieces[0].materials) == 2 and pieces[0].skin is None
    entry = pieces[0].entry
    assert locked_uids([(entry.kind, entry.uid), ("emitter", "")], {}) == ["made/screen"]
    # Without lamps or a share all stays dark.
    for lamps, share_ in (([_lamp(QUAD[FACES[0]], (1.0, 1.0, 1.0))], 0.0), ([], 1.0)):
        (piece,), more = with_source_emission([_object([[1, 1, 1], [0, 0, 0]])], lamps, share_)
        assert not more and len(piece.mesh.faces) == 2
        assert piece.skin is not None and piece.skin.emission is None


def test_new_lights_leave_parts_that_emit() -> None:
    scene = _scene(GLOWS, 1, _pool(every=4))
    again = with_new_lights(scene, GLOWS.lights, None, SceneKey(3, 0))
    again.check()
    before, after = (sum(entry.is_lamp for entry in each.objects) for each in (scene, again))
    assert before == after
    own, still = (
        [entry for entry in each.objects if entry.kind == "emitter" and entry.uid]
        for each in (scene, again)
    )
    assert own and still == own
    assert powers(again)[False] == pytest.approx(powers(scene)[False])
