"""Settings refuse contradictions, and name the field."""

import dataclasses
import json
import math
from typing import Any

import pytest

from scene_templates.registry import TEMPLATES
from scene_templates.settings import SHELL_TRIANGLES, SceneSettings
from storage.errors import TrilightError

CONTRADICTIONS: list[tuple[str, Any]] = [
    ("templates", ()),
    ("templates", ("plane", "cave")),
    ("max_triangles", 522),  # the open box 512, 8 emitters, 3 objects: 523
    ("max_triangles", -1),
    ("num_views", 0),
    ("num_views", 1.5),
    ("num_objects", (3, 1)),
    ("num_objects", (1.0, 3.0)),
    ("num_lights", (0, 8)),
    ("object_scale", (0.0, 1.0)),
    ("object_scale", (1.0, math.inf)),
    ("total_emission", (5000.0, 2500.0)),
    ("square_share", 1.01),
    ("smooth_share", math.nan),
    ("min_coverage", -0.1),
    ("min_depth", math.inf),
    ("albedo_sum", (0.9, 1.1)),
    ("roughness_clip", (0.01, 1.5)),
    ("roughness_bias", 0.07),
    ("shell_tilt_deg", 45.0),
    ("fov_deg", (30.0, 180.0)),
    ("room_raise", (0.1, -0.1)),
]


@pytest.mark.parametrize(("name", "value"), CONTRADICTIONS)
def test_a_contradiction_is_one_line_that_names_its_field(name: str, value: Any) -> None:
    with pytest.raises(TrilightError) as caught:
        SceneSettings(**{name: value})
    message = str(caught.value)
    assert name in message
    assert "\n" not in message


def test_the_least_triangle_limit_depends_on_the_templates_in_use() -> None:
    SceneSettings(templates=("open_box",), max_triangles=523)
    SceneSettings(templates=("plane",), max_triangles=139)
    with pytest.raises(TrilightError, match="at least 139"):
        SceneSettings(templates=("plane",), max_triangles=138)


def test_settings_are_plain_values_for_a_manifest() -> None:
    text = json.dumps(dataclasses.asdict(SceneSettings()))
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in json.loads(text).items()
    }
    assert SceneSettings(**values) == SceneSettings()


def test_registry_and_settings_know_the_same_templates() -> None:
    assert list(TEMPLATES) == list(SHELL_TRIANGLES)
    for name, template in TEMPLATES.items():
        assert template.name == name
        assert SHELL_TRIANGLES[name] == 128 * len(template.parts)
