"""A stage is the same as an object and as a scene: what USD's own library computes of it."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from pipeline.exchange.usd.read_usd import read_usd
from pipeline.foreign.material import source_columns
from pipeline.foreign.picture import FilePictures
from pipeline.foreign.source_file import read_source
from pipeline.foreign.usd.materials import usd_textured_mesh
from storage.errors import Rejected, TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS
from tests.for_each import for_each
from tests.pipeline.assets.source_materials.textured_kit import KEEP, F, new_stage
from tests.pipeline.exchange.exchange_kit import mesh

POINTS = ((0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3))
SIDES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
COLORS = ((0.75, 0.125, 0.125), (0.125, 0.25, 0.625), (0.5, 0.5, 0.25), (0.25, 0.75, 0.5))
COUNTS = {"constant": 1, "uniform": 4, "vertex": 4, "varying": 4, "faceVarying": 12}

Row = tuple[tuple[float, ...], ...]
Looks = Counter[tuple[Row, tuple[float, ...], float]]


def rounded(values: Any) -> np.ndarray:
    """Return numbers as a scene holds them, in three digits."""
    return np.round(np.asarray(values, np.float32).astype(np.float64), 3) + 0.0


def as_row(corners: np.ndarray) -> Row:
    """Return a triangle from its least corner on, so that equal ones are equal."""
    rows = [tuple(corner) for corner in rounded(corners).tolist()]
    first = rows.index(min(rows))
    return tuple(rows[first:] + rows[:first])


def looks_of(corners: Any, colors: Any, roughness: Any) -> Looks:
    return Counter(
        (as_row(triangle), tuple(rounded(color).tolist()), float(rounded(rough)))
        for triangle, color, rough in zip(corners, colors, roughness, strict=True)
    )


def of_object(path: Path) -> Looks:
    """Return the triangles of an object with their colors and roughness."""
    usd = read_source(path, KEEP.read_limits).usd
    assert usd is not None
    parts = usd_textured_mesh(usd, FilePictures(1 << 20))
    tint = np.ones((len(parts.material), 3)) if parts.color is None else parts.color.mean(axis=1)
    columns = np.zeros((len(tint), 7))
    for row in np.unique(parts.material):
        own = parts.material == row
        samples = {"base": tint[own].astype(np.float32)}
        columns[own] = source_columns(parts.materials[row], samples, int(own.sum()))
    return looks_of(parts.mesh.positions[parts.mesh.faces], columns[:, :3], columns[:, 6])


def diffuse_of(rgb: Any) -> tuple[float, ...]:
    """Return the diffuse albedo of such a surface by its base color."""
    return tuple(rounded(np.array(rgb) * (1 - F)).tolist())


def of_scene(path: Path) -> Looks:
    scene = read_usd(path).scene
    rows = scene.materials[scene.material_index]
    own = ~rows[:, EMISSION].any(axis=1)
    corners = scene.vertex_positions[scene.faces][own]
    return looks_of(corners, rows[own][:, DIFFUSE], rows[own][:, ROUGHNESS])


def solid(stage: Usd.Stage, path: str) -> UsdGeom.Mesh:
    return mesh(stage, path, POINTS, [3] * 4, np.ravel(SIDES).tolist())


def saved(stage: Usd.Stage, path: Path) -> Path:
    """Write a stage with a lamp, without which there is no scene."""
    UsdLux.RectLight.Define(stage, "/lamp")
    stage.GetRootLayer().Export(str(path))
    return path


def colored(made: UsdGeom.Mesh, spread: str, *, indexed: bool = False) -> None:
    rows = [row % 4 for row in range(COUNTS[spread])]
    primvar = made.CreateDisplayColorPrimvar(spread)
    primvar.Set(COLORS if indexed else [COLORS[row] for row in rows])
    if indexed:
        primvar.SetIndices(Vt.IntArray(rows))


def reader(stage: Usd.Stage, inputs: dict[str, str]) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, "/m")
    shader = UsdShade.Shader.Define(stage, "/m/s")
    shader.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    for name, primvar in inputs.items():
        kind = Sdf.ValueTypeNames.Float3 if "Color" in name else Sdf.ValueTypeNames.Float
        node = UsdShade.Shader.Define(stage, f"/m/{name}")
        node.CreateIdAttr(f"UsdPrimvarReader_{kind}")
        varname = node.CreateInput("varname", Sdf.ValueTypeNames.String)
        handed = material.CreateInput(f"name_of_{name}", Sdf.ValueTypeNames.String)
        handed.Set(primvar)
        varname.ConnectToSource(handed)
        shader.CreateInput(name, kind).ConnectToSource(node.ConnectableAPI(), "result")
    return material


STATES = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(["Mesh", "Mesh", "Xform", "Xform", "Scope", "", "instance"]),
        "purpose": st.sampled_from([None, None, "default", "render", "proxy", "guide"]),
        "is_hidden": st.sampled_from([False, False, False, True]),
        "is_active": st.sampled_from([True, True, True, False]),
        "specifier": st.sampled_from([Sdf.SpecifierDef] * 3 + [Sdf.SpecifierOver]),
        "move": st.tuples(*[st.integers(-9, 9)] * 3),
        "scale": st.tuples(*[st.sampled_from([1, 1, -1, 2])] * 3),
        "turn": st.sampled_from([0, 90, 180]),
        "resets": st.sampled_from([False, False, True]),
        "left": st.booleans(),
        "spread": st.sampled_from([None, *COUNTS]),
    }
)
TREES: Any = st.recursive(
    st.tuples(STATES, st.just([])),
    lambda below: st.tuples(STATES, st.lists(below, min_size=1, max_size=3)),
    max_leaves=8,
)


def build(stage: Usd.Stage, path: str, tree: Any) -> None:
    state, below = tree
    if state["kind"] == "instance":
        prim = stage.DefinePrim(path)
        prim.GetReferences().AddInternalReference("/lib")
        prim.SetInstanceable(True)
    elif state["kind"] == "Mesh":
        made = solid(stage, path)
        made.CreateOrientationAttr("leftHanded" if state["left"] else "rightHanded")
        if state["spread"] is not None:
            colored(made, state["spread"], indexed=state["left"])
        prim = made.GetPrim()
    else:
        prim = stage.DefinePrim(path, state["kind"])
    if image := UsdGeom.Imageable(prim):
        if state["purpose"] is not None:
            image.CreatePurposeAttr(state["purpose"])
        if state["is_hidden"]:
            image.MakeInvisible()
    if place := UsdGeom.Xformable(prim):
        place.AddTranslateOp().Set(state["move"])
        place.AddRotateZOp().Set(state["turn"])
        place.AddScaleOp().Set(state["scale"])
        place.SetResetXformStack(state["resets"])
    for number, child in enumerate([] if prim.IsInstance() else below):
        build(stage, f"{path}/c{number}", child)
    prim.SetSpecifier(state["specifier"])
    prim.SetActive(state["is_active"])


def computed(stage: Usd.Stage) -> Counter[Row]:
    """Return the triangles that USD's library says are seen, in metres with +Z up."""
    found, time = Counter[Row](), Usd.TimeCode.Default()
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        shape = UsdGeom.Mesh(prim)
        if not shape or shape.ComputeVisibility() == "invisible":
            continue
        if shape.ComputePurpose() not in ("default", "render"):
            continue
        place = shape.ComputeLocalToWorldTransform(time)
        points = np.array([place.Transform(Gf.Vec3d(*point)) for point in POINTS]) * unit
        if UsdGeom.GetStageUpAxis(stage) == "Y":
            points = points[:, [0, 2, 1]] * [1, -1, 1]
        turned = place.GetDeterminant() < 0
        step = -1 if turned != (shape.GetOrientationAttr().Get() == "leftHanded") else 1
        found.update(as_row(points[list(side)[::step]]) for side in SIDES)
    return found


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(trees=st.lists(TREES, min_size=1, max_size=3), y_up=st.booleans(), in_cm=st.booleans())
def test_objects_and_scenes_are_what_the_library_computes(
    tmp_path_factory: pytest.TempPathFactory, trees: Any, y_up: bool, in_cm: bool
) -> None:
    stage = new_stage(y_up=y_up, unit=0.5 if in_cm else 1.0)
    library = stage.DefinePrim("/lib", "Xform")
    colored(solid(stage, "/lib/part"), "uniform")
    library.SetSpecifier(Sdf.SpecifierClass)
    for number, tree in enumerate(trees):
        build(stage, f"/W/t{number}", tree)
    path = saved(stage, tmp_path_factory.mktemp("law") / "a.usda")
    expected = computed(stage)
    if not expected:
        with pytest.raises(Rejected, match="no mesh"):
            of_object(path)
        return
    scene = of_scene(path)
    assert Counter(row for row, *_ in scene.elements()) == expected
    if any(color != diffuse_of((0.18, 0.18, 0.18)) for _, color, _ in scene):
        assert of_object(path) == scene


