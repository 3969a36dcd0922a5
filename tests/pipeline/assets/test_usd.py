"""USD files as objects: what of a stage is one, what is refused by name, and their colours.

Quads whose colours are known, and twins of glTF files.
"""

import dataclasses
import zlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from pipeline.assets.settings import AssetSettings
from pipeline.foreign.usd import object_source
from storage.conventions import linear_from_srgb8
from storage.errors import Rejected
from storage.records.asset import Asset
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as meshes
from tests.pipeline.assets.child_kit import Bench
from tests.pipeline.assets.source_materials import textured_kit as kit

BOX = meshes.moved(meshes.cube(), scale=[1.0, 0.5, 0.25])
"""Without symmetry of its axes."""
PICTURE = kit.picture_bytes(kit.CORNERS)


def _reference(name: str) -> kit.Change:
    return lambda stage: stage.DefinePrim("/W/other").GetReferences().AddReference(name)


def _inputs(values: dict[str, Any], path: str = kit.TEXTURE) -> kit.Change:
    return lambda stage: kit.set_inputs(stage, path, values)


def _set(attribute: str, value: object, path: str = kit.MESH) -> kit.Change:
    return lambda stage: stage.GetPrimAtPath(path).GetAttribute(attribute).Set(value)


def _no_polygons(stage: Usd.Stage) -> None:
    for attribute in ("faceVertexCounts", "faceVertexIndices"):
        stage.GetPrimAtPath(kit.MESH).GetAttribute(attribute).Block()


def _skinned(stage: Usd.Stage) -> None:
    made = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(kit.MESH))
    made.CreatePrimvar("skel:jointIndices", Sdf.ValueTypeNames.IntArray).Set([0] * 8)


def _crowd(stage: Usd.Stage) -> None:
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.CreatePrototypesRel().AddTarget(kit.MESH)
    many.CreateProtoIndicesAttr([0] * 20)
    many.CreatePositionsAttr([(k, 0, 0) for k in range(20)])


def _far_points(stage: Usd.Stage) -> None:
    points = stage.GetPrimAtPath(kit.MESH).GetAttribute("points")
    points.Set([point + Gf.Vec3f(1e6, 0, 0) for point in points.Get()])
    UsdGeom.Xformable(stage.GetPrimAtPath(kit.MESH)).AddTranslateOp().Set((-1e6, 0, 0))


REFUSED: dict[str, tuple[str, kit.Change]] = {
    "a reference that is missing": ("missing_file", _reference("./gone.usda")),
    "a reference to no layer": ("missing_file", _reference("./tex.png")),
    "a reference that leads out": ("external_uri", _reference("../secret.usda")),
    "a reference to a server": ("external_uri", _reference("https://localhost/a.usda")),
    "counts that do not add up": ("load_error", _set("faceVertexCounts", [3])),
    "an index of no point": ("load_error", _set("faceVertexIndices", [0, 1, 99] * 12)),
    "a point that is no number": ("load_error", _set("points", [(np.nan, 0, 0)] * 24)),
    "no polygons": ("no_faces", _no_polygons),
    "a patch": ("unsupported_primitive", lambda stage: UsdGeom.NurbsPatch.Define(stage, "/W/a")),
    "bones": ("skinned_mesh", _skinned),
    "a crowd": ("too_many_instances", _crowd),
    "points far from their origin": ("offset_precision", _far_points),
}


@for_each("name", REFUSED)
def test_what_would_give_another_mesh_is_refused(tmp_path: Path, name: str) -> None:
    reason, change = REFUSED[name]
    folder = meshes.secret_beside(tmp_path, PICTURE)
    (folder / "tex.png").write_bytes(PICTURE)
    (tmp_path / "secret.usda").write_text("#usda 1.0\n")
    stage = kit.new_stage()
    kit.usd_mesh(stage, BOX)
    change(stage)
    path = kit.exported(stage, folder / "a.usda")
    assert meshes.reason_of(path, AssetSettings(max_instances=15)) == reason


