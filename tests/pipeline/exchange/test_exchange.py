"""Scenes through every form and back; what a form loses is said; memory stays."""

import dataclasses
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import trimesh

from infra.bench.workloads.named_scenes import cost_scene
from pipeline.exchange.convert import convert_scene, within_budget, write_scene
from pipeline.exchange.formats import FORMATS, list_lost_members
from pipeline.exchange.reader import SceneSource, load_source, scene_source
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.presets.registry import preset_settings
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.sample_layout import scene_plan
from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS, columns_in_use, laid_out
from storage.records.scene import Scene, SceneObject
from storage.records.scene_file import encode_scene
from tests.columns_kit import COAT, TINT, WAVES, declared
from tests.for_each import for_each, with_folders
from tests.pipeline.exchange import exchange_kit as kit
from tests.pipeline.scenes.example_scenes import EXAMPLES, example_scene
from tests.pipeline.scenes.small_pool import first_scene
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import sky, textured_scene

FIELDS = {
    "": {"mesh_path", "transform", "material"},
    "transform": {"translation", "rotation", "scale", "normalize"},
    "material": {
        *("diffuse", "specular", "roughness", "emissive", "smooth_shading"),
        "rand_tri_diffuse_seed",
    },
}
"""Fields of an object in version 1.0; some of them could be left out for our own reader."""


def assert_usable(path: Path, scene: Scene) -> None:
    """A file with its meshes is what the published converter reads of a scene."""
    described = json.loads(path.read_text())
    assert set(described) == {"scene_name", "version", "objects", "cameras"}
    assert described["version"] == "1.0"
    assert len(described["cameras"]) == scene.num_views
    for camera in described["cameras"]:
        assert set(camera) == {"position", "look_at", "up", "fov"}
    triangles, rows = [], []
    for name, entry in described["objects"].items():
        assert FIELDS == {
            "": set(entry),
            **{name: set(entry[name]) for name in ("transform", "material")},
        }
        assert len(f"{name}.obj".encode()) <= 255 and Path(f"{name}.obj").name == f"{name}.obj"
        mesh = trimesh.load(f"{path.parent}/{entry['mesh_path']}", process=False)
        assert isinstance(mesh, trimesh.Trimesh)
        triangles.append(mesh.triangles.astype(np.float32))
        material = entry["material"]
        row = [*material["diffuse"], *material["specular"], material["roughness"]]
        rows += [[*row, *material["emissive"]]] * len(mesh.triangles)
        assert (np.array(material["diffuse"]) + material["specular"]).max() <= 1 + 1e-6
    assert len({name.casefold() for name in described["objects"]}) == len(described["objects"])
    found = np.concatenate([np.concatenate(triangles).reshape(-1, 9), rows], axis=1)
    corners = scene.vertex_positions[scene.faces].reshape(-1, 9)
    want = np.concatenate([corners, scene.materials[scene.material_index]], axis=1)
    assert np.array_equal(np.unique(found, axis=0), np.unique(want, axis=0))
    assert len(found) == len(want)


@for_each("name", EXAMPLES)
def test_published_scenes_come_back_and_are_written_as_the_published_converter_reads(
    shared: Path, tmp_path: Path, name: str
) -> None:
    scene = example_scene(shared, name)
    kit.assert_usd_keeps_all(scene, tmp_path, ".usdc")
    if scene.num_triangles < 1000:  # textures of 53 kB a triangle are slow to pack
        write_renderformer_h5(tmp_path / "again.h5", scene)
        kit.assert_h5_keeps_light(read_renderformer_h5(tmp_path / "again.h5").scene, scene)
    back, lost = kit.json_and_back(scene, tmp_path)
    kit.assert_json_keeps_light(back, scene)
    if scene.num_triangles <= 6000:
        again, lost_again = kit.json_and_back(back, tmp_path)
        kit.assert_json_keeps_light(again, back)
        assert len(lost_again) <= len(lost)
    write_scene(tmp_path / "a.json", scene)
    assert_usable(tmp_path / "a.json", scene)
    if name == "init-template":
        (child := tmp_path / "by a child").mkdir()  # as `trilight convert` writes
        (child / "a.safetensors").write_bytes(encode_scene(scene))
        source = scene_source(str(child / "a.safetensors"))
        convert_scene(source, child / "a.json", budget=None, done=lambda finished, of: None)
        assert_usable(child / "a.json", scene)


