"""Changes of a scene: what moves, what stays, and what is refused."""

from typing import Any

import numpy as np
import pytest

from infra.viewer.edits import edited
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS
from tests.for_each import case
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import textured_scene


def test_nothing_is_the_scene_itself() -> None:
    scene = tiny_scene()
    assert edited(scene, {}) is scene
    assert edited(scene, {"lamps": {}, "materials": {}}) is scene


def test_a_lamp_moves_and_shines_brighter_and_all_else_stays() -> None:
    scene = tiny_scene()
    found = edited(scene, {"lamps": {str(LIGHT): {"move": [0.5, 0, -1], "gain": 2}}})
    lamp = scene.faces[2]
    assert found.vertex_positions[lamp] == pytest.approx(
        scene.vertex_positions[lamp] + np.array([0.5, 0, -1])
    )
    np.testing.assert_array_equal(found.vertex_positions[:4], scene.vertex_positions[:4])
    assert found.materials[LIGHT, EMISSION].tolist() == [200, 200, 200]
    assert found.materials[FLOOR].tolist() == scene.materials[FLOOR].tolist()


def test_a_material_takes_the_place_of_its_texture() -> None:
    scene = textured_scene()
    found = edited(scene, {"materials": {"0": {"diffuse": [0.1, 0.2, 0.3]}}})
    assert found.materials[FLOOR, DIFFUSE] == pytest.approx([0.1, 0.2, 0.3])
    assert len(found.textures) == len(scene.textures) - 1
    bare = edited(scene, {"materials": {"0": {"diffuse": [0.1, 0.2, 0.3], "roughness": 0.7}}})
    assert bare.uv is None and not bare.textures
    assert bare.materials[FLOOR, ROUGHNESS] == pytest.approx(0.7)
    assert len(scene.textures) == 2, "the scene that was read stays as it is"


MEANINGLESS: list[tuple[dict[str, Any], str]] = [
    ({"lamps": {"0": {}}}, "no lamp"),
    ({"lamps": {"9": {}}}, "no lamp"),
    ({"lamps": {"-1": {}}}, "no lamp"),
    ({"lamps": {"1": {"move": [0, 0]}}}, "move"),
    ({"lamps": {"1": {"move": [0, 0, 1e9]}}}, "move"),
    ({"lamps": {"1": {"move": [0, 0, float("nan")]}}}, "move"),
    ({"lamps": {"1": {"gain": 0}}}, "gain"),
    ({"lamps": {"1": {"gain": "much"}}}, "gain"),
    ({"lamps": {"1": 3}}, "lamps"),
    ({"lamps": [1]}, "lamps"),
    ({"materials": {"7": {}}}, "no material 7"),
    ({"materials": {"x": {}}}, "materials"),
    ({"materials": {"0": {"diffuse": [2, 0, 0]}}}, "diffuse"),
    ({"materials": {"0": {"diffuse": [0.9, 0.9, 0.9]}}}, "diffuse \\+ specular"),
    ({"materials": {"0": {"roughness": -1}}}, "roughness"),
]


def test_what_means_nothing_is_refused() -> None:
    for edits, says in MEANINGLESS:
        with case(edits):
            with pytest.raises(TrilightError, match=says):
                edited(tiny_scene(), edits)
