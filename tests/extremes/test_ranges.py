"""Every numeric field declares its range; both ends are accepted, and a step outside is refused."""

import dataclasses
import math
import re
import typing
from collections.abc import Iterator
from typing import Annotated, Any, get_args, get_origin

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.setup.settings_page import ROOTS, reachable
from storage.errors import TrilightError
from storage.records.scene import Scene
from storage.records.scene_maps import MAP_ARRAYS, MAX_TEXTURES
from storage.records.texture import CONSTANT
from storage.settings.described import checked, described
from storage.settings.ranges import Columns, Declared, Within, declared_ranges
from tests.conftest import ROOT
from tests.extremes.range_examples import EXAMPLES, FIELDS, End, at_end
from tests.for_each import case
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import textured_scene

ENDS: tuple[End, End] = ("low", "high")
every_end = pytest.mark.parametrize("end", ENDS)


def last_inside(field: Declared, end: End) -> float:
    """Return the extreme number that a range admits."""
    within = field.within
    bound, is_open = {
        "low": (within.low, within.low_open),
        "high": (within.high, within.high_open),
    }[end]
    if field.kind is int:
        assert isinstance(bound, int) and not is_open
        return bound
    return math.nextafter(bound, {"low": math.inf, "high": -math.inf}[end]) if is_open else bound


def first_outside(field: Declared, end: End) -> float:
    """Return the next number beyond."""
    inside = last_inside(field, end)
    if field.kind is int:
        return inside + {"low": -1, "high": 1}[end]
    return math.nextafter(inside, {"low": -math.inf, "high": math.inf}[end])


@every_end
def test_an_end_of_each_field_is_accepted(end: End) -> None:
    for settings, field in FIELDS:
        with case((settings.__name__, field.name)):
            at_end(settings, field, end, last_inside(field, end))


@every_end
def test_one_step_outside_is_refused_by_name(end: End) -> None:
    for settings, field in FIELDS:
        number = first_outside(field, end)
        option = re.sub("_(db|deg|ev)$", "", field.name).replace("_", "-")
        with case((settings.__name__, field.name)):
            with pytest.raises(TrilightError) as caught:
                at_end(settings, field, end, number)
            message = str(caught.value)
            assert f"{field.name} is " in message or f"--{option} is " in message
            assert f"expected {field.expected}." in message
            assert repr(number) in message
            assert "\n" not in message


def test_other_kinds_of_values_are_refused() -> None:
    for settings, field in FIELDS:
        with case((settings.__name__, field.name)):
            _require_refusals(settings, field)


def _require_refusals(settings: type, field: Declared) -> None:
    wrong: list[Any] = [math.nan, math.inf, -math.inf, True, "1", (1, 2, 3) * 3]
    if field.kind is int:
        wrong.append(last_inside(field, "low") + 0.5)
    for value in wrong:
        with pytest.raises(TrilightError, match="expected"):
            at_end(settings, field, "low", value)
    if field.shape != "one":
        (default,) = (each.default for each in described(settings) if each.name == field.name)
        for value in ((), 1.0, [1.0, 2.0], None):
            if value == default:  # none at all, where that means what comes by itself
                continue
            with pytest.raises(TrilightError, match="expected"):
                dataclasses.replace(EXAMPLES[settings], **{field.name: value})


def _numbers(hint: Any) -> Iterator[bool]:
    """Yield for each number of a type whether a range is declared around it."""
    if get_origin(hint) is Annotated:
        inner, *notes = get_args(hint)
        declared = any(isinstance(note, Within | Columns) for note in notes)
        yield from (declared or found for found in _numbers(inner))
    elif hint in (int, float) or (isinstance(hint, type) and issubclass(hint, np.number)):
        yield False
    elif get_origin(hint) is not typing.Literal:
        for part in get_args(hint):
            yield from _numbers(part)


def test_no_number_is_without_a_range() -> None:
    undeclared = [
        f"{settings.__name__}.{name}"
        for roots in ROOTS.values()
        for settings in reachable(*roots)
        if settings is Scene or settings in EXAMPLES or _is_settings(settings.__name__)
        for name, hint in typing.get_type_hints(settings, include_extras=True).items()
        if not all(_numbers(hint))
    ]
    assert undeclared == []


def test_the_walk_sees_a_number_without_a_range() -> None:
    @dataclasses.dataclass(frozen=True)
    class Group:
        pair: tuple[float, float] | None
        fine: Annotated[int | None, Within(0, 1)]
        words: dict[str, typing.Literal["a"]]

    hints = typing.get_type_hints(Group, include_extras=True)
    assert [all(_numbers(hint)) for hint in hints.values()] == [False, True, True]