@for_each("spread", COUNTS)
def test_primvars_feed_a_material_as_they_do_a_bare_mesh(tmp_path: Path, spread: str) -> None:
    """Also where the primvar stands above the mesh, and where numbers vary."""
    stage = new_stage()
    made = solid(stage, "/W/a")
    colored(made, spread)
    bare = of_scene(saved(stage, tmp_path / "bare.usda"))
    material = reader(stage, {"diffuseColor": "displayColor", "roughness": "wear"})
    UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(material)
    wear = UsdGeom.PrimvarsAPI(made).CreatePrimvar("wear", Sdf.ValueTypeNames.FloatArray, "uniform")
    wear.Set([0.25, 0.5, 0.75, 0.25])
    path = saved(stage, tmp_path / "a.usda")
    scene = of_scene(path)
    assert of_object(path) == scene
    assert {key[:2] for key in scene} == {key[:2] for key in bare}
    assert sorted(key[2] for key in scene) == [0.25, 0.25, 0.5, 0.75]
    if spread == "constant":
        made.GetPrim().RemoveProperty("primvars:displayColor")
        above = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/W"))
        color = above.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant")
        color.Set([COLORS[0]])
        assert of_scene(saved(stage, tmp_path / "b.usda")) == scene
        color.GetAttr().SetColorSpace("srgb_rec709_scene")
        first = next(iter(of_scene(saved(stage, tmp_path / "c.usda"))))[1]
        assert first == pytest.approx(diffuse_of((0.523, 0.014, 0.014)), abs=2e-3)


