"""Settings refuse contradictions, and name the field; layouts keep the ranges that they state.

Draws: named ones, rotations, layouts by index, and exact operations alone. Objects, emitters,
surfaces and cameras lie in their stated ranges; shells are flat, closed at their seams, and in the
published families as published.
"""

import ast
import dataclasses
import itertools
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.presets.registry import preset_settings
from scene_templates.exact import cosine, dot, lerp, ramp, sine, smoothstep
from scene_templates.families import Family
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.layout import Pose
from scene_templates.placement import PlacementSettings
from scene_templates.recorded_sampler import RecordedSampler
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from scene_templates.rooms import (
    PATCH_FACES,
    SIDES,
    TOUCHING,
    Plane,
    SharedRoom,
    SideRanges,
    patch,
)
from scene_templates.rotations import rotate_points, rotation_xyz, uniform_rotation
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_layout import sample_layout, scene_plan
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings, sample_material
from scene_templates.settings import Excursion, SceneSettings, ViewLaws
from scene_templates.skies.procedural_skies import SkyMapSettings
from scene_templates.surfaces.procedural_textures import SurfaceMapSettings
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected, TrilightError
from storage.seeds import rng_for
from storage.settings.described import from_record, settings_record
from storage.settings.fields import describe_fields
from storage.settings.overrides import apply_overrides
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.scene_templates.balls import (
    BALL,
    DEFAULTS,
    ROOMS,
    STILL,
    Ball,
    Drawn,
    drawn,
    one_drawn,
    template_settings,
)
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
        one_line = rf"\A[^\n]*{name}[^\n]*\Z"
        with case((group, name, value)), pytest.raises(TrilightError, match=one_line):
            dataclasses.replace(admissible.get(group) or group(), **{name: value})


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


def _drawn() -> RecordedSampler:
    draws = RecordedSampler(rng_for(0, "named draws"))
    for _ in range(1000):
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
    assert len(sources) == 5
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


ROUNDING = 1e-9
"""Far above the 1e-15 of float64 sums of numbers about 1, far below anything that matters."""


def _gaps(one: Drawn) -> list[float]:
    """Distances between the spheres of all pairs of objects; below 0 where they overlap."""
    poses = [placement.pose for placement in one.layout.objects]
    return [
        float(np.linalg.norm(a.centre - b.centre)) - a.radius - b.radius
        for a, b in itertools.combinations(poses, 2)
    ]


@for_each("name", ROOMS)
def test_objects_do_not_meet_nor_leave_the_room_and_emitters_hang_outside(name: str) -> None:
    overlapping = 0
    for one in drawn(template_settings(name), 60):
        if one.plan.overlaps:
            overlapping += min(_gaps(one), default=1.0) < 0
        else:
            assert min(_gaps(one), default=1.0) > 0
        low, high = one.plan.family.object_scale
        assert len(one.layout.objects) == one.plan.num_objects
        for row, placement in enumerate(one.layout.objects):
            assert low / 4 <= placement.pose.radius <= high / 4
            assert np.abs(placement.pose.centre).max() <= 0.75  # the lowest floor stands at -0.7
            for part in one.layout.shell:
                heights = Plane(part.positions).height(one.points(row))
                assert heights.min() >= -TOUCHING
        shell = one.layout.shell
        reach = max(float(np.linalg.norm(part.positions, axis=1).max()) for part in shell)
        floor = Plane(shell[0].positions)
        for emitter in one.layout.emitters:
            centre = emitter.triangle.mean(axis=0)
            assert np.linalg.norm(centre) > min(reach, 1.7)
            assert floor.height(centre) > 0
    # One scene in ten may overlap, and those of two or three objects mostly do: else the branch
    # above has never been taken, and proves nothing.
    assert overlapping > 0


def test_objects_keep_inside_of_parts_that_lean_and_stand_apart() -> None:
    """Published shells are tilted by up to 10 degrees and moved each by itself, and the range that
    centres are drawn from knows nothing of that: every point is asked."""
    families = [one for one in stage_1_families("de-biased") if one.template == "corner"]
    for one in drawn(SceneSettings(families=tuple(families)), 60):
        for row in range(one.plan.num_objects):
            for part in one.layout.shell:
                assert Plane(part.positions).height(one.points(row)).min() >= -TOUCHING


def test_a_shape_decides_what_meets() -> None:
    """With shapes that never meet, spheres overlap: nothing but `meets` keeps objects apart."""

    class Ghost(Ball):
        def overlaps(self, pose: object, other: object, its_pose: object) -> bool:
            return False

    settings = template_settings("plane", {"families.num_objects": [3, 3]})
    ghosts = drawn(settings, 40, shape=Ghost())
    assert sum(min(_gaps(one)) < 0 for one in ghosts) > 20


