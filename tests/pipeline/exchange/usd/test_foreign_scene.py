"""What other programs write in USD, as a scene: places, lights, textures, losses, and damage."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils

from pipeline.exchange.textured_triangles import LoadedScene
from pipeline.exchange.usd.read_usd import read_usd, usd_keys
from pipeline.exchange.usd.write_usd import write_usd
from pipeline.foreign.limits import WRITTEN_USD_SUFFIXES
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from storage.conventions import linear_from_srgb8
from storage.errors import TrilightError
from storage.records.exr import encode_channels
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.assets.source_materials.textured_kit import F
from tests.pipeline.exchange.exchange_kit import L_SHAPE, mesh, row_at, write_stage
from tests.scenes_by_hand import tiny_scene


def edited(
    folder: Path, edit: Callable[[Any], object] = lambda stage: None, picture: Any = None
) -> LoadedScene:
    """Return the stage of a stranger after an edit, with another picture if one is given."""
    path = write_stage(folder)
    if picture is not None:
        Image.fromarray(picture).save(folder / "tex.png")
    stage = Usd.Stage.Open(str(path))
    edit(stage)
    stage.GetRootLayer().Save()
    return read_usd(path)


@pytest.fixture
def stage(tmp_path: Path) -> LoadedScene:
    return edited(tmp_path)


def object_of(scene: Scene, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [T, 3, 3] and material rows [T, 10] of an object by name."""
    (row,) = (i for i, entry in enumerate(scene.objects) if entry.name == name)
    own = scene.object_index == row
    corners = scene.vertex_positions[scene.faces[own]].astype(np.float64)
    return corners, scene.materials[scene.material_index[own]]


def facing(corners: np.ndarray) -> np.ndarray:
    """Return the sum of area vectors [3]: area times direction of a flat object."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(cross.sum(axis=0) / 2)


def test_units_axes_and_losses(stage: LoadedScene) -> None:
    """Centimetres with Y up become metres with Z up; to single precision."""
    assert stage.scene.environment is not None, "its DomeLight is kept"
    for words in ("/W/rect: emits to one side", "its material emits nothing"):
        assert any(words in text for text in stage.notes), words
    corners, _ = object_of(stage.scene, "Grid")
    assert facing(corners) == pytest.approx([0, 0, 4], abs=1e-6)
    assert stage.scene.c2w[0, :3, 3] == pytest.approx([0, -3, 0.5], abs=1e-6)
    assert stage.scene.fov_deg[0] == pytest.approx(2 * math.degrees(math.atan(18 / 50)), rel=1e-6)


def test_lights_have_their_area_and_radiance(stage: LoadedScene) -> None:
    for name, area_vector, radiance in (
        ("rect", [0, 0, -0.1], [20, 20, 20]),
        ("disk", [0, math.pi * 0.04, 0], [1, 0.5, 0.25]),
        ("lamp", [0, 0, 0.005], [7, 7, 7]),
        ("sphere", [0, 0, 0], [3 / (4 * math.pi * 10**2)] * 3),  # normalized: in centimetres
    ):
        corners, rows = object_of(stage.scene, name)
        # sums of up to 128 areas in single precision
        assert facing(corners) == pytest.approx(area_vector, abs=1e-6), name
        assert rows[:, EMISSION] == pytest.approx(np.tile(radiance, (len(rows), 1)), rel=1e-5), name
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # of the sphere
    area = np.linalg.norm(cross, axis=1).sum() / 2
    assert area == pytest.approx(4 * math.pi * 0.01, rel=1e-5)
    assert (np.einsum("ti,ti->t", cross, corners.mean(axis=1)) > 0).all()


@pytest.mark.parametrize(("kelvin", "redder"), [(None, 1.0), (3000.0, 6.5)])
def test_a_stated_temperature_tints_a_light(
    tmp_path: Path, kelvin: float | None, redder: float
) -> None:
    """USD's own table for 3000 K, red over blue; Blender switches it on and states none."""

    def edit(stage: Any) -> None:
        for path in ("/W/rect", "/W/dome"):
            light = UsdLux.LightAPI(stage.GetPrimAtPath(path))
            light.CreateEnableColorTemperatureAttr(True)
            if kelvin is not None:
                light.CreateColorTemperatureAttr(kelvin)

    scene = edited(tmp_path, edit).scene
    red, _, blue = object_of(scene, "rect")[1][0, EMISSION]
    assert red / blue == pytest.approx(redder, rel=0.01)  # 6.51 in the table
    assert scene.environment is not None
    of_sky = scene.environment.radiance_rgb[0, 0]
    assert of_sky[0] / of_sky[2] == pytest.approx(red / blue, rel=1e-5)
    assert (red == blue == 20) == (kelvin is None)


