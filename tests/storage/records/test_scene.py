"""Every law of a scene is stated, and its error names the field and the first offending index."""

from typing import Any

import numpy as np
import pytest

from storage.errors import TrilightError
from storage.records.scene import ARRAY_FIELDS, SceneObject
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_scene


def _changed(field: str, index: Any, value: Any) -> dict[str, Any]:
    array = getattr(tiny_scene(), field).copy()
    array[index] = value
    return {field: array}


def test_a_valid_scene_passes() -> None:
    tiny_scene().check()


@for_each("field", [n for n, (d, _) in ARRAY_FIELDS.items() if d is np.float32])
@for_each("value", [np.nan, np.inf, -np.inf])
def test_non_finite_values_are_named(field: str, value: float) -> None:
    array = getattr(tiny_scene(), field)
    index = tuple(size - 1 for size in array.shape)
    with pytest.raises(TrilightError, match=rf"{field}\[{index[0]}.*finite"):
        tiny_scene(**_changed(field, index, value)).check()


@for_each("field", ARRAY_FIELDS)
def test_another_dtype_or_shape_is_named(field: str) -> None:
    array = getattr(tiny_scene(), field)
    with pytest.raises(TrilightError, match=f"{field} has dtype"):
        tiny_scene(**{field: array.astype(np.int8)}).check()
    with pytest.raises(TrilightError, match=f"{field} has shape"):
        tiny_scene(**{field: array[..., None]}).check()


BROKEN = [
    (_changed("faces", (1, 2), 7), r"faces\[1, 2\] is 7"),
    (_changed("material_index", 2, 2), r"material_index\[2\] is 2"),
    (_changed("object_index", 0, 9), r"object_index\[0\] is 9"),
    (_changed("vertex_normals", 3, [0, 0, 0.5]), r"vertex_normals\[3\] is 0.5"),
    (_changed("materials", (0, 6), 1.5), r"materials\[0, 6\] is 1.5.*roughness from 0 to 1"),
    (_changed("materials", (0, 0), -0.1), r"materials\[0, 0\] is -0.1.*diffuse from 0 to 1"),
    (_changed("materials", (0, 0), 0.9), r"materials\[0, 0\] is 1.1.*at most 1"),
    (_changed("materials", (1, 8), -1), r"materials\[1, 8\] is -1.*emission from 0"),
    (_changed("materials", (1, slice(7, 10)), 0), "no emission"),
    (_changed("fov_deg", 1, 180), r"fov_deg\[1\] is 180.*above 0 and below 180 degrees"),
    (_changed("c2w", (0, slice(0, 3), 0), 0), r"c2w\[0\].*orthonormal"),
    (_changed("c2w", (1, 3, 3), 2), r"c2w\[1\].*last row"),
    (_changed("object_index", 2, 0), r"objects\[2\] .*emitter exactly"),
    ({"c2w": np.zeros((0, 4, 4), np.float32), "fov_deg": np.zeros(0, np.float32)}, "one camera"),
    ({"objects": (SceneObject(name="a", kind="shell"),) * 2}, "'a' twice"),
    ({"fov_deg": np.array([40], np.float32)}, "fov_deg has 1 rows; expected 2"),
]


@for_each(("changes", "message"), BROKEN)
def test_a_broken_law_names_field_value_and_index(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        tiny_scene(**changes).check()


def test_mirrored_cameras_are_refused() -> None:
    mirrored = tiny_scene().c2w @ np.diag([-1, 1, 1, 1]).astype(np.float32)
    with pytest.raises(TrilightError, match="without mirroring"):
        tiny_scene(c2w=mirrored).check()


def test_albedo_that_sums_to_one_in_float32_is_legal() -> None:
    materials = tiny_scene().materials.copy()
    specular = np.float32(1 / 3)
    materials[0, :6] = [np.float32(1) - specular] * 3 + [specular] * 3
    tiny_scene(materials=materials).check()


def test_emitting_triangles_are_those_with_an_emitting_material() -> None:
    assert tiny_scene().triangle_emits.tolist() == [False, False, True]
