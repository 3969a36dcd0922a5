"""Quads with pictures, as glTF and OBJ files by hand, and as USD files of another program."""

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.records.asset import Asset, Level
from storage.records.lookup import texture_values
from tests.pipeline.assets.meshes_by_hand import gltf_tree, prepare, write_glb
from tests.pipeline.foreign.gltf.gltf_writer import GltfWriter

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
CORNERS = np.array([[BLUE, WHITE], [RED, GREEN]], np.uint8)
"""[2, 2, 3] the top row first: red at the lower left, green at the lower right."""
QUARTERS = {(-0.25, -0.25): RED, (0.25, -0.25): GREEN, (-0.25, 0.25): BLUE, (0.25, 0.25): WHITE}
"""Colour by place: to the right and up, on a square of width 1."""

SQUARE = TriangleMesh(
    positions=np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]]),
    faces=np.array([[0, 1, 2], [0, 2, 3]]),
)
"""It stands upright and looks to the front, -y: x goes to the right and z up."""
UV_UP = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
"""[4, 2] of its corners, v up."""

F = 0.04 + 0.96 / 21
"""Specular albedo of an ordinary dielectric: the mean of Schlick's term for F0 = 0.04."""
STORED = 0.006
"""Half a step of 8 bits in sRGB near white."""
SLOPE = 0.04
"""Colours of two texels change by 2 over the width, and texels are inset by a quarter of a cell of
a sixteenth of it; a wrong corner is off by 0.9."""

OWN = OwnMaterialSettings(keep=True, texels=16)
KEEP = AssetSettings(own_materials=OWN)
REFUSE = AssetSettings(own_materials=OwnMaterialSettings(keep=True, texels=16, if_lost="reject"))


def picture_bytes(values: NDArray, kind: str = "PNG", mode: str | None = None) -> bytes:
    """Return a picture [H, W, C] or [H, W], the top row first, as a file."""
    file = io.BytesIO()
    image = Image.fromarray(values)
    (image if mode is None else image.convert(mode)).save(file, kind)
    return file.getvalue()


def textured_tree(
    picture: bytes | str,
    uv_up: ArrayLike | None = UV_UP,
    mesh: TriangleMesh = SQUARE,
    tangents: ArrayLike | None = None,
) -> tuple[dict[str, Any], bytes]:
    """Return a glTF of a mesh with a picture, embedded or by its URI."""
    tree, buffer = gltf_tree(mesh)
    file = GltfWriter(tree=tree, data=bytearray(buffer))
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    tree["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}
    ]
    tree["textures"] = [{"source": 0}]
    if uv_up is not None:
        uv = np.asarray(uv_up, np.float64) * [1, -1] + [0, 1]  # glTF has v down
        primitive["attributes"]["TEXCOORD_0"] = file.accessor(uv, "f4")
    if tangents is not None:
        primitive["attributes"]["TANGENT"] = file.accessor(np.asarray(tangents), "f4")
    tree["images"] = [{"uri": picture}]
    if isinstance(picture, bytes):
        tree["images"] = [{"bufferView": file.view(picture), "mimeType": "image/png"}]
    tree["buffers"][0]["byteLength"] = len(file.data)
    return tree, bytes(file.data)


def textured_glb(
    path: Path, picture: bytes | str, uv_up: ArrayLike | None = UV_UP, mesh: TriangleMesh = SQUARE
) -> Path:
    return write_glb(path, *textured_tree(picture, uv_up, mesh))


def textured_gltf(path: Path, picture: bytes | str) -> Path:
    """Write a .gltf with its buffer beside it."""
    tree, buffer = textured_tree(picture)
    path.with_suffix(".bin").write_bytes(buffer)
    tree["buffers"][0]["uri"] = path.with_suffix(".bin").name
    path.write_text(json.dumps(tree))
    return path


def textured_obj(path: Path, picture: bytes, mtl: str = "map_Kd its picture.png\n") -> Path:
    """Write an OBJ, its MTL and the picture of that, in a folder of their own."""
    path.parent.mkdir(exist_ok=True)
    (path.parent / "its picture.png").write_bytes(picture)
    (path.parent / "a.mtl").write_text(f"newmtl it is\n{mtl}")
    rows = [f"v {x} {y} {z}\n" for x, y, z in SQUARE.positions]
    rows += [f"vt {u} {v}\n" for u, v in UV_UP]
    rows += ["usemtl it is\n", "f 1/1 2/2 3/3\n", "f 1/1 3/3 4/4\n"]
    path.write_text("mtllib a.mtl\n" + "".join(rows))
    return path


def triangle_at(
    triangles: NDArray[np.float32], x: float, y: float
) -> tuple[int, NDArray[np.float64]]:
    """Return the flat triangle [T, 3, 2] at a place, and the weights [3] of its corners."""
    for face, corners in enumerate(triangles):
        flat = np.vstack([corners.T, np.ones(3)])
        weights = np.linalg.solve(flat.astype(np.float64), [x, y, 1.0])
        if (weights >= -1e-9).all():
            return face, np.asarray(weights, np.float64)
    raise AssertionError(f"no triangle at {x}, {y}")


def find_triangle(level: Level, right: float, up: float) -> tuple[int, NDArray[np.float64]]:
    """Return the triangle of an upright square at a place, and the weights [3] of its corners."""
    return triangle_at(level.positions[level.faces][..., [0, 2]], right, up)


def seen_at(asset: Asset, right: float, up: float, column: int = 0) -> NDArray[np.float64]:
    """Return what the finest level of an upright square shows at a place."""
    level = asset.levels[0]
    assert level.skin is not None, asset.materials
    face, weights = find_triangle(level, right, up)
    return texture_values(level.skin.textures[column], weights @ level.skin.uv[face])


def shown(colour: ArrayLike) -> NDArray[np.float64]:
    """Return the diffuse part of a dielectric of a colour that is 0 or 255."""
    return np.asarray(colour) / 255 * (1 - F)


def assert_corners(
    asset: Asset,
    place: Callable[[float, float], tuple[float, float]] = lambda right, up: (right, up),
) -> None:
    """Assert that a square shows its picture upright and not mirrored, or each corner elsewhere."""
    for corner, colour in QUARTERS.items():
        seen = seen_at(asset, *place(*corner))
        assert np.abs(seen - shown(colour)).max() < SLOPE, corner


def lost(path: Path, settings: AssetSettings = KEEP) -> str:
    """Return why an object is accepted without its materials; its mesh is whole."""
    asset = prepare(path, settings)
    assert asset.materials is not None and all(level.skin is None for level in asset.levels)
    assert asset.materials.message.isprintable()
    return asset.materials.reason


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
