"""Settings refuse contradictions, and name the field.

Draws: named ones, rotations, layouts by index, and exact operations alone.
"""

import ast
import dataclasses
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from pipeline.presets.registry import preset_settings
from scene_templates.exact import cosine, dot, lerp, ramp, sine, smoothstep
from scene_templates.families import Family
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.placement import PlacementSettings
from scene_templates.recorded_sampler import RecordedSampler
from scene_templates.rooms import SharedRoom, SideRanges
from scene_templates.rotations import rotate_points, rotation_xyz, uniform_rotation
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_layout import scene_plan
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.settings import Excursion, SceneSettings, ViewLaws
from scene_templates.skies.procedural_skies import SkyMapSettings
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings
from scene_templates.templates import TEMPLATES
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings.described import from_record, settings_record
from storage.settings.fields import describe_fields
from storage.settings.overrides import apply_overrides
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.scene_templates.balls import DEFAULTS, ROOMS, template_settings
from tests.scene_templates.statistics import (
    drawn_values,
    implausible,
    require_plausible,
    stated_table,
)
from tests.scene_templates.test_distributions import rotation_table

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
    admissible: dict[type, Any] = {Family: ONE_FAMILY_EACH[0], SceneSettings: DEFAULTS}
    for group, name, value in CONTRADICTIONS:
        try:
            dataclasses.replace(admissible.get(group) or group(), **{name: value})
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


def test_the_least_triangle_limit_depends_on_the_layouts_in_use() -> None:
    """Shell, eight emitters, and four triangles - a tetrahedron - for each of three objects."""
    for name in ROOMS:
        least = 128 * len(TEMPLATES[name].parts) + 8 + 3 * 4
        template_settings(name, {"max_triangles": least})
        with pytest.raises(TrilightError, match=f"at least {least} for {name}"):
            template_settings(name, {"max_triangles": least - 1})


def test_an_excursion_that_contradicts_the_settings_is_refused_at_once() -> None:
    """Not at the scene that it would make, which may be the last of many."""
    for name, value in (("count", (0, 0)), ("number", 1)):
        wrong = Excursion(axis="lights", value=0, changes=((f"lights.{name}", value),))
        with pytest.raises(TrilightError, match=name):
            dataclasses.replace(DEFAULTS, excursions=(wrong,))


def test_strata_are_refused_in_one_sentence() -> None:
    """They were parts of the scenes with weights; records never held the empty list."""
    strata = [{"name": "all", "weight": 1}]
    with pytest.raises(TrilightError, match=r"setting 'strata': removed since, and commit"):
        apply_overrides(DEFAULTS, {"strata": strata})
    with pytest.raises(TrilightError, match=r"setting 'strata': removed since, and commit"):
        from_record(SceneSettings, {**settings_record(DEFAULTS), "strata": strata})


MANY = 1000


def _drawn() -> RecordedSampler:
    draws = RecordedSampler(rng_for(0, "named draws"))
    for _ in range(MANY):
        draws.uniform("number", -2.0, 5.0)
        draws.whole("count", 3, 9)
        draws.holds("it holds", 0.3)
        draws.choice("word", ("a", "b", "c"))
        draws.colour("colour", (0.1, 0.2, 0.3), (0.2, 0.9, 0.3))
        draws.shade("shade", (0, 0, 0), (1, 0.5, 0.1))
        draws.direction("direction", -30, 60)
    return draws


def test_each_is_distributed_as_stated_and_another_statement_would_be_noticed() -> None:
    made = _drawn().made
    table = stated_table(made)
    require_plausible(table)
    # a colour has three numbers, a direction a height and an azimuth
    assert len(table) == 4 + 3 + 1 + 2
    assert not implausible({"nothing": 1.0})
    wrong = {"number": (-2.0, 6.0), "count": (3, 10), "it holds": 0.45, "word": ("a", "b")}
    for name, stated in wrong.items():
        made = _drawn().made
        object.__setattr__(made[name], "stated", stated)
        assert implausible(stated_table(made)), name
    # Directions are unit vectors between the elevations.
    found = np.array(made["direction"].values)
    # one square root and two sines, each to a few units of 2e-16
    assert np.abs(np.square(found).sum(axis=1) - 1).max() < 4e-15
    elevation = np.degrees(np.arcsin(found[:, 2]))
    assert -30 <= elevation.min() < -28 and 58 < elevation.max() <= 60


def test_a_name_has_one_statement() -> None:
    """And drawn values are plain."""
    draws = RecordedSampler(rng_for(0, "x"))
    draws.uniform("number", 0, 1)
    with pytest.raises(ValueError, match="number"):
        draws.uniform("number", 0, 2)
    draws.colour("colour", (0, 0, 0), (1, 1, 1))
    draws.whole("count", 1, 1)
    found = drawn_values(draws)
    (colour,) = found["colour"]
    assert found["count"] == (1,) and isinstance(colour, list) and len(colour) == 3


def test_a_stream_leaves_what_is_drawn_after_it() -> None:
    def rest(taken: int) -> float:
        draws = RecordedSampler(rng_for(0, "x"))
        draws.stream().random(taken)
        return draws.uniform("number", 0, 1)

    assert rest(0) == rest(1000)


