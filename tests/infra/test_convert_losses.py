"""No form drops what it does not know in silence: an eleventh column, a right, a record."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.flows.convert_scene import write_scene
from pipeline.flows.scene_source import load_source, scene_source
from storage import carried, conventions
from storage import scene as scenes
from storage.carried import lost_members
from storage.scene import Scene, SceneObject
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene

FORMS = ("usda", "usdc", "usdz", "json", "h5")
EXACT = ("usda", "usdc", "usdz", "safetensors")


def coated(coat: float) -> Scene:
    """Return the tiny scene with an eleventh material column, which no form knows."""
    base = tiny_scene()
    column = np.zeros((len(base.materials), 1), np.float32)
    column[FLOOR] = coat
    return dataclasses.replace(base, materials=np.concatenate([base.materials, column], axis=1))


@pytest.fixture
def eleven(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let scenes have the column, as they would where one more is declared."""
    monkeypatch.setitem(scenes.ARRAY_FIELDS, "materials", (np.float32, (None, 11)))


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.usefixtures("eleven")
def test_a_column_that_a_form_does_not_know_is_said_to_be_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, declared: bool
) -> None:
    name = "materials.10 to 10"
    if declared:
        monkeypatch.setitem(conventions.MATERIAL_COLUMNS, "coat", slice(10, 11))
        name = "materials.coat"
    assert any(name in note for note in write_scene(tmp_path / f"a.{form}", coated(0.3)))
    assert not any(name in note for note in write_scene(tmp_path / f"b.{form}", coated(0.0)))


@pytest.mark.usefixtures("eleven")
def test_a_form_of_whole_arrays_carries_new_columns(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    assert write_scene(path, coated(0.3)) == ()
    back = load_source(scene_source(str(path))).scene
    assert np.array_equal(back.materials, coated(0.3).materials)


@pytest.mark.parametrize("form", EXACT)
def test_what_carries_everything_says_nothing(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"a.{form}"
    scene = dataclasses.replace(tiny_scene(), objects=ATTRIBUTED)
    assert write_scene(path, scene) == ()
    back = load_source(scene_source(str(path))).scene
    every_member = {field.name for field in dataclasses.fields(Scene)}
    assert lost_members(back, ()) == lost_members(scene, ())
    assert lost_members(back, every_member) == ()


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


def test_what_emitters_reflect_is_lost_in_the_published_arrays(tmp_path: Path) -> None:
    base = tiny_scene()
    materials = base.materials.copy()
    materials[LIGHT, 0] = 0.5
    scene = dataclasses.replace(base, materials=materials)
    notes = write_scene(tmp_path / "a.h5", scene)
    assert "what 1 emitting materials reflect" in notes


def test_the_names_of_members_are_those_of_a_scene() -> None:
    """A claim that is mistyped would claim nothing, and be noticed only as a note too many."""
    from pipeline.flows.scene_formats import FORMATS

    known = {f"objects.{field.name}" for field in dataclasses.fields(SceneObject)}
    known |= {f"materials.{name}" for name in conventions.MATERIAL_COLUMNS}
    known |= {field.name for field in dataclasses.fields(Scene)}
    for form in FORMATS.values():
        assert set(form.carried) <= known
    assert carried.lost_members(tiny_scene(), known) == ()