@for_each("purpose", ["allPurpose", "full", "preview"])
def test_what_is_bound_for_a_purpose_is_bound(tmp_path: Path, purpose: str) -> None:
    """A full one stands before a preview, unless nobody understands its shader."""
    stage = new_stage()
    made = solid(stage, "/W/a")
    material = reader(stage, {})
    shader = UsdShade.Shader.Get(stage, "/m/s")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(COLORS[0])
    token = "" if purpose == "allPurpose" else purpose
    binding = UsdShade.MaterialBindingAPI.Apply(made.GetPrim())
    binding.Bind(material, materialPurpose=token)
    if purpose == "preview":
        binding.Bind(UsdShade.Material.Define(stage, "/bare"), materialPurpose="full")
    path = saved(stage, tmp_path / "a.usda")
    assert {color for _, color, _ in of_object(path)} == {diffuse_of(COLORS[0])}
    assert of_object(path) == of_scene(path)


@for_each("specifier", [Sdf.SpecifierDef, Sdf.SpecifierOver, Sdf.SpecifierClass])
def test_prototypes_stand_anywhere(tmp_path: Path, specifier: Any) -> None:
    """Below an over or a class, hidden and a guide where they stand; some are away."""
    stage = new_stage()
    many = UsdGeom.PointInstancer.Define(stage, "/W/many")
    colored(solid(stage, "/W/many/kinds/a/shape"), "uniform")
    kind = UsdGeom.Xform.Define(stage, "/W/many/kinds/a")
    kind.AddTranslateOp().Set((0, 0, 7))
    kind.SetResetXformStack(True)
    kinds = UsdGeom.Scope.Define(stage, "/W/many/kinds")
    kinds.MakeInvisible()
    kinds.CreatePurposeAttr("guide")
    kinds.GetPrim().SetSpecifier(specifier)
    many.CreatePrototypesRel().AddTarget("/W/many/kinds/a")
    many.CreateProtoIndicesAttr([0, 0, 0, 0])
    many.CreatePositionsAttr([(k, 0, 0) for k in range(4)])
    many.CreateScalesAttr([(2, 2, 2)] * 4)
    many.CreateIdsAttr([10, 11, 12, 13])
    many.CreateInvisibleIdsAttr([11])
    many.DeactivateId(12)
    path = saved(stage, tmp_path / "a.usda")
    points = np.add(POINTS, (0, 0, 7))
    expected = Counter(as_row(2 * points[list(side)] + [k, 0, 0]) for k in (0, 3) for side in SIDES)
    assert Counter(row for row, *_ in of_object(path).elements()) == expected
    assert of_object(path) == of_scene(path)
    many.CreatePositionsAttr([(0, 0, 0)])
    with pytest.raises(TrilightError, match="not as many as its 4 protoIndices"):
        read_usd(saved(stage, tmp_path / "b.usda"))


