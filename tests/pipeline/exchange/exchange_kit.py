"""A scene through one form and back, and a USD stage as another program would write it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdValidation

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from pipeline.exchange.scene_files import build_scene
from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.exchange.usd.read_usd import read_usd
from pipeline.exchange.usd.write_usd import write_usd
from storage.records.lookup import textured_rows
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from tests.pipeline.assets.source_materials.textured_kit import (
    connect_texture,
    coordinates,
    material,
    triangle_at,
)


def errors_of(stage: Any) -> list[str]:
    """Return what all of USD's validators say, but for the one thing that usd-core cannot know."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 30
    return [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in UsdValidation.ValidationContext(validators).Validate(stage)
        if not (
            error.GetName() == "MissingShaderIdInRegistry" and "shaderId 'ND_" in error.GetMessage()
        )
    ]


def build_json(folder: Path, name: str, **more: Any) -> Scene:
    """Return the scene of a RenderFormer file."""
    more = {"licence": "CC0-1.0", **more}
    return build_scene(folder.resolve(), name, AssetSettings(), **more)[0].scene


def json_and_back(scene: Scene, folder: Path) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene that our reader makes of its RenderFormer files, and what was lost."""
    lost = write_renderformer_json(folder / "again.json", scene)
    return build_json(folder, "again.json"), lost


def h5_and_back(scene: Scene, folder: Path) -> Scene:
    write_renderformer_h5(folder / "again.h5", scene)
    return read_renderformer_h5(folder / "again.h5").scene


def edited_layer(folder: Path, scene: Scene, edit: Callable[[Any], object]) -> LoadedScene:
    """Return what is read after an edit of the layer that we wrote."""
    write_usd(folder / "a.usda", scene)
    layer = Sdf.Layer.OpenAsAnonymous(str(folder / "a.usda"))
    edit(layer)
    layer.Export(str(folder / "b.usda"))
    return read_usd(folder / "b.usda")


def assert_usd_keeps_all(scene: Scene, folder: Path, suffix: str) -> None:
    """To the last bit of everything, and USD's own judges find no fault."""
    path = folder / f"again{suffix}"
    write_usd(path, scene)
    found = read_usd(path)
    assert not found.notes
    assert encode_scene(found.scene) == encode_scene(scene)
    assert errors_of(Usd.Stage.Open(str(path))) == []


def assert_json_keeps_light(back: Scene, scene: Scene) -> None:
    """All triangles with their materials to the last bit, and the cameras.

    A float32 rotation is orthonormal to 1e-7; the reader makes it so to the last bit.
    """
    assert np.array_equal(_sorted_rows(back), _sorted_rows(scene))
    assert np.array_equal(back.fov_deg, scene.fov_deg)
    assert np.array_equal(back.c2w[:, :3, 3], scene.c2w[:, :3, 3])
    assert back.c2w == pytest.approx(scene.c2w, abs=4e-7)


def assert_h5_keeps_light(back: Scene, scene: Scene) -> None:
    """To the last bit, in the order of the triangles; but for what emitters reflect."""
    for one, other in ((back.vertex_positions, scene.vertex_positions),
                       (back.vertex_normals, scene.vertex_normals)):  # fmt: skip
        assert np.array_equal(one[back.faces], other[scene.faces])
    found, want = (s.materials[s.material_index] for s in (back, scene))
    emits = scene.triangle_emits
    assert np.array_equal(found[~emits], want[~emits])
    assert np.array_equal(found[:, EMISSION], want[:, EMISSION])
    assert np.array_equal(back.c2w, scene.c2w)
    assert np.array_equal(back.fov_deg, scene.fov_deg)


def row_at(scene: Scene, x: float, y: float) -> np.ndarray:
    """Return the material row at a place of a flat scene, found by its barycentric coordinates."""
    triangle, weights = triangle_at(scene.vertex_positions[scene.faces][..., :2], x, y)
    uv = np.zeros(2) if scene.uv is None else weights @ scene.uv.reshape(-1, 3, 2)[triangle]
    row = scene.material_index[[triangle]]
    return np.asarray(textured_rows(scene, row, uv[None].astype(np.float64)))[0]


def _sorted_rows(scene: Scene) -> NDArray[np.float32]:
    """Return positions and materials [T, 19] of all triangles, sorted, corners in their order."""
    corners = scene.vertex_positions[scene.faces].reshape(-1, 9)
    rows = np.concatenate([corners, scene.materials[scene.material_index]], axis=1)
    return rows[np.lexsort(rows.T[::-1])]