def test_uniform_rotations_are_proper_and_follow_the_haar_measure() -> None:
    """Those of a quaternion that is normalised from a cube instead of a Gaussian would not."""
    rng = np.random.default_rng(0)
    matrices = np.stack([uniform_rotation(rng) for _ in range(5000)])
    gram = np.einsum("nij,nkj->nik", matrices, matrices)
    # A handful of float64 operations: a few units of 2e-16.
    assert np.abs(gram - np.eye(3)).max() < 1e-14
    assert np.abs(np.linalg.det(matrices) - 1).max() < 1e-14
    require_plausible(rotation_table(matrices, euler=False))


def test_rotations_turn_about_x_then_y_then_z_and_to_the_left() -> None:
    rng = np.random.default_rng(2)
    for angles in rng.uniform(-180, 180, size=(50, 3)):
        x, y, z = (rotation_xyz(np.where(np.arange(3) == axis, angles, 0)) for axis in range(3))
        assert np.abs(rotation_xyz(angles) - z @ y @ x).max() < 1e-14
    turned = rotate_points(np.array([[1.0, 0, 0]]), rotation_xyz([0, 0, 90]))
    assert np.abs(turned - [[0, 1, 0]]).max() < 1e-15


def test_a_plan_depends_on_seed_and_index_alone() -> None:
    one = [scene_plan(DEFAULTS, seed=0, scene_index=index) for index in range(40)]
    again = [scene_plan(DEFAULTS, seed=0, scene_index=index) for index in reversed(range(40))]
    assert one == again[::-1]
    other = [scene_plan(DEFAULTS, seed=1, scene_index=index) for index in range(40)]
    assert sum(a == b for a, b in zip(one, other, strict=True)) < 10
    # What is not of the plan does not move it.
    finer = dataclasses.replace(DEFAULTS, max_triangles=4096, num_views=1, enough_error=0.0)
    assert [scene_plan(finer, seed=0, scene_index=index) for index in range(40)] == one


def test_families_in_turn_have_exactly_their_share() -> None:
    settings = SceneSettings(families=ONE_FAMILY_EACH, families_in_turn=True)
    names = [scene_plan(settings, seed=5, scene_index=i).family.name for i in range(200)]
    assert names[:4] == ["plane", "wall", "corner", "open_box"]
    assert set(Counter(names).values()) == {50}
    drawn = dataclasses.replace(settings, families_in_turn=False)
    names = [scene_plan(drawn, seed=5, scene_index=i).family.name for i in range(200)]
    assert set(Counter(names).values()) != {50}


@pytest.mark.parametrize("turns", [1, 3])
def test_every_excursion_meets_every_family_equally_often(turns: int) -> None:
    """Were both to turn with the index, 37 and 4 would still meet; 36 and 4 would not."""
    settings = preset_settings("out-of-range").scenes
    for count in (37, 36):
        chosen = dataclasses.replace(settings, excursions=settings.excursions[:count])
        found = Counter(
            (chosen.excursion_of(i), scene_plan(chosen, seed=0, scene_index=i).family.name)
            for i in range(4 * count * turns)
        )
        assert len(found) == 4 * count
        assert set(found.values()) == {turns}


def test_sine_and_cosine_are_those_of_the_library_and_easing_has_no_kink() -> None:
    # a folded angle is off by half an ulp of pi, 2.2e-16, and a dozen products round as much again
    angles = np.linspace(-math.pi, math.pi, 20001)
    assert np.abs(sine(angles) - np.sin(angles)).max() < 1e-15
    assert np.abs(cosine(angles) - np.cos(angles)).max() < 1e-15
    assert float(sine(0.0)) == 0
    assert smoothstep([-1, 0, 0.5, 1, 2]).tolist() == [0, 0, 0.5, 1, 1]
    slope = np.diff(smoothstep(np.linspace(0, 1, 1001)))
    # 3 s^2 of a first step of a thousandth: no kink at either end
    assert slope[0] < 4e-6 and slope[-1] < 4e-6 and (slope > 0).all()
    assert ramp([-2, -0.5, 0, 0.25, 0.5, 2]).tolist() == [0, 0, 0.5, 0.75, 1, 1]
    assert lerp([0.0, 2.0], [1.0, 4.0], 0.5).tolist() == [0.5, 3.0]
    assert float(dot(np.array([1.0, 2, 3]), np.array([4.0, 5, 6]))) == 32


INEXACT = set(
    "sin cos tan exp log log2 log10 power float_power arctan2 arccos arcsin hypot cbrt einsum "
    "matmul linalg uniform normal standard_normal exponential pow fsum exp2 expm1 log1p".split()
)
"""Functions whose last bit depends on the processor or on the order in which a library sums."""


def test_maps_are_made_of_exact_operations_alone() -> None:
    """`draws.uniform`, of ours, is exact; everything else of that name belongs to numpy."""
    folder = ROOT / "scene_templates"
    sources = {*(folder / "surfaces").glob("*.py"), *(folder / "skies").glob("*.py")}
    assert len(sources) > 5
    found = []
    for path in (*sources, folder / "exact.py", folder / "recorded_sampler.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow | ast.MatMult):
                whole = isinstance(node.left, ast.Constant) or ast.unparse(node.left).isupper()
                if isinstance(node.op, ast.MatMult) or not whole:
                    found.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
            if isinstance(node, ast.Attribute) and node.attr in INEXACT:
                if ast.unparse(node.value) not in ("draws", "self"):
                    found.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
    assert not found