def posed(folder: Path, *, on_mesh: bool = False, instanced: bool = False) -> Path:
    stage = new_stage()
    root = UsdSkel.Root.Define(stage, "/W/r")
    bones = UsdSkel.Skeleton.Define(stage, "/W/r/bones")
    pose = UsdSkel.Animation.Define(stage, "/W/r/pose")
    rest = [Gf.Matrix4d(1)]
    values = {"joints": ["a"], "bindTransforms": rest, "restTransforms": rest}
    values |= {"translations": [(0, 0, 1)], "rotations": [Gf.Quatf(1)], "scales": [Gf.Vec3h(1)]}
    values |= {"blendShapes": ["up"], "blendShapeWeights": [0.5]}
    for prim in (bones.GetPrim(), pose.GetPrim()):
        for name in values.keys() & set(prim.GetPropertyNames()):
            prim.GetAttribute(name).Set(values[name])
    made = solid(stage, "/W/r/a")
    colored(made, "uniform")
    UsdGeom.Xformable(made).AddTranslateOp().Set((0, 5, 0))  # counts for nothing: bones pose it
    UsdSkel.BlendShape.Define(stage, "/W/r/a/up").CreateOffsetsAttr([(4, 0, 0)] * 4)
    skin = UsdSkel.BindingAPI.Apply(made.GetPrim())
    skin.CreateSkeletonRel().AddTarget("/W/r/bones")
    skin.CreateJointIndicesPrimvar(True, 1).Set([0])
    skin.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    skin.CreateBlendShapesAttr(["up"])
    skin.CreateBlendShapeTargetsRel().AddTarget("/W/r/a/up")
    animated = made.GetPrim() if on_mesh else bones.GetPrim()
    UsdSkel.BindingAPI.Apply(animated).CreateAnimationSourceRel().AddTarget("/W/r/pose")
    UsdGeom.Xformable(root).AddTranslateOp().Set((0, 0, 20))
    if instanced:
        root.GetPrim().SetSpecifier(Sdf.SpecifierClass)
        prim = stage.DefinePrim("/W/i")
        prim.GetReferences().AddInternalReference("/W/r")
        prim.SetInstanceable(True)
    return saved(stage, folder / "a.usda")


@for_each("instanced", [False, True])
def test_bones_and_blend_shapes_pose_a_mesh_and_an_animation_of_the_mesh_is_refused(
    tmp_path: Path, instanced: bool
) -> None:
    """The latter poses nothing in USD."""
    path = posed(tmp_path, on_mesh=True)
    with pytest.raises(Rejected, match="its animation is bound to the mesh") as caught:
        of_object(path)
    assert caught.value.reason == "skinned_mesh"
    path = posed(tmp_path, instanced=instanced)
    points = np.add(POINTS, (2, 0, 21))
    expected = Counter(as_row(points[list(side)]) for side in SIDES)
    assert Counter(row for row, *_ in of_object(path).elements()) == expected
    assert of_object(path) == of_scene(path)