def test_the_largest_object_is_placed_first() -> None:
    """A small one finds room beside a large one more often than the other way round."""
    later_is_smaller = []

    class Watched(Ball):
        def overlaps(self, pose: Pose, other: Ball, its_pose: Pose) -> bool:
            later_is_smaller.append(pose.radius <= its_pose.radius)
            return super().overlaps(pose, other, its_pose)

    changes = {"families.num_objects": [3, 3], "placement.overlap_share": 0.0}
    drawn(template_settings("plane", changes), 20, shape=Watched())
    assert len(later_is_smaller) >= 60 and all(later_is_smaller)


def test_objects_that_cannot_fit_are_rejected_with_a_reason() -> None:
    changes = {"families.object_scale": [2.0, 2.0], "families.num_objects": [3, 3]}
    settings = template_settings("open_box", {**changes, "placement.overlap_share": 0.0})
    plan = scene_plan(settings, seed=0, scene_index=0)
    with pytest.raises(Rejected, match="^no_room: "):
        sample_layout(rng_for(0, "scene", 0, 0), settings, plan, [BALL] * 3)
    overlapping = template_settings("open_box", {**changes, "placement.overlap_share": 1.0})
    assert len(one_drawn(overlapping, 0).layout.objects) == 3


@for_each("name", ROOMS)
def test_emitters_keep_to_their_sector_and_apart(name: str) -> None:
    """Measured without jitter, as seen from the origin, on a sphere of radius 0.866."""
    settings = template_settings(name, {"lights.target_jitter": 0.0, "lights.count": [8, 8]})
    sector = TEMPLATES[name].lights
    for seed, one in enumerate(drawn(settings, 20)):
        centres = np.array([emitter.triangle.mean(axis=0) for emitter in one.layout.emitters])
        towards = centres / np.linalg.norm(centres, axis=1, keepdims=True)
        apart = np.linalg.norm(towards[:, None] - towards[None], axis=-1) * math.sqrt(0.75)
        assert apart[np.triu_indices(8, 1)].min() > 0.3, seed
        azimuth_deg = np.degrees(np.arctan2(towards[:, 1], towards[:, 0]))
        off = np.abs((azimuth_deg - sector.azimuth_deg + 180) % 360 - 180)
        assert off.max() <= sector.half_width_deg + ROUNDING
        assert np.degrees(np.arcsin(towards[:, 2])).min() >= sector.elevation_deg[0] - ROUNDING


def test_surfaces_keep_their_energy() -> None:
    rng = np.random.default_rng(0)
    settings = MaterialSettings(coloured_specular_share=0.5)
    tinted = 0
    for _ in range(4000):
        surface = sample_material(rng, settings, smooth_share=0.5, kind="object")
        specular = max(surface.specular_rgb)
        assert surface.diffuse_scale + specular <= 1 + ROUNDING
        assert 0 <= min(*surface.diffuse_rgb, *surface.specular_rgb)
        assert max(surface.diffuse_rgb) <= surface.diffuse_scale
        assert 0.01 <= surface.roughness <= 1
        assert surface.smooth or surface.colours == "one"
        if len(set(surface.specular_rgb)) == 1:
            assert surface.diffuse_scale + specular >= 0.9 - ROUNDING
        else:
            tinted += 1
    # Five standard deviations of a share of one half among 4000: 160.
    assert abs(tinted - 2000) < 160


SUM_ROUNDING = 1e-12
"""Coordinates about 1 after ten float64 operations are good to 1e-15; a thousand times that."""

SQUARE = SharedRoom(square_share=1.0)
LOOSE = SharedRoom(square_share=0.0)