INTERNAL = {
    "StreamSettings": "made of TrainSettings",
    "OrderSettings": "made of StreamSettings",
    "PublishedConfig": "a ModelConfig, and one number that the published code fixes",
    "PreviewSettings": "made of Asked",
    "StorageSettings": "has no number",
    "StatusOrder": "has no number",
}
"""Settings that nobody writes, or without numbers."""


def _is_settings(name: str) -> bool:
    return name.endswith(("Settings", "Order", "Config"))


def test_no_class_of_settings_is_forgotten() -> None:
    named = {
        name
        for package in ("scene_templates", "storage", "pipeline", "model", "train", "infra")
        for path in (ROOT / package).rglob("*.py")
        if "bench" not in path.parts
        for name in re.findall(r"^ *class (\w+)", path.read_text(), re.MULTILINE)
        if _is_settings(name)
    }
    reached = {settings.__name__ for settings, _ in FIELDS}
    assert named - reached - set(INTERNAL) == {"DatasetOrder"}, "which DatasetInRuns is"
    assert set(EXAMPLES) == {settings for settings, _ in FIELDS}


def test_what_is_checked_is_what_is_declared() -> None:
    """A field is looked at by its range and by nothing before it: the first wrong one is named."""

    @checked("group", option=str.upper)
    class Group:
        share: Annotated[float, Within(0, 1, high_open=True, unit="parts")] = 0.5

    Group(share=0.0)
    with pytest.raises(TrilightError) as caught:
        Group(share=1.0)
    expected = "group: SHARE is 1.0; expected a number from 0 to below 1 parts."
    assert str(caught.value) == expected


ARRAYS = declared_ranges(Scene)


def _array_name(field: Declared) -> str:
    return field.name + (f"-{field.part.name}" if field.part else "")


PLACES = {
    "vertex_positions": (1, 2), "vertex_normals": (0, 0), "faces": (1, 2), "material_index": 1,
    "object_index": 1, "c2w": (1, 0, 3), "fov_deg": 1,
    "uv": (1, 0), "material_textures": (FLOOR, 1),
    "diffuse": (FLOOR, 1), "specular": (FLOOR, 4), "roughness": (FLOOR, 6), "emission": (LIGHT, 8),
}  # fmt: skip
"""One number of each array, and of each part of the materials."""


def _with(field: Declared, number: Any) -> Scene:
    """Return a dark floor under a light, with one number of an array replaced."""
    scene = textured_scene() if field.name in MAP_ARRAYS else tiny_scene()
    scene.materials[FLOOR] = 0
    if field.name == "vertex_normals":
        scene.vertex_normals[0] = 0
    array: NDArray = getattr(scene, field.name).copy()
    array[_place(field)] = number
    changes: dict[str, Any] = {field.name: array}
    return dataclasses.replace(scene, **changes)


def _place(field: Declared) -> Any:
    return PLACES[field.part.name if field.part else field.name]


@every_end
def test_an_array_of_a_scene_may_reach_the_end(end: End) -> None:
    for field in ARRAYS:
        with case(_array_name(field)):
            _require_end(field, end)


def _require_end(field: Declared, end: End) -> None:
    inwards = {"low": np.float32(np.inf), "high": np.float32(-np.inf)}[end]
    number: Any = getattr(field.within, end)
    if field.kind is float:
        number = np.float32(number)
        is_open = getattr(field.within, f"{end}_open")
        # a normal's length, rounded to float32, is held to the same end by a law of its own
        if is_open or field.name == "vertex_normals":
            number = np.nextafter(number, inwards)
    scene = _with(field, number)
    if field.kind is float:
        scene.check()
        return
    # What rows there are is a law between arrays; the range is that of the type.
    array = getattr(scene, field.name)
    ends = (0, np.iinfo(array.dtype).max)
    if field.name == "material_textures":  # -1 stands for no texture
        ends = (CONSTANT, MAX_TEXTURES - 1)
    assert number == dict(zip(("low", "high"), ends, strict=True))[end]
    assert not field.outside(array).any()
    if end == "low":
        return
    with pytest.raises(TrilightError, match=rf"{field.name}\[.*{number}; expected .*rows below"):
        scene.check()


@every_end
def test_an_array_of_a_scene_beyond_the_end_is_refused(end: End) -> None:
    """But for integers, whose ranges are those of their types: nothing is beyond."""
    outwards = {"low": np.float32(-np.inf), "high": np.float32(np.inf)}[end]
    for field in (field for field in ARRAYS if field.kind is float):
        number = np.float32(getattr(field.within, end))
        if not getattr(field.within, f"{end}_open"):
            with np.errstate(over="ignore"):
                number = np.nextafter(number, outwards)
        place = _place(field)
        index = ", ".join(str(at) for at in (place if isinstance(place, tuple) else (place,)))
        message = rf"{field.name}\[{index}\] is .*; expected"
        with case(_array_name(field)), pytest.raises(TrilightError, match=message):
            _with(field, number).check()