@for_each("axis", ["X", "Y", "Z"])
def test_solids_are_as_large_as_the_library_says(tmp_path: Path, axis: str) -> None:
    for kind in ("Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Capsule_1", "Plane"):
        stage = new_stage()
        prim = stage.DefinePrim("/W/a", kind)
        for name, value in {"height": 3.0, "width": 5.0, "radiusTop": 0.25, "axis": axis}.items():
            if prim.GetAttribute(name):
                prim.GetAttribute(name).Set(value)
        UsdGeom.Gprim(prim).CreateDisplayColorPrimvar("constant").Set([COLORS[0]])
        path = saved(stage, tmp_path / f"{kind}.usda")
        found = of_object(path)
        assert found == of_scene(path)
        corners = np.array([row for row, *_ in found.elements()])
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), 0)
        reach = [corners.min(axis=(0, 1)), corners.max(axis=(0, 1))]
        assert np.array(reach) == pytest.approx(np.array(extent), abs=2e-3), kind
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if kind != "Plane":  # closed, and facing out
            assert normals.sum(axis=0) == pytest.approx(0, abs=0.02)
            assert np.einsum("ti,ti->", normals, corners[:, 0]) > 0


def test_cases(shared: Path, tmp_path: Path) -> None:
    """Whatever has no color gets one, without which an object has no materials."""
    for case in sorted((shared / "cases").glob("[0-9]*-usd-*/in/*.usda")):
        stage = Usd.Stage.Open(str(case))
        above = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim() or stage.GetPseudoRoot())
        color = above.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant")
        color.Set([COLORS[0]])
        path = saved(stage, tmp_path / "a.usda")
        if case.stem == "skinned":
            with pytest.raises(TrilightError, match="its animation is bound to the mesh"):
                read_usd(path)
            continue
        scene = of_scene(path)
        assert scene == of_object(path), case.stem
        assert scene.total() == {"over": 48, "purpose": 24}.get(case.stem, scene.total())
        if case.stem == "coloured":
            expected = map(diffuse_of, ((0.8, 0.05, 0.05), (0.05, 0.1, 0.7)))
            assert {color for _, color, _ in scene} == set(expected)


def test_a_dome_turns_with_its_pole_and_what_is_not_read_is_named(tmp_path: Path) -> None:
    stage = new_stage()
    solid(stage, "/W/a")
    UsdLux.DomeLight_1.Define(stage, "/old").GetPrim().SetTypeName("DomeLight")
    plain = read_usd(saved(stage, tmp_path / "a.usda")).scene.environment
    stage.GetPrimAtPath("/old").SetTypeName("DomeLight_1")  # of a stage with +Z up
    turned = read_usd(saved(stage, tmp_path / "b.usda")).scene.environment
    assert plain is not None and turned is not None
    up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert turned.rotation == pytest.approx(np.einsum("ij,jk->ik", up, plain.rotation), abs=1e-6)
    light = UsdLux.RectLight.Get(stage, "/lamp")
    light.CreateDiffuseAttr(0.5)
    UsdLux.ShapingAPI.Apply(light.GetPrim()).CreateShapingConeAngleAttr(20)
    UsdLux.DistantLight.Define(stage, "/sun")
    UsdGeom.BasisCurves.Define(stage, "/W/hair")
    UsdGeom.ModelAPI.Apply(stage.GetPrimAtPath("/W/a")).CreateModelDrawModeAttr("cards")
    stage.GetPrimAtPath("/W/a").AddAppliedSchema("MyPaintAPI")
    path = saved(stage, tmp_path / "c.usda")
    unread = read_source(path, KEEP.read_limits).unread
    words = ("1 x BasisCurves", "1 x DistantLight", "API schema MyPaintAPI", "drawMode cards")
    for word in (*words, "1 x RectLight"):
        assert any(word in note for note in unread), word
    for word in (*words, "inputs:diffuse", "cone:angle"):
        assert any(word in note for note in read_usd(path).notes), word
