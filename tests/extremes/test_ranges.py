"""Every numeric field declares its range; both ends are accepted, and a step outside is refused.

Of every class there is an example, and what else must hold where a field stands at an end of its
range: the laws between fields are why an end is reached by changing its neighbours too.
"""

import dataclasses
import math
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.render.plan import RenderOptions
from infra.serving.train_model import TrainOptions
from infra.setup.generated_pages import ROOTS, reachable
from model.config import SIZES, ModelConfig
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.flows.forms import DatasetInRuns
from pipeline.generation.generate_options import CorePrice, RevisitOptions
from pipeline.presets.registry import preset_settings
from pipeline.presets.settings import GivenCamera, RevisitSettings
from pipeline.renders.settings import MAX_SPP, RenderSettings
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.rooms import SharedRoom, SideRanges
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.settings import MAX_TRIANGLES, Excursion, SceneSettings
from storage.dataset.settings import ListedShard
from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS, laid_out
from storage.records.scene import MAP_ARRAYS, MAX_TEXTURES, Scene
from storage.records.texture import CONSTANT
from storage.settings.fields import FieldDescription, array_scalar, describe_fields
from storage.settings.ranges import Within
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.scenes_by_hand import FLOOR, LIGHT, tiny_scene
from tests.textured_by_hand import bumpy_scene
from train.evaluation.options import EvaluationOptions, LeaderboardOptions
from train.presets import training_preset
from train.settings import TrainSettings, WatchSettings

End = Literal["low", "high"]

SMOKE = preset_settings("smoke")

FIELDS = [
    (settings, field)
    for settings in reachable(*(root for roots in ROOTS.values() for root in roots))
    if settings is not Scene
    for field in describe_fields(settings)
    if field.within is not None
]
"""Every declared range of settings."""


def _walk_settings(settings: Any) -> Iterator[Any]:
    """Yield settings, and those that their fields hold."""
    yield settings
    for field in dataclasses.fields(settings):
        if dataclasses.is_dataclass(value := getattr(settings, field.name)):
            yield from _walk_settings(value)


_FROM_PRESETS = {
    type(each): each
    for preset in (SMOKE, training_preset("smoke"), WatchSettings())
    for each in _walk_settings(preset)
}
_HAND_MADE: tuple[Any, ...] = (
    DatasetInRuns(), ONE_FAMILY_EACH[0], SharedRoom(), SideRanges(),
    dataclasses.replace(SMOKE.scenes.cameras, elevation_deg=(0.0, 60.0)),
    Excursion(axis="fov_deg", value=10.0, changes=()), ListedShard(split="train", scenes=4),
    RevisitOptions(dataset="a", out="b"),
    RevisitSettings(source_digest="", kept_cameras=4, lights="new", num_lights=2),
    GivenCamera(c2w=(0.0,) * 16, fov_deg=40.0),
    RenderOptions(source="a.json", out=Path("a.exr")), CorePrice(), TrainOptions(),
    SIZES["tiny"](), EvaluationOptions(checkpoint="a", data=("b",)),
    LeaderboardOptions(source="a", width=(64,)),
)  # fmt: skip
EXAMPLES: dict[type, Any] = {
    **{kind: _FROM_PRESETS[kind] for kind, _ in FIELDS if kind in _FROM_PRESETS},
    **{type(each): each for each in _HAND_MADE},
}
"""A valid value of every class that declares a range, but for `Scene`."""

_LINEAR = {"head": "linear", "dpt_features": 0, "dpt_channels": (), "dpt_taps": ()}
_HITS = {"view_stage": "hits", "hit_rays": 1, "hit_anchors": 8, "pixel_width": 8}
_PLANE = dataclasses.replace(ONE_FAMILY_EACH[0], num_objects=(0, 0), template="plane")
_EVERY = 10**9

