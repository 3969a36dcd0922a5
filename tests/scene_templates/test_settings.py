"""Settings refuse contradictions, and name the field."""

import dataclasses
import itertools
import json
from typing import Any

import pytest

from scene_templates.cameras import CameraSettings
from scene_templates.families import Family
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.lights import LightSettings
from scene_templates.materials import MaterialSettings
from scene_templates.placement import PlacementSettings
from scene_templates.rooms import SharedRoom
from scene_templates.separate_sides import SideRanges
from scene_templates.settings import Excursion, SceneSettings, ViewLaws
from scene_templates.skies.draw import SkyMapSettings
from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.templates import TEMPLATES
from storage.errors import TrilightError
from storage.settings.changes import changed
from storage.settings.described import from_record, settings_record
from storage.settings.fields import describe_fields
from tests.for_each import for_each
from tests.scene_templates.balls import DEFAULTS, template_settings

GROUPS: dict[type, Any] = {
    CameraSettings: CameraSettings(),
    Family: ONE_FAMILY_EACH[0],
    LightSettings: LightSettings(),
    MaterialSettings: MaterialSettings(),
    PlacementSettings: PlacementSettings(),
    SceneSettings: DEFAULTS,
    SharedRoom: SharedRoom(),
    SideRanges: SideRanges(),
    SkyMapSettings: SkyMapSettings(),
    SurfaceMapSettings: SurfaceMapSettings(),
    ViewLaws: ViewLaws(),
}
"""An admissible value of every group."""

CONTRADICTIONS: list[tuple[type, str, Any]] = [
    (SceneSettings, "families", ()),
    (SceneSettings, "families", (ONE_FAMILY_EACH[0], ONE_FAMILY_EACH[0])),
    (SceneSettings, "max_triangles", 531),  # the open box 512, 8 emitters, 3 objects of 4: 532
    (SceneSettings, "centring", "middle"),
    (SceneSettings, "fill_to", 1537),
    (Family, "template", "cave"),
    (Family, "num_objects", (3, 1)),
    (PlacementSettings, "orientation", "quaternion"),
    (LightSettings, "total_emission", (5000.0, 2500.0)),
    (LightSettings, "orientation", "quaternion"),
    (MaterialSettings, "roughness_bias", 0.07),
    (MaterialSettings, "roughness_log", (0.0, 1.0)),
    (CameraSettings, "fov_deg", (30.0, 180.0)),
    (ViewLaws, "max_shell_back", 1.1),
    (SharedRoom, "raise_z", (0.1, -0.1)),
    (SideRanges, "shift_x", (0.25, -0.25)),
    (SkyMapSettings, "families", ()),
    (SkyMapSettings, "sun_to_sky", (2.0, 1.0)),
    (SurfaceMapSettings, "families", ()),
    (SurfaceMapSettings, "size", 100),
    (SurfaceMapSettings, "albedo", (0.5, 0.1)),
]
"""Laws between numbers, and words; the ends of every range are those of tests/extremes."""


def test_a_contradiction_is_one_line_that_names_its_field() -> None:
    for group, name, value in CONTRADICTIONS:
        try:
            dataclasses.replace(GROUPS[group], **{name: value})
        except TrilightError as error:
            assert name in str(error) and "\n" not in str(error), (group, name, value)
        else:
            pytest.fail(f"{group.__name__}.{name} = {value} was accepted")


@for_each(("kind", "name"), [(SkyMapSettings, "fog"), (SurfaceMapSettings, "gold")])
def test_a_family_of_maps_that_is_unknown_is_named(kind: type, name: str) -> None:
    with pytest.raises(TrilightError, match=f"^[^\n]*'{name}' is unknown"):
        kind(families=(name,))
    for field in describe_fields(kind):
        assert field.sentence.endswith(".")
        assert field.expected


RANGES = [
    f"{group.name}.{field.name}"
    for group in dataclasses.fields(DEFAULTS)
    if dataclasses.is_dataclass(settings := getattr(DEFAULTS, group.name))
    for field in dataclasses.fields(settings)
    if isinstance(getattr(settings, field.name), tuple)
]


def test_a_range_that_is_named_is_two_numbers() -> None:
    """A single number would silently take the other end from a default further down."""
    assert len(RANGES) == 12
    wrongs: list[list[Any]] = [[], [0.5], [1, 2, 3], [True, True], ["a", "b"]]
    for name, wrong in itertools.product(RANGES, wrongs):
        with pytest.raises(TrilightError, match=name.split(".")[1]):
            changed(DEFAULTS, {name: wrong})


def test_the_least_triangle_limit_depends_on_the_layouts_in_use() -> None:
    """Shell, eight emitters, and four triangles - a tetrahedron - for each of three objects."""
    for name, template in TEMPLATES.items():
        least = 128 * len(template.parts) + 8 + 3 * 4
        template_settings(name, {"max_triangles": least})
        with pytest.raises(TrilightError, match=f"at least {least} for {name}"):
            template_settings(name, {"max_triangles": least - 1})


def test_settings_are_plain_values_for_a_manifest() -> None:
    """Through JSON and back, every number is the same, and the settings are as they were."""
    stored = json.loads(json.dumps(dataclasses.asdict(DEFAULTS)))
    assert _rebuilt(DEFAULTS, stored) == DEFAULTS
    stored["lights"]["count"] = [2, 2]
    assert _rebuilt(DEFAULTS, stored) != DEFAULTS


def _rebuilt(like: Any, stored: Any) -> Any:
    """Settings of the kind of `like` from JSON values."""
    if dataclasses.is_dataclass(like) and not isinstance(like, type):
        names = [field.name for field in dataclasses.fields(like)]
        return dataclasses.replace(
            like, **{name: _rebuilt(getattr(like, name), stored[name]) for name in names}
        )
    if isinstance(like, tuple):
        return tuple(_rebuilt(old, new) for old, new in zip(like, stored, strict=True))
    return stored


def test_an_excursion_that_contradicts_the_settings_is_refused_at_once() -> None:
    """Not at the scene that it would make, which may be the last of many."""
    wrong = Excursion(axis="lights", value=0, changes=(("lights.count", (0, 0)),))
    with pytest.raises(TrilightError, match="count"):
        dataclasses.replace(DEFAULTS, excursions=(wrong,))
    unknown = Excursion(axis="lights", value=0, changes=(("lights.number", 1),))
    with pytest.raises(TrilightError, match="number"):
        dataclasses.replace(DEFAULTS, excursions=(unknown,))


def test_strata_are_refused_in_one_sentence() -> None:
    """They were parts of the scenes with weights; records never held the empty list."""
    strata = [{"name": "all", "weight": 1}]
    with pytest.raises(TrilightError, match=r"setting 'strata': removed since, and commit"):
        changed(DEFAULTS, {"strata": strata})
    with pytest.raises(TrilightError, match=r"setting 'strata': removed since, and commit"):
        from_record(SceneSettings, {**settings_record(DEFAULTS), "strata": strata})
