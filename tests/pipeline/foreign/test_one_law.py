"""A textured file has the same triangles and columns as an object and as a scene."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from pipeline.assets.source_materials.skin import _parts
from pipeline.assets.source_materials.source_surface import SourceSurface
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.foreign.material import LEAST_ROUGHNESS
from pipeline.foreign.picture import Decoder
from pipeline.foreign.source_file import read_source
from storage.records.lookup import textured_rows
from storage.records.material import ROUGHNESS
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials import usd_kit

CODED = 0.009
"""A step of 8 sRGB-encoded bits near white: both albedos together stay below 1."""

WEIGHTS = np.array([[0.25, 0.5, 0.25], [0.1, 0.2, 0.7], [0.7, 0.1, 0.2]])
PICTURE = np.kron(
    np.concatenate([kit.CORNERS, kit.CORNERS[::-1] // 2], axis=1), np.ones((16, 16, 1), np.uint8)
)
"""[32, 64, 3]; a scene's own textures repeat, so that clamped borders differ by half a texel."""
WIDE = kit.UV_UP * [2.25, 1] + [0.75, 0]


def assert_same(path: Path) -> None:
    source = read_source(path, kit.KEEP.read_limits)
    parts = _parts(source, Decoder(1 << 20), emission=False)
    scene = load_source(scene_source(str(path))).scene
    count = len(parts.mesh.faces)
    corners = scene.vertex_positions[scene.faces[:count]]
    np.testing.assert_allclose(corners, parts.mesh.corners, atol=1e-6)
    surface = SourceSurface(
        mesh=parts.mesh,
        parts=parts,
        source_face=np.arange(count),
        source_corner=np.tile(np.arange(3), (count, 1)),
    )
    for weights in WEIGHTS:
        each = np.tile(weights, (count, 1))
        expected = surface.columns(np.arange(count), each, 1e-9)
        uv = np.zeros((count, 2))
        if scene.uv is not None:
            uv = np.einsum("c,tcd->td", weights, scene.uv.reshape(-1, 3, 2)[:count])
        rows = textured_rows(scene, scene.material_index[:count], uv.astype(np.float64))
        rows[:, ROUGHNESS] = np.maximum(rows[:, ROUGHNESS], LEAST_ROUGHNESS)  # that of objects
        np.testing.assert_allclose(rows[:, :7], expected, atol=CODED)


def stated(path: str, values: Mapping[str, Any]) -> Callable[[Usd.Stage], None]:
    return lambda stage: usd_kit.set_inputs(stage, path, values)


def turned(stage: Usd.Stage) -> None:
    node = UsdShade.Shader.Define(stage, "/W/mat/move")
    node.CreateIdAttr("UsdTransform2d")
    usd_kit.set_inputs(stage, "/W/mat/move", {"rotation": 90.0})
    node.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(0.5, 0.75))
    node.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(1, 0.125))
    reader = UsdShade.Shader(stage.GetPrimAtPath(f"{usd_kit.TEXTURE}_reader"))
    node.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.ConnectableAPI(), "result"
    )
    UsdShade.Shader(stage.GetPrimAtPath(usd_kit.TEXTURE)).GetInput("st").ConnectToSource(
        node.ConnectableAPI(), "result"
    )


def tinted(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(usd_kit.MESH))
    UsdShade.MaterialBindingAPI(mesh).UnbindAllBindings()
    mesh.CreateDisplayColorPrimvar("uniform").Set([(0.9, 0.1, 0.3), (0.2, 0.4, 0.8)])


SCALED = {"scale": Gf.Vec4f(1, 0.5, 0.75, 1), "bias": Gf.Vec4f(0, 0.25, -0.125, 0)}


@for_each(
    "change, connect",
    [
        (stated(usd_kit.SHADER, {"roughness": 0.3}), {"diffuseColor": "rgb"}),
        (stated(usd_kit.TEXTURE, {"sourceColorSpace": "raw"}), {"diffuseColor": "rgb"}),
        (stated(usd_kit.TEXTURE, SCALED), {"diffuseColor": "rgb"}),
        (stated(usd_kit.TEXTURE, {"sourceColorSpace": "raw"}), {"roughness": "g"}),
        (stated(usd_kit.SHADER, {"ior": 2.0}), {"diffuseColor": "b"}),
        (stated(usd_kit.SHADER, {"useSpecularWorkflow": 1}), {"specularColor": "rgb"}),
        (stated(usd_kit.TEXTURE, {"wrapS": "mirror"}), {"diffuseColor": "rgb"}),
        (stated(usd_kit.TEXTURE, {"wrapS": "clamp"}), {"diffuseColor": "rgb"}),
        (stated(usd_kit.TEXTURE, {"wrapS": "black"}), {"diffuseColor": "rgb"}),
        (turned, {"diffuseColor": "rgb"}),
        (tinted, {"diffuseColor": "rgb"}),
    ],
)
def test_usd(
    tmp_path: Path, change: Callable[[Usd.Stage], None], connect: Mapping[str, str]
) -> None:
    def edit(stage: Usd.Stage) -> None:
        change(stage)
        UsdGeom.Mesh(stage.GetPrimAtPath(usd_kit.MESH)).CreateSubdivisionSchemeAttr("none")
        UsdLux.RectLight.Define(stage, "/lamp")

    picture = kit.picture_bytes(PICTURE)
    assert_same(usd_kit.textured_usd(tmp_path / "a.usda", picture, edit, uv=WIDE, connect=connect))


@for_each(
    "material",
    [
        {},
        {"pbrMetallicRoughness": {"metallicFactor": 1, "baseColorFactor": [0.9, 0.4, 0.2, 1]}},
        {"extensions": {"KHR_materials_unlit": {}}},
        {"extensions": {"KHR_materials_ior": {"ior": 2.0}}},
        {
            "extensions": {
                "KHR_materials_specular": {
                    "specularFactor": 0.5,
                    "specularColorFactor": [1, 0.5, 0],
                }
            }
        },
        {
            "extensions": {
                "KHR_materials_pbrSpecularGlossiness": {
                    "diffuseTexture": {"index": 0},
                    "glossinessFactor": 0.5,
                    "specularFactor": [0.2, 0.3, 0.1],
                }
            }
        },
    ],
)
@for_each("sampler", [{}, {"wrapS": 33071}, {"wrapS": 33648, "wrapT": 33071}])
def test_gltf(tmp_path: Path, material: Mapping[str, Any], sampler: Mapping[str, int]) -> None:
    tree, buffer = kit.textured_tree(kit.picture_bytes(PICTURE), WIDE)
    tree["materials"][0] |= material
    tree["samplers"] = [sampler]
    tree["textures"][0]["sampler"] = 0
    assert_same(write_glb(tmp_path / "a.glb", tree, buffer))