BESIDE: dict[tuple[type, str, End], dict[str, Any]] = {
    (DatasetInRuns, "views", "low"): {"scenes_from": "a"},
    (DatasetInRuns, "views", "high"): {"scenes_from": "a"},
    (AssetSettings, "epsilon", "high"): {"gate": GateSettings(max_error_p99=1.0)},
    (SceneSettings, "max_triangles", "low"): {
        "families": (_PLANE,), "lights": LightSettings(count=(1, 1)),
    },
    (SceneSettings, "fill_to", "high"): {"max_triangles": MAX_TRIANGLES},
    (MaterialSettings, "roughness_log", "low"): {"roughness_bias": 0.0},
    (MaterialSettings, "roughness_bias", "high"): {"roughness_log": (1.0, 2.0)},
    (RevisitSettings, "kept_cameras", "low"): {"new_cameras": 1},
    (RevisitSettings, "new_cameras", "high"): {"kept_cameras": 0},
    (RenderSettings, "min_spp", "high"): {"max_spp": MAX_SPP},
    (RenderSettings, "max_spp", "low"): {"min_spp": 8},
    (TrainSettings, "resolution", "low"): {
        "model": dataclasses.replace(SIZES["smoke"](), patch_px=1)
    },
    (TrainSettings, "num_steps", "low"): {"warmup_steps": 0},
    (TrainSettings, "warmup_steps", "high"): {"num_steps": _EVERY},
    (TrainSettings, "log_every", "high"): {"validate_every": _EVERY, "checkpoint_every": _EVERY},
    (TrainSettings, "validate_every", "low"): {"log_every": 1},
    (TrainSettings, "checkpoint_every", "low"): {"log_every": 1},
    (ModelConfig, "width", "low"): {"num_heads": 1, "rope_num_freqs": 1},
    (ModelConfig, "width", "high"): {"num_heads": 512, "rope_num_freqs": 1},
    (ModelConfig, "num_heads", "high"): {"width": 512 * 18, "rope_num_freqs": 1},
    (ModelConfig, "rope_num_freqs", "high"): {"width": 18 * 64, "num_heads": 1},
    (ModelConfig, "decoder_layers", "low"): {"dpt_taps": (0, 0, 0, 0)},
    (ModelConfig, "patch_px", "low"): _LINEAR,
    (ModelConfig, "patch_px", "high"): _LINEAR,
    (ModelConfig, "dpt_features", "low"): _LINEAR,
    (ModelConfig, "dpt_taps", "high"): {"decoder_layers": 256},
    **{(ModelConfig, name, "high"): _LINEAR | _HITS
       for name in ("hit_rays", "hit_anchors", "gather_rays", "pixel_width", "filter_width",
                    "sky_rays", "denoise_from_px")},
}  # fmt: skip
"""What must stand beside an end."""


def at_end(settings: type, field: FieldDescription, end: End, number: Any) -> Any:
    """Return valid settings with one number of a field replaced; raises what they raise."""
    example, value = EXAMPLES[settings], number
    old = getattr(example, field.name)
    if field.shape == "pair":
        value = (number, old[1]) if end == "low" else (old[0], number)
    elif field.shape != "one":
        value = (*old[:-1], number) if end == "low" else (number, *old[1:])
    changes = {field.name: value}
    return dataclasses.replace(example, **(BESIDE.get((settings, field.name, end), {}) | changes))


every_end = pytest.mark.parametrize("end", ["low", "high"])
every_field = for_each(("settings", "field"), FIELDS)


def last_inside(field: FieldDescription, end: End) -> float:
    """Return the extreme number that a range admits."""
    within = field.within
    assert within is not None
    bound, is_open = getattr(within, end), getattr(within, f"{end}_open")
    if field.kind is int:
        assert isinstance(bound, int) and not is_open
        return bound
    return math.nextafter(bound, {"low": math.inf, "high": -math.inf}[end]) if is_open else bound


def first_outside(field: FieldDescription, end: End) -> float:
    """Return the next number beyond."""
    inside = last_inside(field, end)
    if field.kind is int:
        return inside + {"low": -1, "high": 1}[end]
    return math.nextafter(inside, {"low": -math.inf, "high": math.inf}[end])


@every_end
@every_field
def test_an_end_is_accepted_and_one_step_outside_refused_by_name(
    settings: type, field: FieldDescription, end: End
) -> None:
    at_end(settings, field, end, last_inside(field, end))
    number = first_outside(field, end)
    option = re.sub("_(db|deg|ev)$", "", field.name).replace("_", "-")
    with pytest.raises(TrilightError) as caught:
        at_end(settings, field, end, number)
    message = str(caught.value)
    assert f"{field.name} is " in message or f"--{option} is " in message
    assert f"expected {field.expected}." in message
    assert repr(number) in message and "\n" not in message


@every_field
def test_other_kinds_of_values_are_refused(settings: type, field: FieldDescription) -> None:
    wrong: list[Any] = [math.nan, math.inf, -math.inf, True, "1", (1, 2, 3) * 3]
    if field.kind is int:
        wrong.append(last_inside(field, "low") + 0.5)
    for value in wrong:
        with pytest.raises(TrilightError, match="expected"):
            at_end(settings, field, "low", value)
    if field.shape != "one":
        for value in ((), 1.0, [1.0, 2.0], None):
            if value == field.default:  # none at all, where that means what comes by itself
                continue
            with pytest.raises(TrilightError, match="expected"):
                dataclasses.replace(EXAMPLES[settings], **{field.name: value})