def test_files_that_are_none_are_cut_off_or_are_large(tmp_path: Path) -> None:
    """Layers count together, and few bytes may hold millions of polygons."""
    part = kit.new_stage()
    kit.usd_mesh(part, BOX)
    whole = kit.exported(part, tmp_path / "a.usdc").read_bytes()
    for name, data in (("b.usdc", whole[: len(whole) // 2]), ("c.usda", whole), ("d.usdz", whole)):
        (tmp_path / name).write_bytes(data)
        assert meshes.reason_of(tmp_path / name) == "load_error", name
    assert meshes.reason_of(tmp_path / "gone.usd") == "missing_file"
    size = kit.exported(part, tmp_path / "part.usda").stat().st_size
    stage = kit.new_stage()
    _reference("./part.usda")(stage)
    path = kit.exported(stage, tmp_path / "a.usda")
    size += path.stat().st_size
    assert meshes.prepare(path, AssetSettings(max_source_bytes=size)).levels
    assert meshes.reason_of(path, AssetSettings(max_source_bytes=size - 1)) == "too_large_bytes"
    made = kit.usd_mesh(stage, BOX)
    counts, indices = np.full(2_000_000, 3, np.int32), np.arange(6_000_000, dtype=np.int32) % 3
    made.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts))
    made.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(indices))
    path = kit.exported(stage, tmp_path / "a.usdc")
    assert path.stat().st_size < 1_000_000
    assert meshes.reason_of(path) == "too_many_faces"


def test_pictures_coordinates_and_materials_are_lost_with_a_reason(tmp_path: Path) -> None:
    folder = meshes.secret_beside(tmp_path, PICTURE)
    path = folder / "a.usda"

    def lost(change: kit.Change | None = None, picture: bytes = PICTURE, **more: Any) -> str:
        return kit.lost(kit.textured_usd(path, picture, change, **more))

    for file in ("../secret.png", "/etc/hostname", "http://127.0.0.1:1/a.png"):
        assert lost(_inputs({"file": file})) == "texture_outside"
    assert lost(_inputs({"file": "./gone.png"})) == "texture_missing"
    assert lost(picture=b"no picture") == "texture_unreadable"
    few = dataclasses.replace(kit.OWN, max_pixels=3)
    kit.textured_usd(path, PICTURE)
    assert kit.lost(path, AssetSettings(own_materials=few)) == "texture_too_large"

    def absent(stage: Usd.Stage) -> None:
        stage.GetPrimAtPath(kit.MESH).GetAttribute("primvars:st").Clear()

    assert lost(absent) == "no_texture_coordinates"
    assert lost(_set("primvars:st", [Gf.Vec2f(0, 0)] * 3)) == "no_texture_coordinates"
    infinite = np.where(kit.UV_UP == 1, np.inf, kit.UV_UP)
    assert lost(uv=infinite) == "texture_coordinates_not_finite"
    assert lost(_set("info:id", "SomeOtherSurface", kit.SHADER)) == "materials_unreadable"
    stage = kit.new_stage()
    kit.usd_mesh(stage, BOX)
    assert kit.lost(kit.exported(stage, path)) == "no_materials"


def test_materials_that_are_refused_are_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = kit.textured_usd(tmp_path / "a.usda", PICTURE, _set("info:id", "Other", kit.SHADER))
    read = Mock(wraps=object_source.read_stage_materials)
    monkeypatch.setattr(object_source, "read_stage_materials", read)
    source = object_source.UsdSource(path, kit.KEEP.read_limits)
    for _ in range(2):
        with pytest.raises(Rejected, match="materials_unreadable"):
            source.materials  # noqa: B018
    read.assert_called_once()


