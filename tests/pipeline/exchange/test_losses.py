"""No form drops what it does not know in silence: an eleventh column, a right, a record."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.exchange import formats
from pipeline.exchange.convert import write_scene
from pipeline.exchange.formats import lost_members
from pipeline.exchange.open_scene import load_source, scene_source
from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS, columns_in_use, laid_out
from storage.records.scene import Scene, SceneObject
from tests.columns_kit import COAT, TINT, WAVES, declared
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import sky, textured_scene

EXACT = ("usda", "usdc", "usdz", "safetensors")


def coated(coat: float) -> Scene:
    """Return the tiny scene with a coat, and two more columns of other widths beside it."""
    scene = tiny_scene()
    for column, part in laid_out():
        if column.name not in PUBLISHED_COLUMNS and coat:
            scene.materials[FLOOR, part] = coat
    return scene


@pytest.fixture
def more_columns() -> Iterator[None]:
    with declared(COAT, TINT, WAVES):
        yield


@pytest.mark.parametrize("form", ["json", "h5"])
@pytest.mark.usefixtures("more_columns")
def test_a_column_that_a_form_does_not_know_is_said_to_be_lost(tmp_path: Path, form: str) -> None:
    lost = "materials.coat, materials.tint, materials.waves"
    path = tmp_path / f"a.{form}"
    assert any(lost in note for note in write_scene(path, coated(0.3)))
    assert not any("coat" in note for note in write_scene(tmp_path / f"b.{form}", coated(0.0)))
    back = load_source(scene_source(str(path))).scene
    assert columns_in_use(back.materials) == PUBLISHED_COLUMNS


@pytest.mark.parametrize("form", EXACT)
@pytest.mark.usefixtures("more_columns")
def test_what_carries_everything_carries_new_columns(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"a.{form}"
    scene = dataclasses.replace(coated(0.3), objects=ATTRIBUTED)
    assert write_scene(path, scene) == ()
    back = load_source(scene_source(str(path)))
    assert back.notes == ()
    assert np.array_equal(back.scene.materials, scene.materials)
    assert lost_members(back.scene, ()) == lost_members(scene, ())
    assert lost_members(back.scene, {field.name for field in dataclasses.fields(Scene)}) == ()


@for_each("form", EXACT)
def test_a_column_at_its_default_changes_no_byte(tmp_path: Path, form: str) -> None:
    before, after = tmp_path / f"a.{form}", tmp_path / f"b.{form}"
    write_scene(before, tiny_scene())
    with declared(COAT, WAVES):
        write_scene(after, tiny_scene())
        assert load_source(scene_source(str(before))).scene.materials.shape == (2, 16)
    assert after.read_bytes() == before.read_bytes()


@for_each("form", EXACT)
def test_a_column_that_is_not_declared_is_an_error_that_names_it(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"a.{form}"
    with declared(COAT):
        write_scene(path, tiny_coated := coated(0.3))
        assert tiny_coated.materials[FLOOR, -1] > 0
    with pytest.raises(TrilightError, match=f"a.{form}.*'coat' is not declared here"):
        load_source(scene_source(str(path)))


@pytest.mark.usefixtures("more_columns")
def test_a_usd_file_that_somebody_changed_keeps_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
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


@pytest.mark.parametrize(
    ("form", "lost"),
    [
        ("json", "objects.uid, objects.licence, objects.attribution, provenance"),
        (
            "h5",
            "object_index, objects.name, objects.kind, objects.uid, objects.licence, "
            "objects.attribution, provenance",
        ),
    ],
)
def test_what_the_published_forms_lose_is_named(tmp_path: Path, form: str, lost: str) -> None:
    scene = dataclasses.replace(tiny_scene(), objects=ATTRIBUTED)
    assert write_scene(tmp_path / f"a.{form}", scene) == (lost,)
    scene.materials[LIGHT, 0] = 0.5
    said = "what 1 emitting materials reflect" in write_scene(tmp_path / f"b.{form}", scene)
    assert said == (form == "h5")


def test_textures_and_a_sky_are_said_to_be_lost_where_they_are(tmp_path: Path) -> None:
    """What comes back has the means of the textures, and is whole."""
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


@pytest.mark.parametrize("form", ["json", "h5"])
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


def test_a_smaller_budget_says_that_textures_go() -> None:
    from pipeline.exchange.scene_budget import within_budget

    scene = textured_scene(environment=sky())
    reduced, notes = within_budget(scene, 3)
    assert not reduced.textures and reduced.environment is scene.environment
    assert any("textures became their means" in note for note in notes)
    assert not any("textures" in note for note in within_budget(tiny_scene(), 3)[1])


def test_the_names_of_members_are_those_of_a_scene() -> None:
    """A claim that is mistyped would claim nothing, and be noticed only as a note too many."""
    from pipeline.exchange.formats import FORMATS

    known = {f"objects.{field.name}" for field in dataclasses.fields(SceneObject)}
    known |= {f"materials.{name}" for name in PUBLISHED_COLUMNS}
    known |= {field.name for field in dataclasses.fields(Scene)}
    for form in FORMATS.values():
        assert set(form.carried) <= known
    assert formats.lost_members(tiny_scene(), known) == ()
