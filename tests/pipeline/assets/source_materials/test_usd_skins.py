"""USD objects keep their colours: quads whose colours are known, and twins of glTF files."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from storage.conventions import linear_from_srgb8
from storage.records.asset import Asset
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import geometry, prepare, sphere, write_glb
from tests.pipeline.assets.source_materials import textured_kit as kit
from tests.pipeline.assets.source_materials import usd_kit


@for_each("suffix", ["usda", "usdc", "usd", "usdz"])
def test_a_quad_keeps_its_corner_colours(tmp_path: Path, suffix: str) -> None:
    """In every form of the file, in centimetres with Y up."""
    path = tmp_path / f"a.{suffix}"
    picture = kit.picture_bytes(kit.CORNERS)
    kit.assert_corners(prepare(usd_kit.textured_usd(path, picture, y_up=True, unit=0.01), kit.KEEP))


def test_coordinates_of_each_corner_are_read(tmp_path: Path) -> None:
    def corners(stage: Usd.Stage) -> None:
        made = UsdGeom.Mesh(stage.GetPrimAtPath(usd_kit.MESH))
        usd_kit.coordinates(made, kit.UV_UP[kit.SQUARE.faces].reshape(-1, 2), "faceVarying")

    picture = kit.picture_bytes(kit.CORNERS)
    kit.assert_corners(
        prepare(usd_kit.textured_usd(tmp_path / "a.usda", picture, corners), kit.KEEP)
    )


def test_a_quad_of_four_corners_and_a_place_of_its_own(tmp_path: Path) -> None:
    """One polygon, a quarter turn and a mirror above it: the picture goes with the surface."""

    def placed(stage: Usd.Stage) -> None:
        made = UsdGeom.Mesh(stage.GetPrimAtPath(usd_kit.MESH))
        made.GetFaceVertexCountsAttr().Set([4])
        made.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3])
        UsdGeom.Xformable(stage.GetPrimAtPath("/W")).AddRotateYOp().Set(90)

    asset = prepare(
        usd_kit.textured_usd(tmp_path / "a.usda", kit.picture_bytes(kit.CORNERS), placed), kit.KEEP
    )
    for (right, up), colour in kit.QUARTERS.items():  # +y by 90 degrees: x to -z, and z to x
        wanted = np.array(colour) / 255 * (1 - kit.F)
        assert np.abs(kit.seen_at(asset, up, -right) - wanted).max() < kit.SLOPE, (right, up)


def _skins(asset: Asset) -> list[tuple[NDArray, ...]]:
    assert asset.materials is not None and not asset.materials.reason, asset.materials
    return [
        (level.skin.uv, *(texture.texels for texture in level.skin.textures))
        for level in asset.levels
        if level.skin is not None
    ]


def test_a_gltf_and_its_twin_in_usd_are_the_same_to_the_last_bit(tmp_path: Path) -> None:
    """Geometry and baked colours: a ball with a picture, factors, metal and roughness."""
    ball = sphere(rings=6, columns=9)
    uv = np.round((ball.positions[:, [0, 2]] + 1) * 512) / 1024  # exact in float32, and 1 minus it
    noise = np.random.default_rng(0).integers(0, 256, (16, 16, 3)).astype(np.uint8)
    tree, buffer = kit.textured_tree(kit.picture_bytes(noise), uv, ball)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal["metallicRoughnessTexture"] = metal["baseColorTexture"]
    metal |= {"metallicFactor": 1, "roughnessFactor": 1}
    twin = prepare(write_glb(tmp_path / "a.glb", tree, buffer), kit.KEEP)

    def linear(stage: Usd.Stage) -> None:
        node = UsdShade.Shader.Define(stage, "/W/mat/numbers")
        node.CreateIdAttr("UsdUVTexture")
        usd_kit.set_inputs(
            stage, "/W/mat/numbers", {"file": "./tex.png", "sourceColorSpace": "raw"}
        )
        shader = UsdShade.Shader(stage.GetPrimAtPath(usd_kit.SHADER))
        for name, output in (("roughness", "g"), ("metallic", "b")):
            shader.CreateInput(name, Sdf.ValueTypeNames.Float).ConnectToSource(
                node.ConnectableAPI(), output
            )

    path = usd_kit.textured_usd(
        tmp_path / "a.usda", kit.picture_bytes(noise), linear, uv=uv, mesh=ball
    )
    asset = prepare(path, kit.KEEP)
    assert geometry(asset) == geometry(twin)
    for ours, theirs in zip(_skins(asset), _skins(twin), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


def _constant(path: Path, inputs: dict[str, Any]) -> list[NDArray]:
    stage = usd_kit.new_stage()
    usd_kit.material(stage, usd_kit.usd_mesh(stage, sphere(rings=6, columns=9)), inputs)
    asset = prepare(usd_kit.exported(stage, path), kit.KEEP)
    assert asset.levels[0].skin is not None, asset.materials
    return [texture.texels[0, 0].astype(float) for texture in asset.levels[0].skin.textures]


def test_constants_of_both_workflows(tmp_path: Path) -> None:
    base = np.array([0.3, 0.62, 0.011])
    plain = {"diffuseColor": Gf.Vec3f(*base), "roughness": 0.37}
    diffuse, specular, roughness = _constant(tmp_path / "a.usda", plain)
    assert np.allclose(diffuse, base * (1 - kit.F)) and np.allclose(specular, kit.F)
    assert np.isclose(roughness, 0.37)
    diffuse, specular, _ = _constant(tmp_path / "b.usda", {**plain, "metallic": 1.0})
    assert not diffuse.any() and np.allclose(specular, base + (1 - base) / 21)
    f0 = np.array([0.5, 0.2, 0.1])
    glossy = {**plain, "useSpecularWorkflow": 1, "specularColor": Gf.Vec3f(*f0)}
    diffuse, specular, _ = _constant(tmp_path / "c.usda", glossy)
    assert np.allclose(specular, f0 + (1 - f0) / 21)
    assert np.allclose(diffuse, base * (1 - specular))
    _, specular, _ = _constant(tmp_path / "d.usda", {**plain, "ior": 2.0})
    assert np.allclose(specular, 1 / 9 + (1 - 1 / 9) / 21)


GREY = np.full((2, 2, 3), 128, np.uint8)
GREY[0, 0] = 129  # else it is a constant


@for_each(
    ("space", "grey", "linear"),
    [
        ("sRGB", False, linear_from_srgb8()[128]),
        ("raw", False, 128 / 255),
        (None, False, linear_from_srgb8()[128]),
        (None, True, 128 / 255),
    ],
)
def test_the_colour_space_of_the_shader_counts(
    tmp_path: Path, space: str | None, grey: bool, linear: float
) -> None:
    """And not what the picture says of itself: this one claims to be linear."""

    def state(stage: Usd.Stage) -> None:
        if space:
            usd_kit.set_inputs(stage, usd_kit.TEXTURE, {"sourceColorSpace": space})

    picture = kit.picture_bytes(GREY, mode="L" if grey else None)
    chunk = b"gAMA" + (100_000).to_bytes(4, "big")  # gamma 1
    picture = (
        picture[:33] + (4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    ) + picture[33:]
    asset = prepare(usd_kit.textured_usd(tmp_path / "a.usda", picture, state), kit.KEEP)
    assert np.abs(kit.seen_at(asset, 0.25, -0.25) - linear * (1 - kit.F)).max() < kit.STORED


def test_scale_and_bias_and_a_single_channel(tmp_path: Path) -> None:
    def state(stage: Usd.Stage) -> None:
        usd_kit.set_inputs(
            stage,
            usd_kit.TEXTURE,
            {"scale": Gf.Vec4f(1, 0.5, 1, 1), "bias": Gf.Vec4f(0, 0.25, 0, 0)},
        )

    path = tmp_path / "a.usda"
    usd_kit.textured_usd(path, kit.picture_bytes(kit.CORNERS), state, connect={"diffuseColor": "g"})
    asset = prepare(path, kit.KEEP)
    assert np.abs(kit.seen_at(asset, 0.25, -0.25) - 0.75 * (1 - kit.F)).max() < kit.SLOPE  # green
    assert np.abs(kit.seen_at(asset, -0.25, -0.25) - 0.25 * (1 - kit.F)).max() < kit.SLOPE  # red


@for_each("wrap", ["repeat", "mirror", "clamp", "black"])
def test_wrap_modes_beyond_the_picture(tmp_path: Path, wrap: str) -> None:
    def state(stage: Usd.Stage) -> None:
        usd_kit.set_inputs(stage, usd_kit.TEXTURE, {"wrapS": wrap, "wrapT": "clamp"})

    path = usd_kit.textured_usd(
        tmp_path / "a.usda", kit.picture_bytes(kit.CORNERS), state, uv=kit.UV_UP * [2, 1] + [1, 0]
    )
    asset = prepare(path, kit.KEEP)
    # an eighth into the second tile: a quarter of the picture
    wanted = {"repeat": kit.RED, "mirror": kit.GREEN, "clamp": kit.GREEN, "black": (0, 0, 0)}[wrap]
    seen = kit.seen_at(asset, -0.375, -0.25)
    assert np.abs(seen - np.array(wanted) / 255 * (1 - kit.F)).max() < 2 * kit.SLOPE


def test_a_transform_scales_turns_and_shifts_in_this_order(tmp_path: Path) -> None:
    """A quarter turn counter-clockwise and a shift back: (s, t) reads (1 - t, s)."""

    def move(stage: Usd.Stage) -> None:
        node = UsdShade.Shader.Define(stage, "/W/mat/move")
        node.CreateIdAttr("UsdTransform2d")
        usd_kit.set_inputs(stage, "/W/mat/move", {"rotation": 90.0})
        node.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(1, 0))
        reader = UsdShade.Shader(stage.GetPrimAtPath(f"{usd_kit.TEXTURE}_reader"))
        node.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(
            reader.ConnectableAPI(), "result"
        )
        UsdShade.Shader(stage.GetPrimAtPath(usd_kit.TEXTURE)).GetInput("st").ConnectToSource(
            node.ConnectableAPI(), "result"
        )

    asset = prepare(
        usd_kit.textured_usd(tmp_path / "a.usda", kit.picture_bytes(kit.CORNERS), move), kit.KEEP
    )
    for right, up in kit.QUARTERS:
        wanted = np.array(kit.QUARTERS[(-up, right)]) / 255 * (1 - kit.F)
        assert np.abs(kit.seen_at(asset, right, up) - wanted).max() < kit.SLOPE, (right, up)


def test_subsets_and_display_colours(tmp_path: Path) -> None:
    """One triangle has a material by a subset; the other shows its display colour."""
    stage = usd_kit.new_stage()
    made = usd_kit.usd_mesh(stage, kit.SQUARE)
    usd_kit.material(stage, made, {"diffuseColor": Gf.Vec3f(0, 0, 1)})
    bound = UsdShade.MaterialBindingAPI(made).GetDirectBinding().GetMaterial()
    UsdShade.MaterialBindingAPI(made).UnbindAllBindings()
    subset = UsdGeom.Subset.CreateGeomSubset(made, "part", "face", [1], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(bound)
    made.CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0)])
    asset = prepare(usd_kit.exported(stage, tmp_path / "a.usda"), kit.KEEP)
    assert np.allclose(kit.seen_at(asset, 0.25, -0.25), [1 - kit.F, 0, 0], atol=kit.STORED)
    assert np.allclose(kit.seen_at(asset, -0.25, 0.25), [0, 0, 1 - kit.F], atol=kit.STORED)


def test_what_nothing_here_can_show_is_named(tmp_path: Path) -> None:
    stage = usd_kit.new_stage()
    shader = usd_kit.material(
        stage, usd_kit.usd_mesh(stage, kit.SQUARE), {"emissiveColor": Gf.Vec3f(1, 1, 1)}
    )
    for name, value in (("opacity", 0.5), ("clearcoat", 1.0)):
        shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    asset = prepare(usd_kit.exported(stage, tmp_path / "a.usda"), kit.KEEP)
    assert asset.materials is not None
    assert asset.materials.lost == ("clearcoat", "emission", "transparency")