L_SHAPE = ((0, 0, 0), (20, 0, 0), (20, 10, 0), (10, 10, 0), (10, 20, 0), (0, 20, 0))
"""Centimetres; 0.03 square metres. It is not convex, and a fan from its fourth corner on, as below,
would cover what is outside."""


def write_stage(folder: Path, name: str = "stage.usda", sphere: bool = False) -> Path:
    """Write the stage and its texture, with a sphere of 1280 triangles if asked."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4], pixels[:, 4:] = [255, 0, 0], [0, 188, 0]
    Image.fromarray(pixels).save(folder / "tex.png")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/W").GetPrim())
    _grid(stage)
    _lights(stage)
    _instances(stage)
    if sphere:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=30)
        mesh(stage, "/W/ball", ball.vertices.tolist(), [3] * 1280, ball.faces.ravel().tolist())
    camera = UsdGeom.Camera.Define(stage, "/W/cam")
    camera.CreateFocalLengthAttr(50)
    camera.CreateHorizontalApertureAttr(36)
    camera.CreateVerticalApertureAttr(36)
    UsdGeom.Xformable(camera).AddTranslateOp().Set((0, 50, 300))
    stage.GetRootLayer().Export(str(folder / name))
    return folder / name


def mesh(stage: Any, path: str, points: Any, counts: list[int], indices: list[int]) -> Any:
    """Define a mesh of polygons with flat faces."""
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreatePointsAttr([Gf.Vec3f(*point) for point in points])
    made.CreateFaceVertexCountsAttr(counts)
    made.CreateFaceVertexIndicesAttr(indices)
    made.CreateSubdivisionSchemeAttr("none")
    return made


def _grid(stage: Any) -> None:
    corners = ((-100, 0, -100), (100, 0, -100), (100, 0, 100), (-100, 0, 100))
    grid = mesh(stage, "/W/Grid", corners, [4], [0, 3, 2, 1])
    coordinates(grid, [(0, 0), (1, 0), (1, 1), (0, 1)])
    material(stage, grid, {"roughness": 0.3})
    connect_texture(stage, "./tex.png")


def _lights(stage: Any) -> None:
    rect = UsdLux.RectLight.Define(stage, "/W/rect")
    rect.CreateWidthAttr(50)
    rect.CreateHeightAttr(20)
    rect.CreateIntensityAttr(10)
    rect.CreateExposureAttr(1)
    UsdGeom.Xformable(rect).AddTranslateOp().Set((0, 150, 0))
    UsdGeom.Xformable(rect).AddRotateXOp().Set(-90)
    sphere = UsdLux.SphereLight.Define(stage, "/W/sphere")
    sphere.CreateRadiusAttr(10)
    sphere.CreateIntensityAttr(3)
    sphere.CreateNormalizeAttr(True)
    disk = UsdLux.DiskLight.Define(stage, "/W/disk")
    disk.CreateRadiusAttr(20)
    disk.CreateColorAttr((1, 0.5, 0.25))
    UsdLux.DomeLight.Define(stage, "/W/dome")
    lamp = mesh(stage, "/W/lamp", ((0, 90, 0), (0, 90, 10), (10, 90, 0)), [3], [0, 1, 2])
    UsdLux.MeshLightAPI.Apply(lamp.GetPrim())
    UsdLux.LightAPI(lamp).CreateIntensityAttr(7)


def _instances(stage: Any) -> None:
    mesh(stage, "/W/many/proto/L", L_SHAPE, [6], [3, 4, 5, 0, 1, 2])
    many = UsdGeom.PointInstancer.Define(stage, "/W/many")
    many.CreatePrototypesRel().AddTarget("/W/many/proto")
    many.CreateProtoIndicesAttr([0, 0, 0])
    many.CreatePositionsAttr([(0, 10, 0), (30, 10, 0), (60, 10, 0)])
    mirrored = UsdGeom.Xform.Define(stage, "/W/mirrored")
    mirrored.GetPrim().GetReferences().AddInternalReference("/W/many/proto")
    mirrored.GetPrim().SetInstanceable(True)
    UsdGeom.Xformable(mirrored).AddScaleOp().Set((-1, 1, 1))
    hidden = mesh(stage, "/W/hidden", L_SHAPE, [6], [0, 1, 2, 3, 4, 5])
    hidden.CreateVisibilityAttr("invisible")
    guide = mesh(stage, "/W/guide", L_SHAPE, [6], [0, 1, 2, 3, 4, 5])
    guide.CreatePurposeAttr("guide")
