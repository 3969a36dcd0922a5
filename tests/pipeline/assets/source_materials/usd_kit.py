"""The quads of the glTF and OBJ kit as USD files that another program might write."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from pipeline.foreign.mesh import TriangleMesh
from tests.pipeline.assets.source_materials.textured_kit import SQUARE, UV_UP

Change = Callable[[Usd.Stage], object]
TEXTURE, SHADER, MESH = "/W/mat/texture", "/W/mat/preview", "/W/mesh"

_TYPES = {
    "file": Sdf.ValueTypeNames.Asset,
    **dict.fromkeys(("roughness", "metallic", "ior", "rotation"), Sdf.ValueTypeNames.Float),
    "useSpecularWorkflow": Sdf.ValueTypeNames.Int,
    **dict.fromkeys(("scale", "bias"), Sdf.ValueTypeNames.Float4),
    **dict.fromkeys(("sourceColorSpace", "wrapS", "wrapT"), Sdf.ValueTypeNames.Token),
}


def usd_mesh(
    stage: Usd.Stage, mesh: TriangleMesh, path: str = MESH, *, y_up: bool = False, unit: float = 1.0
) -> Any:
    """Define a mesh of metres with +Z up in the axes and units of a stage."""
    points = mesh.positions / unit
    points = points[:, [0, 2, 1]] * [1, 1, -1] if y_up else points
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreatePointsAttr([Gf.Vec3f(*point) for point in points.tolist()])
    made.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
    made.CreateFaceVertexIndicesAttr(mesh.faces.ravel().tolist())
    return made


def new_stage(*, y_up: bool = False, unit: float = 1.0) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, "Y" if y_up else "Z")
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/W").GetPrim())
    return stage


def set_inputs(stage: Usd.Stage, path: str, values: Mapping[str, Any]) -> None:
    shader = UsdShade.Shader(stage.GetPrimAtPath(path))
    for name, value in values.items():
        shader.CreateInput(name, _TYPES.get(name, Sdf.ValueTypeNames.Color3f)).Set(value)


def coordinates(
    made: Any, values: ArrayLike, interpolation: str = "vertex", name: str = "st"
) -> None:
    primvar = UsdGeom.PrimvarsAPI(made).CreatePrimvar(
        name, Sdf.ValueTypeNames.TexCoord2fArray, interpolation
    )
    primvar.Set([Gf.Vec2f(*pair) for pair in np.asarray(values, float).tolist()])


def material(stage: Usd.Stage, made: Any, inputs: Mapping[str, Any] | None = None) -> Any:
    """Define a UsdPreviewSurface and bind it; returns its shader."""
    bound = UsdShade.Material.Define(stage, "/W/mat")
    shader = UsdShade.Shader.Define(stage, SHADER)
    shader.CreateIdAttr("UsdPreviewSurface")
    bound.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(bound)
    set_inputs(stage, SHADER, inputs or {})
    return shader


def connect_texture(
    stage: Usd.Stage, file: str, connect: Mapping[str, str] | None = None, path: str = TEXTURE
) -> None:
    """Define a UsdUVTexture and connect inputs of the shader to its outputs."""
    node = UsdShade.Shader.Define(stage, path)
    node.CreateIdAttr("UsdUVTexture")
    set_inputs(stage, path, {"file": file})
    reader = UsdShade.Shader.Define(stage, f"{path}_reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    node.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.ConnectableAPI(), "result"
    )
    shader = UsdShade.Shader(stage.GetPrimAtPath(SHADER))
    for name, output in (connect or {"diffuseColor": "rgb"}).items():
        kind = _TYPES.get(name, Sdf.ValueTypeNames.Color3f)
        shader.CreateInput(name, kind).ConnectToSource(node.ConnectableAPI(), output)


def transform_coordinates(
    stage: Usd.Stage, rotation: float, scale: tuple[float, float], move: tuple[float, float]
) -> None:
    """Put a UsdTransform2d between the texture and its coordinates."""
    node = UsdShade.Shader.Define(stage, "/W/mat/move")
    node.CreateIdAttr("UsdTransform2d")
    set_inputs(stage, "/W/mat/move", {"rotation": rotation})
    for name, pair in (("scale", scale), ("translation", move)):
        node.CreateInput(name, Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(*pair))
    reader = UsdShade.Shader(stage.GetPrimAtPath(f"{TEXTURE}_reader"))
    texture = UsdShade.Shader(stage.GetPrimAtPath(TEXTURE))
    for source, target in (
        (reader, node.CreateInput("in", Sdf.ValueTypeNames.Float2)),
        (node, texture.GetInput("st")),
    ):
        target.ConnectToSource(source.ConnectableAPI(), "result")


def textured_usd(
    path: Path,
    picture: bytes,
    change: Change | None = None,
    *,
    uv: ArrayLike = UV_UP,
    mesh: TriangleMesh = SQUARE,
    y_up: bool = False,
    unit: float = 1.0,
    connect: Mapping[str, str] | None = None,
) -> Path:
    """Write a textured mesh, its picture beside it; as a package where the name says so."""
    path.parent.mkdir(exist_ok=True)
    (path.parent / "tex.png").write_bytes(picture)
    stage = new_stage(y_up=y_up, unit=unit)
    made = usd_mesh(stage, mesh, y_up=y_up, unit=unit)
    coordinates(made, uv)
    material(stage, made)
    connect_texture(stage, "./tex.png", connect)
    if change is not None:
        change(stage)
    return exported(stage, path)


def exported(stage: Usd.Stage, path: Path) -> Path:
    if path.suffix != ".usdz":
        stage.GetRootLayer().Export(str(path))
        return path
    layer = path.with_suffix(".usdc")
    stage.GetRootLayer().Export(str(layer))
    assert UsdUtils.CreateNewUsdzPackage(str(layer), str(path))
    layer.unlink()
    (path.parent / "tex.png").unlink(missing_ok=True)
    return path