def test_our_own_files_read_as_a_stranger_does_hold_the_same_light(tmp_path: Path) -> None:
    """Every word of USD that we write means to our own reader what the exact attributes say."""
    write_usd(tmp_path / "a.usda", tiny_scene())
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "b.usda").write_text(text.replace("trilight:", "other:"))
    back, scene = read_usd(tmp_path / "b.usda").scene, tiny_scene()
    assert back.provenance["template"] == "usd"
    assert np.array_equal(back.vertex_positions[back.faces], scene.vertex_positions[scene.faces])
    assert np.array_equal(back.vertex_normals[back.faces], scene.vertex_normals[scene.faces])
    rows, expected = (each.materials[each.material_index] for each in (back, scene))
    assert np.array_equal(rows, expected)
    assert np.array_equal(back.c2w, scene.c2w)
    assert back.fov_deg == pytest.approx(scene.fov_deg, rel=1e-6)  # a focal length in between
    # One whose light is gone says nothing else.
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    stage.RemovePrim("/Scene/Objects/light")
    stage.GetRootLayer().Export(str(tmp_path / "c.usda"))
    with pytest.raises(TrilightError, match=r"carried over \(none is seen\); expected an emissive"):
        read_usd(tmp_path / "c.usda")


def test_time_samples_are_a_sequence(tmp_path: Path) -> None:
    def edit(stage: Any) -> None:
        move = UsdGeom.Xformable(stage.GetPrimAtPath("/W/Grid")).AddTranslateOp()
        for frame, height in ((1, 0), (3, 100)):
            move.Set((0, height, 0), frame)
        stage.SetStartTimeCode(1)
        stage.SetEndTimeCode(3)

    edited(tmp_path, edit)
    path = tmp_path / "stage.usda"
    assert usd_keys(path) == ["1", "2", "3"]
    heights = [object_of(read_usd(path, key).scene, "Grid")[0][..., 2].max() for key in "123"]
    assert heights == pytest.approx([0, 0.5, 1], abs=1e-6)
    with pytest.raises(TrilightError, match="no time code 4; expected one of 1 to 3"):
        read_usd(path, "4")


