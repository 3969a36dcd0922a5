"""A USD stage as another program would write it: centimetres, Y up, quads, a texture, instances."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

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
    coordinates = UsdGeom.PrimvarsAPI(grid).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex"
    )
    coordinates.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    material = UsdShade.Material.Define(stage, "/W/mat")
    shader = UsdShade.Shader.Define(stage, "/W/mat/preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    texture = UsdShade.Shader.Define(stage, "/W/mat/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./tex.png")
    reader = UsdShade.Shader.Define(stage, "/W/mat/reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.ConnectableAPI(), "result"
    )
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        texture.ConnectableAPI(), "rgb"
    )
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.3)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(grid.GetPrim()).Bind(material)


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