def _numbers(hint: Any) -> Iterator[bool]:
    """Yield for each number of a type whether a range is declared around it."""
    if get_origin(hint) is Annotated:
        inner, *notes = get_args(hint)
        declared = any(isinstance(note, Within) for note in notes)
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
        if name != "materials"  # whose columns have ranges
        if not all(_numbers(hint))
    ]
    assert undeclared == []


INTERNAL = {
    "PreviewSettings": "made of RenderOptions",
    "StorageSettings": "has no number",
    "BaseSettings": "has no number",
    "EvalConfig": "made of EvaluationOptions",
}
"""Settings that nobody writes, or without numbers."""


def _is_settings(name: str) -> bool:
    return name.endswith(("Settings", "GenerateOptions", "Config"))


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
    assert named - reached - set(INTERNAL) == {"GenerateOptions"}, "which DatasetInRuns is"
    assert set(EXAMPLES) == {settings for settings, _ in FIELDS}


DESCRIBED = {field.name: field for field in describe_fields(Scene)}
ARRAYS = [(name, field) for name, field in DESCRIBED.items() if field.within is not None] + [
    (column.name, dataclasses.replace(DESCRIBED["materials"], notes=[column.within]))
    for column, _ in laid_out(PUBLISHED_COLUMNS)
]
"""Every range of arrays, by the name of the array or of the columns of materials."""

PLACES: dict[str, Any] = {
    "vertex_positions": (1, 2), "vertex_normals": (0, 0), "faces": (1, 2), "material_index": 1,
    "object_index": 1, "c2w": (1, 0, 3), "fov_deg": 1,
    "uv": (1, 0), "material_textures": (FLOOR, 1), "normal_textures": FLOOR,
    "diffuse": (FLOOR, 1), "specular": (FLOOR, 4), "roughness": (FLOOR, 6), "emission": (LIGHT, 8),
}  # fmt: skip
"""One number of each array, and of each part of the materials."""


def _with(place: str, field: FieldDescription, number: Any) -> Scene:
    """Return a dark floor under a light, with one number of an array replaced."""
    scene = bumpy_scene() if field.name in MAP_ARRAYS else tiny_scene()
    scene.materials[FLOOR] = 0
    if field.name == "vertex_normals":
        scene.vertex_normals[0] = 0
    array: NDArray = getattr(scene, field.name).copy()
    array[PLACES[place]] = number
    changes: dict[str, Any] = {field.name: array}
    return dataclasses.replace(scene, **changes)


@every_end
@for_each(("place", "field"), ARRAYS)
def test_an_array_of_a_scene_may_reach_the_end_and_not_pass_it(
    place: str, field: FieldDescription, end: End
) -> None:
    """Ranges of integers are those of their types: nothing is beyond."""
    inwards = {"low": np.float32(np.inf), "high": np.float32(-np.inf)}[end]
    number: Any = getattr(field.within, end)
    at = PLACES[place]
    if issubclass(array_scalar(field.bare), np.floating):
        number = np.float32(number)
        inside, is_open = np.nextafter(number, inwards), getattr(field.within, f"{end}_open")
        # a normal's length, rounded to float32, is held to the same end by a law of its own
        _with(place, field, inside if is_open or place == "vertex_normals" else number).check()
        with np.errstate(over="ignore"):
            outside = number if is_open else np.nextafter(number, -inwards)
        index = ", ".join(map(str, at if isinstance(at, tuple) else (at,)))
        with pytest.raises(TrilightError, match=rf"{field.name}\[{index}\] is .*; expected"):
            _with(place, field, outside).check()
        return
    # What rows there are is a law between arrays; the range is that of the type.
    scene = _with(place, field, number)
    array = getattr(scene, field.name)
    ends = (0, np.iinfo(array.dtype).max)
    if field.name in ("material_textures", "normal_textures"):  # -1 stands for no texture
        ends = (CONSTANT, MAX_TEXTURES - 1)
    assert number == dict(zip(("low", "high"), ends, strict=True))[end]
    assert field.within is not None and field.within.holds(array).all()
    if end == "low":
        return
    with pytest.raises(TrilightError, match=rf"{field.name}\[.*{number}; expected .*rows below"):
        scene.check()
