"""Procedural textures in composed scenes: where they lie, and that they change nothing else."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.builds.named import named_build
from pipeline.scenes.pieces import ScenePiece
from pipeline.scenes.shading import flat_shaded
from pipeline.scenes.textured_pieces import cube_places, with_drawn_textures
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Layout, ObjectPlacement, Pose, SurfaceLook
from scene_templates.rotations import rotated
from scene_templates.settings import SceneSettings
from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.textures import TextureSettings
from storage.records.material import default_rows
from storage.records.scene import Scene, SceneObject
from storage.settings.changes import changed
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import first_scene, small_pool
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


def test_the_share_is_left_out_of_the_settings_where_it_is_none() -> None:
    """So that digests of builds without textures stay what they were."""
    assert "textures" not in named_build("pretrain-256").as_json()["scenes"]
    build = named_build("pretrain-256", changes={"scenes.textures.share": 0.25})
    assert build.as_json()["scenes"]["textures"]["share"] == 0.25
    assert named_build("textured-256").scenes.textures.share == 0.5
    widths = changed(PLAIN, {"textures.surfaces.size": 64}).textures.surfaces.size
    assert widths == 64


@for_each("side", range(6))
def test_the_sides_of_a_cube_show_a_texture_upright_and_unmirrored(side: int) -> None:
    axis, sign = side // 2, 1 if side % 2 == 0 else -1
    normal = sign * np.eye(3)[axis]
    up = np.array([0.0, 1, 0]) if axis == 2 else np.array([0.0, 0, 1])
    right = np.cross(up, normal)
    corners = np.array([[normal, normal + right, normal + up]])
    found = cube_places(corners)[0]
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
        placed = rotated(corners.reshape(-1, 3), rotation) + centre
        faces = np.arange(6, dtype=np.uint32).reshape(-1, 3)
        piece = ScenePiece(
            entry=SceneObject(name="box", kind="object"),
            mesh=flat_shaded(placed.astype(np.float32), faces),
            materials=default_rows(1),
            material_index=np.zeros(2, np.int64),
        )
        look = SurfaceLook(
            diffuse_scale=1.0,
            diffuse_rgb=(0, 0, 0),
            specular_rgb=(0, 0, 0),
            roughness=1.0,
            smooth=False,
            colours="one",
        )
        pose = Pose(centre=centre, radius=1.0, rotation=rotation)
        placement = ObjectPlacement(pose=pose, surface=look)
        layout = Layout(shell=(), objects=(placement,), emitters=())
        textures = TextureSettings(share=1.0, surfaces=SMALL)
        (textured,) = with_drawn_textures(
            [piece], layout, textures, seed=0, scene_index=0, attempt=0
        )
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
