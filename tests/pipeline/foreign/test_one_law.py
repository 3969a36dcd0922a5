"""A textured file has the same triangles and columns as an object and as a scene; all finite."""

import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade

from pipeline.assets.source_materials.skin import _parts
from pipeline.assets.source_materials.source_surface import FacePoints, SourceSurface
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.exchange.renderformer_json import read_description
from pipeline.foreign.material import LEAST_ROUGHNESS
from pipeline.foreign.numbers import FINITE
from pipeline.foreign.picture import Decoder, read_linear_picture
from pipeline.foreign.source_file import read_source
from storage.errors import Rejected, TrilightError
from storage.records.lookup import textured_rows
from storage.records.material import ROUGHNESS
from tests.for_each import case, for_each
from tests.pipeline.assets.meshes_by_hand import write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials import usd_kit
from tests.pipeline.assets.source_materials.usd_kit import SHADER, TEXTURE, set_inputs, textured_usd
from tests.pipeline.exchange.test_renderformer_json import MATERIAL, TRANSFORM, changed

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
        expected = surface.columns(FacePoints(np.arange(count), each), 1e-9)
        uv = np.zeros((count, 2))
        if scene.uv is not None:
            uv = np.einsum("c,tcd->td", weights, scene.uv.reshape(-1, 3, 2)[:count])
        rows = textured_rows(scene, scene.material_index[:count], uv.astype(np.float64))
        rows[:, ROUGHNESS] = np.maximum(rows[:, ROUGHNESS], LEAST_ROUGHNESS)  # that of objects
        np.testing.assert_allclose(rows[:, :7], expected, atol=CODED)


def stated(path: str, values: Mapping[str, Any]) -> Callable[[Usd.Stage], None]:
    return lambda stage: usd_kit.set_inputs(stage, path, values)


def turned(stage: Usd.Stage) -> None:
    usd_kit.transform_coordinates(stage, 90.0, (0.5, 0.75), (1, 0.125))


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
        (stated(usd_kit.SHADER, {"roughness": 0.3}), {"diffuseColor": "rgb", "metallic": "g"}),
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
        {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}},
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


NUMBERS = (math.nan, math.inf, -math.inf, 1e39, -1e39, 0.0, 0.25, 1e3, -7.0)
SMALL_PICTURE = kit.picture_bytes(kit.CORNERS)


def look_at_parts(path: Path) -> str:
    """Read all of a file and return what is not read; what became of its numbers is finite."""
    source = read_source(path, kit.KEEP.read_limits)
    for material in _parts(source, Decoder(1 << 20), emission=True).materials:
        colors = (*material.base_rgb, *material.specular_rgb, *material.emission_rgb)
        numbers = (material.metallic, material.roughness, material.f0, material.specular_strength)
        moves = [[*slot.uv_matrix.flat, *slot.uv_offset] for slot in material.slots]
        assert np.isfinite([*colors, *numbers, *itertools.chain(*moves)]).all()
    return "; ".join(source.unread)


def gltf(folder: Path, where: str, name: str, value: Any) -> str:
    tree, buffer = kit.textured_tree(SMALL_PICTURE)
    row = tree["materials"][0]
    if where == "emissive_strength":
        row["emissiveFactor"] = [1, 1, 1]
    if where in ("metal", "uv"):
        row = row["pbrMetallicRoughness"]
    if where == "uv":
        extensions = row["baseColorTexture"].setdefault("extensions", {})
        row = extensions.setdefault("KHR_texture_transform", {})
    elif where not in ("metal", ""):
        row = row.setdefault("extensions", {}).setdefault(f"KHR_materials_{where}", {})
    row[name] = value
    return look_at_parts(write_glb(folder / "a.glb", tree, buffer))


def obj(folder: Path, where: str, name: str, value: Any) -> str:
    line = f"map_Kd {name} {value} its picture.png" if where == "option" else f"{name} {value}"
    return look_at_parts(kit.textured_obj(folder / "o" / "a.obj", SMALL_PICTURE, f"{line}\n"))


def usd(folder: Path, where: str, name: str, value: Any) -> str:
    def change(stage: Any) -> None:
        set_inputs(stage, where, {name: tuple(value) if isinstance(value, list) else value})

    path, connect = folder / "u" / "a.usda", {"emissiveColor": "rgb"}
    return look_at_parts(textured_usd(path, SMALL_PICTURE, change, connect=connect))


def scene(folder: Path, where: str, name: str, value: Any) -> str:
    fields = MATERIAL if where == "material" else TRANSFORM
    read_description(changed(*fields, **{name: value}), f"{name}.json")
    return ""


def radiance(folder: Path, where: str, name: str, value: Any) -> str:
    head = f"#?RADIANCE\n{name}={value}\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n"
    picture = read_linear_picture(head.encode() + bytes([128] * 4), 1)
    assert picture is not None and np.isfinite(picture.values).all()
    return ""


FIELDS = [
    *((gltf, "metal", "baseColorFactor", 4), (gltf, "metal", "metallicFactor", 1)),
    *((gltf, "metal", "roughnessFactor", 1), (gltf, "ior", "ior", 1)),
    *((gltf, "specular", "specularFactor", 1), (gltf, "specular", "specularColorFactor", 3)),
    *((gltf, "", "emissiveFactor", 3), (gltf, "emissive_strength", "emissiveStrength", 1)),
    *((gltf, "uv", "rotation", 1), (gltf, "uv", "scale", 2), (gltf, "uv", "offset", 2)),
    *((obj, "", name, 1) for name in ("Kd", "Ks", "Ns", "Ke", "Pm", "Pr", "illum")),
    *((obj, "option", name, 1) for name in ("-s", "-o")),
    *((usd, SHADER, name, 1) for name in ("roughness", "metallic", "ior")),
    *((usd, SHADER, "diffuseColor", 3), (usd, TEXTURE, "scale", 4), (usd, TEXTURE, "bias", 4)),
    *((scene, "material", "roughness", 1), (scene, "material", "emissive", 3)),
    *((scene, "transform", "scale", 3), (radiance, "", "EXPOSURE", 1)),
]


def test_a_number_that_is_not_finite_is_named_by_its_field(tmp_path: Path) -> None:
    for (read, where, name, count), number in itertools.product(FIELDS, NUMBERS):
        with case((read.__name__, where, name, number)):
            try:
                said = read(tmp_path, where, name, number if count == 1 else [number] * count)
            except (Rejected, TrilightError) as refusal:
                said = str(refusal)
            if not FINITE.holds(number):
                assert name.lower() in said.lower() or "no JSON number" in said
