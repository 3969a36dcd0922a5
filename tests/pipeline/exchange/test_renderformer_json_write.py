"""A scene as RenderFormer's JSON and back: the same triangles in the same light."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.exchange.renderformer_json_write import described_files
from storage.errors import TrilightError
from storage.records.scene import SceneObject
from tests.pipeline.exchange.exchange_kit import assert_json_keeps_light, json_and_back
from tests.scenes_by_hand import LIGHT, tiny_scene


def test_a_scene_by_hand(tmp_path: Path) -> None:
    back, lost = json_and_back(tiny_scene(), tmp_path)
    assert_json_keeps_light(back, tiny_scene())
    assert np.array_equal(
        back.vertex_normals[back.faces], tiny_scene().vertex_normals[tiny_scene().faces]
    )
    assert [(o.name, o.kind) for o in back.objects] == [("floor", "shell"), ("light", "emitter")]
    assert lost == ()
    described = json.loads((tmp_path / "again.json").read_text())
    assert described["objects"]["floor"]["mesh_path"].startswith("templates/backgrounds/")


def test_an_object_of_many_colours_and_odd_names(tmp_path: Path) -> None:
    base = tiny_scene()
    scene = dataclasses.replace(
        base,
        materials=np.concatenate([base.materials, base.materials[:1] / 2]),
        material_index=np.array([0, 2, LIGHT], np.uint16),
        objects=(
            SceneObject(name="a/..\n\0ü", kind="object", uid="u"),
            SceneObject(name="light", kind="emitter"),
        ),
    )
    back, lost = json_and_back(scene, tmp_path)
    assert_json_keeps_light(back, scene)
    assert [entry.name for entry in back.objects] == [
        "a_..__ü.material0", "a_..__ü.material2", "light",
    ]  # fmt: skip
    assert lost == ("that 2 of its objects were 1, of several materials",)
    written = [path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*.obj")]
    assert set(written) == {"objects"}


def test_normals_that_no_reader_makes_are_said_to_be_lost(tmp_path: Path) -> None:
    base = tiny_scene()
    normals = base.vertex_normals.copy()
    normals[0] = [0.6, 0, 0.8]
    _, lost = json_and_back(dataclasses.replace(base, vertex_normals=normals), tmp_path)
    assert "floor: shading normals; readers make their own" in lost


def test_too_many_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.exchange.renderformer_json_write.MAX_OBJECTS", 1)
    with pytest.raises(TrilightError, match="2 objects of one material; a scene file holds at"):
        described_files(tiny_scene(), "a")