def test_a_stage_without_light_or_camera(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateInMemory()
    mesh(stage, "/L", L_SHAPE, [6], [0, 1, 2, 3, 4, 5])
    stage.GetRootLayer().Export(str(tmp_path / "a.usda"))
    with pytest.raises(TrilightError, match="no light that can be carried over"):
        read_usd(tmp_path / "a.usda")
    lamps = [UsdLux.SphereLight.Define(stage, f"/{name}") for name in ("None", "Below")]
    lamps[0].CreateRadiusAttr(0.0)
    lamps[1].CreateIntensityAttr(-1.0)
    stage.GetPrimAtPath("/L").CreateRelationship("material:binding").AddTarget("/Gone")
    stage.GetRootLayer().Export(str(tmp_path / "a.usda"))
    lost = "/None: a light without an area; /Below: negative radiance"
    with pytest.raises(TrilightError, match=lost):
        read_usd(tmp_path / "a.usda")
    UsdLux.DistantLight.Define(stage, "/Sun")
    stage.GetRootLayer().Export(str(tmp_path / "a.usda"))
    with pytest.raises(TrilightError, match=r"; 1 more of lights\)"):
        read_usd(tmp_path / "a.usda")
    lamps[0].CreateRadiusAttr(1.0)
    stage.GetRootLayer().Export(str(tmp_path / "a.usda"))
    notes = read_usd(tmp_path / "a.usda").notes
    assert any("binding of a material that is not there" in text for text in notes)
    found = edited(tmp_path, lambda stage: stage.RemovePrim("/W/cam"))
    assert found.scene.num_views == 1
    assert any("no camera" in text for text in found.notes)


RED, GREEN, BLUE, GREY = (200, 0, 0), (0, 200, 0), (0, 0, 200), (100, 100, 100)
PICTURE = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
"""The top row first; the stage's floor has u along +X and v along -Y."""

CORNERS = {(-0.5, -0.5): RED, (0.5, -0.5): GREEN, (-0.5, 0.5): BLUE, (0.5, 0.5): GREY}
CODED = 0.005
"""Half a step of 8 sRGB-encoded bits is at most 0.0045 in linear light."""


BRIGHT = linear_from_srgb8()[GREY[0]]
WRONG = np.array([[[np.nan] * 3, [np.inf] * 3], [[-1] * 3, [0.5] * 3]], np.float32)
FLOAT4 = Sdf.ValueTypeNames.Float4
TEXTURES: list[tuple[dict[str, Any], str, dict[tuple[float, float], Any]]] = [
    (
        {"scale": (2, 0.5, 0.5, 1), "bias": (0, 0.25, -1, 0)},
        "clamped",
        {(0.5, 0.5): (2 * BRIGHT, 0.5 * BRIGHT + 0.25, 0)},
    ),
    ({"file": "./wrong.exr"}, "NaN replaced by 0", dict(zip(CORNERS, (0, 1, 0, 0.5), strict=True))),
    (
        {"fallback": (0.1, 0.2, 0.3, 1), "file": "./gone.png"},
        "left out: './gone.png' is not",
        {(0, 0.1): (0.1, 0.2, 0.3)},
    ),
]
"""Inputs of a texture, what is said of them, and base colors by places on the floor."""


@for_each("inputs, said, base", TEXTURES)
def test_inputs_of_a_texture_are_applied_bounded_and_said(
    tmp_path: Path, inputs: dict[str, Any], said: str, base: dict[tuple[float, float], Any]
) -> None:
    """Scale and bias in linear light; NaN, infinity and negative values; a missing file."""

    def edit(stage: Any) -> None:
        texture = UsdShade.Shader.Get(stage, "/W/mat/texture")
        (tmp_path / "wrong.exr").write_bytes(encode_channels({"RGB": WRONG}))
        for name, value in inputs.items():
            if name == "file":
                texture.GetInput(name).Set(value)
            else:
                texture.CreateInput(name, FLOAT4).Set(Gf.Vec4f(*value))

    found = edited(tmp_path, edit, PICTURE)
    assert any(said in text for text in found.notes)
    for place, rgb in base.items():
        expected = (1 - F) * np.broadcast_to(rgb, 3)
        assert row_at(found.scene, *place)[:3] == pytest.approx(expected, abs=CODED)


def test_a_huge_picture_is_refused_and_too_many_triangles_before_all_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_stage(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.exchange.textured_triangles.MAX_TRIANGLES", 1)
        with pytest.raises(
            TrilightError, match=r"usda: \d+ triangles so far; expected at most 1 in"
        ):
            read_usd(path)
    Image.new("L", (9000, 9000)).save(tmp_path / "tex.png")
    with pytest.raises(TrilightError, match=r"tex.png': 9000 x 9000; expected at most"):
        read_usd(path)


@for_each("is_there", [False, True])
def test_a_mesh_without_coordinates_takes_the_mean(tmp_path: Path, is_there: bool) -> None:
    """None, or some that are no numbers."""

    def edit(stage: Any) -> None:
        grid = stage.GetPrimAtPath("/W/Grid")
        coordinates = [(float("nan"), 0), (1, 0), (1, 1), (0, 1)]
        UsdGeom.PrimvarsAPI(grid).GetPrimvar("st").Set(coordinates)
        if not is_there:
            grid.RemoveProperty("primvars:st")

    found = edited(tmp_path, edit, PICTURE)
    assert any("no coordinates 'st'" in text for text in found.notes)
    mean = (1 - F) * linear_from_srgb8()[PICTURE].mean(axis=(0, 1))
    assert row_at(found.scene, 0, 0.1)[:3] == pytest.approx(mean, abs=1e-5)


COPIES = 60
LIMITS = ChildLimits(memory_bytes=4 << 30, wall_s=60, calls_per_child=1000)


@pytest.fixture(scope="module")
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS)
    yield child
    child.close()


def read_all(path: Path) -> int:
    """Read every scene of a file; only children come here."""
    for key in usd_keys(path)[:3]:
        read_usd(path, key or None).scene.check()
    return 1


def whole_file(folder: Path, suffix: str, ours: bool) -> bytes:
    path = folder / f"whole{suffix}"
    if ours:
        write_usd(path, tiny_scene())
    elif suffix == ".usdz":
        UsdUtils.CreateNewUsdzPackage(str(write_stage(folder)), str(path))
    else:
        Sdf.Layer.FindOrOpen(str(write_stage(folder))).Export(str(path))
    return path.read_bytes()


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut a file off, or give 1 to 12 of its bytes other values."""
    values = np.frombuffer(data, np.uint8).copy()
    if rng.random() < 1 / 3:
        return values[: rng.integers(1, len(values))].tobytes()
    at = rng.integers(0, len(values), rng.integers(1, 13))
    values[at] = rng.integers(0, 256, len(at))
    return values.tobytes()


@pytest.mark.parametrize("ours", [True, False], ids=["ours", "strangers"])
@pytest.mark.parametrize("suffix", WRITTEN_USD_SUFFIXES)
def test_damage_ends_in_one_line(
    tmp_path: Path, child: IsolatedChild, suffix: str, ours: bool
) -> None:
    """Native code may even crash there: that costs the child, which the command says in a line.

    These 360 files crash nothing (usd-core 26.11); what comes out of the reader is TrilightError.
    """
    data, refused = whole_file(tmp_path, suffix, ours), 0
    for seed in range(COPIES):
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(damaged(data, np.random.default_rng(seed)))
        try:
            child.call(read_all, path)
        except TrilightError as error:
            refused += 1
            text = str(error)
            assert text.startswith(path.name) and text.isprintable(), text
            assert str(tmp_path) not in text
        except ChildFailed as failure:
            assert failure.reason != "exception", failure.message
    assert refused > COPIES // 2
