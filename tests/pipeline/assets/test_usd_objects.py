"""USD files as objects: what of a stage is the object, and what is refused by name."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from pipeline.assets.settings import AssetSettings
from tests.for_each import for_each
from tests.pipeline.assets.child_kit import Bench, run, stored_asset
from tests.pipeline.assets.meshes_by_hand import (
    cube,
    geometry,
    moved,
    prepare,
    reason_of,
)
from tests.pipeline.assets.source_materials.textured_kit import (
    CORNERS,
    KEEP,
    UV_UP,
    lost,
    picture_bytes,
)
from tests.pipeline.assets.source_materials.usd_kit import (
    MESH,
    SHADER,
    TEXTURE,
    exported,
    new_stage,
    set_inputs,
    textured_usd,
    usd_mesh,
)

BOX = moved(cube(), scale=[1.0, 0.5, 0.25])
"""Without symmetry of its axes."""


def _reference(name: str) -> Callable[[Usd.Stage], object]:
    def change(stage: Usd.Stage) -> None:
        stage.DefinePrim("/W/other").GetReferences().AddReference(name)

    return change


def _broken(attribute: str, value: object) -> Callable[[Usd.Stage], object]:
    def change(stage: Usd.Stage) -> None:
        stage.GetPrimAtPath(MESH).GetAttribute(attribute).Set(value)

    return change


def _skinned(stage: Usd.Stage) -> None:
    made = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(MESH))
    made.CreatePrimvar("skel:jointIndices", Sdf.ValueTypeNames.IntArray).Set([0] * 8)


def _crowd(stage: Usd.Stage) -> None:
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.CreatePrototypesRel().AddTarget(MESH)
    many.CreateProtoIndicesAttr([0] * 20)
    many.CreatePositionsAttr([(k, 0, 0) for k in range(20)])


def _far_points(stage: Usd.Stage) -> None:
    points = stage.GetPrimAtPath(MESH).GetAttribute("points")
    points.Set([point + Gf.Vec3f(1e6, 0, 0) for point in points.Get()])
    UsdGeom.Xformable(stage.GetPrimAtPath(MESH)).AddTranslateOp().Set((-1e6, 0, 0))


REFUSED: dict[str, tuple[str, Callable[[Usd.Stage], object]]] = {
    "a reference that is missing": ("missing_file", _reference("./gone.usda")),
    "a reference to no layer": ("missing_file", _reference("./tex.png")),
    "a reference that leads out": ("external_uri", _reference("../secret.usda")),
    "a reference to a server": ("external_uri", _reference("https://localhost/a.usda")),
    "counts that do not add up": ("load_error", _broken("faceVertexCounts", [3])),
    "an index of no point": ("load_error", _broken("faceVertexIndices", [0, 1, 99] * 12)),
    "a point that is no number": ("load_error", _broken("points", [(np.nan, 0, 0)] * 24)),
    "no polygons": (
        "no_faces",
        lambda stage: (
            stage.GetPrimAtPath(MESH).GetAttribute("faceVertexCounts").Block()
            or stage.GetPrimAtPath(MESH).GetAttribute("faceVertexIndices").Block()
        ),
    ),
    "a patch": ("unsupported_primitive", lambda stage: UsdGeom.NurbsPatch.Define(stage, "/W/a")),
    "bones": ("skinned_mesh", _skinned),
    "a crowd": ("too_many_instances", _crowd),
    "points far from their origin": ("offset_precision", _far_points),
}


@for_each("name", REFUSED)
def test_what_would_give_another_mesh_is_refused(tmp_path: Path, name: str) -> None:
    reason, change = REFUSED[name]
    folder = tmp_path / "objects"
    folder.mkdir()
    (folder / "tex.png").write_bytes(picture_bytes(CORNERS))
    (tmp_path / "secret.usda").write_text("#usda 1.0\n")
    stage = new_stage()
    usd_mesh(stage, BOX)
    change(stage)
    path = exported(stage, folder / "a.usda")
    assert reason_of(path, AssetSettings(max_instances=15)) == reason


def test_files_that_are_none_or_are_cut_off(tmp_path: Path) -> None:
    stage = new_stage()
    usd_mesh(stage, BOX)
    whole = exported(stage, tmp_path / "a.usdc").read_bytes()
    for name, data in (("b.usdc", whole[: len(whole) // 2]), ("c.usda", whole), ("d.usdz", whole)):
        (tmp_path / name).write_bytes(data)
        assert reason_of(tmp_path / name) == "load_error", name
    assert reason_of(tmp_path / "gone.usd") == "missing_file"
    few = AssetSettings(max_source_bytes=len(whole) - 1)
    assert reason_of(tmp_path / "a.usdc", few) == "too_large_bytes"


def test_layers_count_together_and_few_bytes_may_hold_millions_of_polygons(tmp_path: Path) -> None:
    part = new_stage()
    usd_mesh(part, BOX)
    size = exported(part, tmp_path / "part.usda").stat().st_size
    stage = new_stage()
    _reference("./part.usda")(stage)
    path = exported(stage, tmp_path / "a.usda")
    whole = size + path.stat().st_size
    assert prepare(path, AssetSettings(max_source_bytes=whole)).levels
    assert reason_of(path, AssetSettings(max_source_bytes=whole - 1)) == "too_large_bytes"
    made = usd_mesh(stage, BOX)
    counts, indices = np.full(2_000_000, 3, np.int32), np.arange(6_000_000, dtype=np.int32) % 3
    made.GetFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts))
    made.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(indices))
    path = exported(stage, tmp_path / "a.usdc")
    assert path.stat().st_size < 1_000_000
    assert reason_of(path) == "too_many_faces"


def test_pictures_are_lost_with_a_reason(tmp_path: Path) -> None:
    picture, folder = picture_bytes(CORNERS), tmp_path / "o"
    (tmp_path / "secret.png").write_bytes(picture)

    def named(file: str) -> Callable[[Usd.Stage], object]:
        return lambda stage: set_inputs(stage, TEXTURE, {"file": file})

    def reason(file: str) -> str:
        return lost(textured_usd(folder / "a.usda", picture, named(file)))

    assert reason("../secret.png") == reason("/etc/hostname") == "texture_outside"
    assert reason("http://127.0.0.1:1/a.png") == "texture_outside"
    assert reason("./gone.png") == "texture_missing"
    assert lost(textured_usd(folder / "a.usda", b"no picture")) == "texture_unreadable"
    small = dataclasses.replace(KEEP.own_materials, max_pixels=3)
    path = textured_usd(folder / "a.usda", picture)
    assert lost(path, AssetSettings(own_materials=small)) == "texture_too_large"


def test_coordinates_that_are_absent_or_no_numbers(tmp_path: Path) -> None:
    picture = picture_bytes(CORNERS)

    def absent(stage: Usd.Stage) -> None:
        stage.GetPrimAtPath(MESH).GetAttribute("primvars:st").Clear()

    def too_few(stage: Usd.Stage) -> None:
        stage.GetPrimAtPath(MESH).GetAttribute("primvars:st").Set([Gf.Vec2f(0, 0)] * 3)

    for change in (absent, too_few):
        assert lost(textured_usd(tmp_path / "a.usda", picture, change)) == "no_texture_coordinates"
    path = textured_usd(tmp_path / "b.usda", picture, uv=np.where(UV_UP == 1, np.inf, UV_UP))
    assert lost(path) == "texture_coordinates_not_finite"


def test_materials_that_are_none_or_make_no_sense(tmp_path: Path) -> None:
    stage = new_stage()
    usd_mesh(stage, BOX)
    assert lost(exported(stage, tmp_path / "a.usda")) == "no_materials"

    def unknown(stage: Usd.Stage) -> None:
        stage.GetPrimAtPath(SHADER).GetAttribute("info:id").Set("SomeOtherSurface")

    path = textured_usd(tmp_path / "b.usda", picture_bytes(CORNERS), unknown)
    assert lost(path) == "materials_unreadable"


def test_the_stage_makes_it_in_a_child_and_again_when_a_part_changes(bench: Bench) -> None:
    """USD is never parsed here; layers and pictures that it names are part of its digest."""
    folder = bench.root
    part = new_stage()
    usd_mesh(part, BOX)
    exported(part, folder / "part.usda")
    textured_usd(folder / "a.usda", picture_bytes(CORNERS), _reference("./part.usda"))

    def made() -> list[str]:
        prepared, failures = run(bench, "a.usda", settings=KEEP)
        assert not failures
        found = stored_asset(bench, prepared[0])
        assert found.materials is not None and not found.materials.reason
        return [prepared[0].asset_name, found.source_sha256]

    first = made()
    assert made() == first
    (folder / "tex.png").write_bytes(picture_bytes(CORNERS[::-1]))
    second = made()
    assert second[0] != first[0] and second[1] != first[1]
    usd_mesh(part, moved(BOX, [1, 1, 2]))
    exported(part, folder / "part.usda")
    third = made()
    assert third[0] != second[0]
    assert len(bench.calls) == 3
    (folder / "part.usda").unlink()
    prepared, (failure,) = run(bench, "a.usda", settings=KEEP)
    assert not prepared and failure.reason == "missing_file"


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    path = textured_usd(tmp_path / "a.usdz", picture_bytes(CORNERS))
    assert geometry(prepare(path)) == geometry(prepare(path))