@for_each(
    ("build", "templates"),
    [
        ("renderformer-v1-256", {"plane", "wall", "corner", "open_box"}),
        ("benchmark-v1", {"open_box"}),
    ],
)
def test_sampled_scenes_come_back(
    pool: list[PooledAsset], tmp_path: Path, build: str, templates: set[str]
) -> None:
    """Rooms with a colour a triangle, smooth objects, emitters that reflect."""
    settings, left, index = preset_settings(build).scenes, set(templates), 0
    while left:
        template = scene_plan(settings, seed=1, scene_index=index).family.template
        if template in left:
            left.remove(template)
            scene = first_scene(settings, pool, seed=1, scene_index=index)
            (folder := tmp_path / template).mkdir()
            kit.assert_usd_keeps_all(scene, folder, ".usdc")
            kit.assert_json_keeps_light(kit.json_and_back(scene, folder)[0], scene)
        index += 1


def test_any_names_become_names_of_files(tmp_path: Path) -> None:
    names = [("light/../x", "light\\..\\x"), ("A", "a"), (".", ".."), ("", "\0")]
    for folder, (shell, emitter) in with_folders(tmp_path, [*names, ("ü" * 200, "ü" * 100)]):
        light = SceneObject(name=emitter, kind="emitter")
        scene = tiny_scene(objects=(SceneObject(name=shell, kind="shell"), light))
        write_scene(folder / "a.json", scene)
        assert_usable(folder / "a.json", scene)


WARM, SCENES = 50, 200
PAGE = 4096


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def grown_bytes(folder: Path, form: str) -> int:
    """Return what memory grew by after the first fifty scenes; each has names of its own."""
    scene = cost_scene(400, 4)
    before = 0
    for index in range(SCENES):
        objects = tuple(
            dataclasses.replace(entry, name=f"{entry.name}{index}", uid=f"uid{index}")
            for entry in scene.objects
        )
        path = folder / f"{index}.{form}"
        write_scene(path, dataclasses.replace(scene, objects=objects))
        load_source(SceneSource(path=path, key=None))
        path.unlink()
        if index == WARM:
            before = resident_bytes()
    return resident_bytes() - before


@pytest.mark.slow("memory")
@pytest.mark.parametrize("form", ["usdc", "json"])
def test_scenes_do_not_pile_up(tmp_path: Path, form: str) -> None:
    """Measured: 5 to 6 MB in 900 scenes, 6 kB each: USD forgets no name.

    One layer of this scene takes 170 kB, so that keeping each of 150 would be 25 MB.
    """
    limits = ChildLimits(memory_bytes=8 << 30, wall_s=1800, calls_per_child=1)
    with closing(IsolatedChild(limits=limits)) as child:
        assert child.call(grown_bytes, tmp_path, form) < 12e6


def coated(coat: float) -> Scene:
    """Return the tiny scene with a coat, and two more columns of other widths beside it."""
    scene = tiny_scene()
    for column, part in laid_out():
        if column.name not in PUBLISHED_COLUMNS and coat:
            scene.materials[FLOOR, part] = coat
    return scene


@for_each("form", ["json", "h5"])
def test_a_column_that_a_form_does_not_know_is_said_to_be_lost(tmp_path: Path, form: str) -> None:
    lost = "materials.coat, materials.tint, materials.waves"
    path = tmp_path / f"a.{form}"
    with declared(COAT, TINT, WAVES):
        assert any(lost in note for note in write_scene(path, coated(0.3)))
        assert not any("coat" in note for note in write_scene(tmp_path / f"b.{form}", coated(0.0)))
        back = load_source(scene_source(str(path))).scene
        assert columns_in_use(back.materials) == PUBLISHED_COLUMNS


@for_each("form", ["usda", "usdc", "usdz", "safetensors"])
def test_what_carries_everything_carries_new_columns(tmp_path: Path, form: str) -> None:
    """At its default a column changes no byte; undeclared it is an error that names it."""
    path, before, after = (tmp_path / f"{name}.{form}" for name in "abc")
    write_scene(before, tiny_scene())
    with declared(COAT, TINT, WAVES):
        scene = dataclasses.replace(coated(0.3), objects=ATTRIBUTED)
        assert write_scene(path, scene) == ()
        back = load_source(scene_source(str(path)))
        assert back.notes == ()
        assert np.array_equal(back.scene.materials, scene.materials)
        assert list_lost_members(back.scene, ()) == list_lost_members(scene, ())
        every_member = {field.name for field in dataclasses.fields(Scene)}
        assert list_lost_members(back.scene, every_member) == ()
        write_scene(after, tiny_scene())
        wide = load_source(scene_source(str(before))).scene.materials
        assert wide.shape == scene.materials.shape
    assert after.read_bytes() == before.read_bytes()
    with pytest.raises(TrilightError, match=f"a.{form}.*'coat' is not declared here"):
        load_source(scene_source(str(path)))