def test_the_stage_makes_it_in_a_child_and_again_when_a_part_changes(bench: Bench) -> None:
    """USD is never parsed here; layers and pictures that it names are part of its digest."""
    folder = bench.root
    part = kit.new_stage()
    kit.usd_mesh(part, BOX)
    kit.exported(part, folder / "part.usda")
    kit.textured_usd(folder / "a.usda", PICTURE, _reference("./part.usda"))

    def made() -> str:
        asset = bench.made("a.usda", kit.KEEP)
        assert asset.materials is not None and not asset.materials.reason
        return asset.source_sha256

    first = made()
    assert made() == first
    (folder / "tex.png").write_bytes(kit.picture_bytes(kit.CORNERS[::-1]))
    second = made()
    kit.usd_mesh(part, meshes.moved(BOX, [1, 1, 2]))
    kit.exported(part, folder / "part.usda")
    assert len({first, second, made()}) == len(bench.calls) == 3
    (folder / "part.usda").unlink()
    prepared, (failure,) = bench.run("a.usda", settings=kit.KEEP)
    assert not prepared and failure.reason == "missing_file"


def made(
    tmp_path: Path, change: kit.Change | None = None, picture: bytes = PICTURE, **more: Any
) -> Asset:
    """Return the asset of a textured square."""
    return meshes.prepare(kit.textured_usd(tmp_path / "a.usda", picture, change, **more), kit.KEEP)


def _skins(asset: Asset) -> list[NDArray]:
    assert asset.materials is not None and not asset.materials.reason, asset.materials
    skins = [level.skin for level in asset.levels if level.skin is not None]
    return [each for skin in skins for each in (skin.uv, *(t.texels for t in skin.textures))]


def test_a_gltf_and_its_twin_in_usd_are_the_same_to_the_last_bit(tmp_path: Path) -> None:
    """Geometry and baked colours: a ball with a picture, factors, metal and roughness."""
    ball = meshes.sphere(rings=6, columns=9)
    uv = np.round((ball.positions[:, [0, 2]] + 1) * 512) / 1024  # exact in float32, and 1 minus it
    codes = np.random.default_rng(0).integers(0, 256, (16, 16, 3))
    noise = kit.picture_bytes(codes.astype(np.uint8))
    tree, buffer = kit.textured_tree(noise, uv, ball)
    metal = tree["materials"][0]["pbrMetallicRoughness"]
    metal["metallicRoughnessTexture"] = metal["baseColorTexture"]
    metal |= {"metallicFactor": 1, "roughnessFactor": 1}
    twin = meshes.prepare(meshes.write_glb(tmp_path / "a.glb", tree, buffer), kit.KEEP)

    def linear(stage: Usd.Stage) -> None:
        numbers = "/W/mat/numbers"
        kit.connect_texture(stage, "./tex.png", {"roughness": "g", "metallic": "b"}, numbers)
        kit.set_inputs(stage, numbers, {"sourceColorSpace": "raw"})
        # a picture that names no coordinates has those of the mesh
        UsdShade.Shader(stage.GetPrimAtPath(numbers)).GetInput("st").ClearSources()

    asset = made(tmp_path, linear, noise, uv=uv, mesh=ball)
    assert meshes.geometry(asset) == meshes.geometry(twin)
    assert all(map(np.array_equal, _skins(asset), _skins(twin)))


def test_constants_of_both_workflows(tmp_path: Path) -> None:
    def constant(**inputs: Any) -> list[NDArray]:
        stage = kit.new_stage()
        ball = kit.usd_mesh(stage, meshes.sphere(rings=6, columns=9))
        kit.material(stage, ball, {**plain, **inputs})
        asset = meshes.prepare(kit.exported(stage, tmp_path / "a.usda"), kit.KEEP)
        assert asset.levels[0].skin is not None, asset.materials
        return [texture.texels[0, 0].astype(float) for texture in asset.levels[0].skin.textures]

    base, f0 = np.array([0.3, 0.62, 0.011]), np.array([0.5, 0.2, 0.1])
    plain: dict[str, Any] = {"diffuseColor": Gf.Vec3f(*base), "roughness": 0.37}
    diffuse, specular, roughness = constant()
    assert np.allclose(diffuse, base * (1 - kit.F)) and np.allclose(specular, kit.F)
    assert np.isclose(roughness, 0.37)
    diffuse, specular, _ = constant(metallic=1.0)
    assert not diffuse.any() and np.allclose(specular, base + (1 - base) / 21)
    diffuse, specular, _ = constant(useSpecularWorkflow=1, specularColor=Gf.Vec3f(*f0))
    assert np.allclose(specular, f0 + (1 - f0) / 21)
    assert np.allclose(diffuse, base * (1 - specular))
    _, specular, _ = constant(ior=2.0)
    assert np.allclose(specular, 1 / 9 + (1 - 1 / 9) / 21)