def _corner_normals(
    positions: NDArray[np.float64], faces: NDArray[np.uint32] = PATCH_FACES
) -> NDArray[np.float64]:
    corners = positions[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@for_each(("ranges", "name"), itertools.product([SQUARE, LOOSE], ROOMS))
def test_parts_are_flat_patches_of_128_faces_toward_the_room(ranges: SharedRoom, name: str) -> None:
    """In square rooms, walls stand exactly on the floor's edge."""
    settings = template_settings(name, {"families.num_objects": [0, 0]})
    family = dataclasses.replace(settings.families[0], shell=ranges)
    for one in drawn(dataclasses.replace(settings, families=(family,)), 20):
        shell = one.layout.shell
        assert [part.name for part in shell] == list(TEMPLATES[name].parts)
        for part in shell:
            assert part.positions.shape == (81, 3)
            assert part.faces.shape == (128, 3)
            normals = _corner_normals(part.positions)
            plane = Plane(part.positions)
            assert np.abs(plane.height(part.positions)).max() < SUM_ROUNDING
            assert (np.einsum("ti,i->t", normals, plane.normal) > 0).all()
            # The room's middle is at most 0.125 from the origin, its sides at least 0.375.
            assert plane.height(np.zeros(3)) > 0.2
        floor = shell[0].positions
        for wall in shell[1:] if ranges is SQUARE else ():
            foot = wall.positions[wall.positions[:, 2] < floor[:, 2].max() + SUM_ROUNDING]
            assert len(foot) == 9
            gaps = np.abs(foot[:, None] - floor[None]).max(axis=-1).min(axis=1)
            assert gaps.max() < SUM_ROUNDING


def test_the_nominal_room_is_the_unit_cube_and_a_quarter_spin_swaps_the_diagonals() -> None:
    for side in SIDES.values():
        positions = patch(side, STILL)
        assert np.array_equal(positions[:, side.axis], np.full(81, 0.5 * side.sign))
        for axis in {0, 1, 2} - {side.axis}:
            assert (positions[:, axis].min(), positions[:, axis].max()) == (-0.5, 0.5)
    plain = patch(SIDES["floor"], STILL)
    spun = patch(SIDES["floor"], dataclasses.replace(STILL, rotation_deg=(0, 0, 90)))
    order, spun_order = np.lexsort(plain.round(9).T), np.lexsort(spun.round(9).T)
    assert np.abs(plain[order] - spun[spun_order]).max() < SUM_ROUNDING

    def diagonals(positions: NDArray[np.float64]) -> set[tuple[float, ...]]:
        middle = (positions[PATCH_FACES[:, 0]] + positions[PATCH_FACES[:, 2]]) / 2
        along = positions[PATCH_FACES[:, 2]] - positions[PATCH_FACES[:, 0]]
        # Of the edges from corner 0 to corner 2 only the diagonals are oblique.
        oblique = np.abs(along[:, 0] * along[:, 1]) > SUM_ROUNDING
        signed = np.sign(along[:, 0] * along[:, 1])
        rows = np.column_stack([middle, signed])[oblique].round(9) + 0.0
        return {tuple(row) for row in rows.tolist()}

    assert not diagonals(plain) & diagonals(spun)


@for_each(("ranges", "name"), itertools.product([SQUARE, LOOSE], ["wall", "corner", "open_box"]))
def test_nothing_shines_through_the_seams(ranges: SharedRoom, name: str) -> None:
    """From the middle of the room, a look at any point near a seam meets a floor or wall."""
    for seed in range(60):
        room = ranges.sample_room(np.random.default_rng(seed), TEMPLATES[name].parts)
        rng = np.random.default_rng([seed, 1])
        middle = (room.low + room.high) / 2
        for part in TEMPLATES[name].parts[1:]:
            points = _near_seam(rng, room.low, room.high, part)
            hit = np.any([_meets(middle, points - middle, one) for one in room.positions], axis=0)
            assert hit.all(), (seed, part)


def _near_seam(
    rng: np.random.Generator, low: NDArray[np.float64], high: NDArray[np.float64], part: str
) -> NDArray[np.float64]:
    """Points on the foot of a wall, up to 1 cm above it, inside the ends of the seam."""
    points = rng.uniform(low, high, size=(200, 3))
    side = SIDES[part]
    points[:, side.axis] = (high if side.sign > 0 else low)[side.axis]
    points[:, 2] = low[2] + rng.uniform(0, 0.01, size=len(points))
    along = 1 - side.axis
    # A seam's open end belongs to no second part; a tilt may take 2 tan(3 deg) of it away.
    inset = 0.9 * (high - low)[along] / 2
    points[:, along] = np.clip(points[:, along], -inset, inset)
    return points


def _meets(
    eye: NDArray[np.float64], toward: NDArray[np.float64], positions: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether rays meet the parallelogram of a patch."""
    origin, u, v = positions[0], positions[-9] - positions[0], positions[8] - positions[0]
    solved = np.linalg.solve(
        np.stack([np.broadcast_to(u, toward.shape), np.broadcast_to(v, toward.shape), -toward], -1),
        np.broadcast_to(eye - origin, toward.shape)[..., None],
    )[..., 0]
    inside = (solved[:, :2] >= -SUM_ROUNDING) & (solved[:, :2] <= 1 + SUM_ROUNDING)
    return inside.all(axis=1) & (solved[:, 2] > 0)


@pytest.mark.parametrize("policy", ["original", "de-biased"])
def test_boxes_turn_one_wall_away_as_published_and_patches_are_exact(policy: Policy) -> None:
    """The normal of each face, against the direction to the middle of the nominal room."""
    seen = set()
    for family in (*stage_1_families(policy), *stage_2_families(policy)):
        for part in one_drawn(SceneSettings(families=(family,)), 0).layout.shell:
            if family.template == "open_box":
                normals = _corner_normals(part.positions, part.faces)
                inward = np.einsum("tk,k->t", normals, Plane(part.positions).normal)
                turned_away = part.name == "wall2" and policy == "original"
                assert ((inward < 0) == turned_away).all()
            if "patch" in family.name:
                assert np.array_equal(part.positions, patch(SIDES[part.name], STILL))
                assert (np.abs(part.positions[:, SIDES[part.name].axis]) == 0.5).all()
                seen.add((family.template, part.name))
    assert len(seen) == 3 + 4 + 2  # parts of corner, box and wall