def test_a_usd_file_that_somebody_changed_keeps_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    with declared(COAT, TINT, WAVES):
        write_scene(path, coated(0.3))
        changed = path.read_text().replace("inputs:roughness = 0.5", "inputs:roughness = 0.4")
        path.write_text(changed)
        back = load_source(scene_source(str(path))).scene
        assert columns_in_use(back.materials) == (*PUBLISHED_COLUMNS, "coat", "tint", "waves")
        outside = changed.replace("trilight:column:coat = 0.3", "trilight:column:coat = 7")
        path.write_text(outside.replace("trilight:column:tint", "trilight:column:shade"))
        with pytest.raises(TrilightError, match="'shade' is not declared here"):
            load_source(scene_source(str(path)))
        path.write_text(outside)
        loaded = load_source(scene_source(str(path)))
        assert columns_in_use(loaded.scene.materials) == (*PUBLISHED_COLUMNS, "tint", "waves")
    assert any("coat: expected 1 numbers from 0 to 1" in note for note in loaded.notes)


ATTRIBUTED = (
    SceneObject(name="floor", kind="shell", uid="u", licence="CC-BY-4.0", attribution="Ada"),
    SceneObject(name="light", kind="emitter"),
)


def test_what_the_published_forms_lose_is_named(tmp_path: Path) -> None:
    rights = "objects.uid, objects.licence, objects.attribution, provenance"
    for form, more in (("json", ""), ("h5", "object_index, objects.name, objects.kind, ")):
        scene = dataclasses.replace(tiny_scene(), objects=ATTRIBUTED)
        assert write_scene(tmp_path / f"a.{form}", scene) == (more + rights,)
        scene.materials[LIGHT, 0] = 0.5
        said = "albedos of 1 emitting materials" in write_scene(tmp_path / f"b.{form}", scene)
        assert said == (form == "h5")


def test_textures_and_a_sky_are_said_to_be_lost_where_they_are(tmp_path: Path) -> None:
    """What comes back is whole, with the means of the textures; a smaller budget says that, too."""
    path = tmp_path / "a.json"
    scene = textured_scene(environment=sky())
    before = set(write_scene(tmp_path / "b.json", tiny_scene()))
    ((lost), *more) = (note for note in write_scene(path, scene) if note not in before)
    assert lost.endswith("textures, environment") and not more
    back = load_source(scene_source(str(path))).scene
    back.check()
    assert not back.textures and back.environment is None
    means = [texture.mean for texture in scene.textures]
    row = back.materials[back.material_index[0]]
    assert np.allclose(row[[0, 1, 2, 6]], np.concatenate(means), atol=1e-3)  # H5 holds halves
    reduced = within_budget(scene, 3)
    assert not reduced.scene.textures and reduced.scene.environment is scene.environment
    assert any("textures became their means" in note for note in reduced.notes)
    plain = within_budget(tiny_scene(), 3)
    assert not any("textures" in note for note in plain.notes)


@pytest.mark.parametrize("form", ["json", "h5", "glb"])
def test_a_scene_that_only_its_sky_lights_is_not_written_dark(tmp_path: Path, form: str) -> None:
    plain = tiny_scene()
    materials = plain.materials.copy()
    materials[LIGHT, 7:] = 0
    objects = (plain.objects[0], SceneObject(name="other", kind="shell"))
    scene = tiny_scene(materials=materials, objects=objects, environment=sky())
    scene.check()
    with pytest.raises(TrilightError, match="only light is its environment.*safetensors"):
        write_scene(tmp_path / f"a.{form}", scene)
    assert list(tmp_path.iterdir()) == []


def test_the_names_of_members_are_those_of_a_scene() -> None:
    """A claim that is mistyped would claim nothing, and be noticed only as a note too many."""
    known = {f"objects.{field.name}" for field in dataclasses.fields(SceneObject)}
    known |= {f"materials.{name}" for name in PUBLISHED_COLUMNS}
    known |= {field.name for field in dataclasses.fields(Scene)}
    for form in FORMATS.values():
        assert set(form.carried) <= known
    assert list_lost_members(tiny_scene(), known) == ()