GREY = np.full((2, 2, 3), 128, np.uint8)
GREY[0, 0] = 129  # else it is a constant


def test_the_colour_space_of_the_shader_counts(tmp_path: Path) -> None:
    """And not what the picture says of itself: this one claims to be linear."""
    encoded, linear = linear_from_srgb8()[128], 128 / 255
    chunk = b"gAMA" + (100_000).to_bytes(4, "big")  # gamma 1
    claim = (4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    for space, mode, wanted in (
        ("sRGB", None, encoded),
        ("raw", None, linear),
        (None, None, encoded),
        (None, "L", linear),
    ):
        picture = kit.picture_bytes(GREY, mode=mode)
        change = _inputs({"sourceColorSpace": space}) if space else None
        asset = made(tmp_path, change, picture[:33] + claim + picture[33:])
        seen = kit.seen_at(asset, 0.25, -0.25)
        assert np.abs(seen - wanted * (1 - kit.F)).max() < kit.STORED, (space, mode)


def test_wrap_modes_beyond_the_picture(tmp_path: Path) -> None:
    colours = {"repeat": kit.RED, "mirror": kit.GREEN, "clamp": kit.GREEN, "black": (0, 0, 0)}
    for wrap, wanted in colours.items():
        change = _inputs({"wrapS": wrap, "wrapT": "clamp"})
        # an eighth into the second tile: a quarter of the picture
        seen = kit.seen_at(made(tmp_path, change, uv=kit.UV_UP * [2, 1] + [1, 0]), -0.375, -0.25)
        assert np.abs(seen - kit.shown(wanted)).max() < 2 * kit.SLOPE, wrap


def test_subsets_display_colours_and_what_nothing_here_can_show(tmp_path: Path) -> None:
    """One triangle has a material by a subset; the other shows its display colour."""
    stage = kit.new_stage()
    mesh = kit.usd_mesh(stage, kit.SQUARE)
    shader = kit.material(stage, mesh, {"diffuseColor": Gf.Vec3f(0, 0, 1)})
    bound = UsdShade.MaterialBindingAPI(mesh).GetDirectBinding().GetMaterial()
    UsdShade.MaterialBindingAPI(mesh).UnbindAllBindings()
    subset = UsdGeom.Subset.CreateGeomSubset(mesh, "part", "face", [1], "materialBind")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(bound)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0)])
    asset = meshes.prepare(kit.exported(stage, tmp_path / "a.usda"), kit.KEEP)
    assert np.allclose(kit.seen_at(asset, 0.25, -0.25), [1 - kit.F, 0, 0], atol=kit.STORED)
    assert np.allclose(kit.seen_at(asset, -0.25, 0.25), [0, 0, 1 - kit.F], atol=kit.STORED)
    kit.set_inputs(stage, kit.SHADER, {"emissiveColor": Gf.Vec3f(1, 1, 1)})
    for name, value in (("opacity", 0.5), ("clearcoat", 1.0)):
        shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    asset = meshes.prepare(kit.exported(stage, tmp_path / "a.usda"), kit.KEEP)
    assert asset.materials is not None
    assert asset.materials.lost == ("clearcoat", "emission", "transparency")
