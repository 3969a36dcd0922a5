"""Laws of every layout: objects, emitters, surfaces and cameras lie in their stated ranges.

Shells are flat, closed at their seams, and in the published families as published.
"""

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_templates.layout import Pose, ShellPart
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from scene_templates.rooms import (
    PATCH_FACES,
    SIDES,
    TOUCHING,
    Plane,
    SharedRoom,
    patch,
)
from scene_templates.sample_layout import sample_layout, scene_plan
from scene_templates.sample_material import MaterialSettings, sample_material
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.scene_templates.balls import (
    BALL,
    ROOMS,
    STILL,
    Ball,
    Drawn,
    drawn,
    one_drawn,
    template_settings,
)

ROUNDING = 1e-9
"""Far above the 1e-15 of float64 sums of numbers about 1, far below anything that matters."""


def _gaps(one: Drawn) -> list[float]:
    """Distances between the spheres of all pairs of objects; below 0 where they overlap."""
    poses = [placement.pose for placement in one.layout.objects]
    return [
        float(np.linalg.norm(a.centre - b.centre)) - a.radius - b.radius
        for a, b in itertools.combinations(poses, 2)
    ]


@functools.cache
def _sixty(name: str) -> list[Drawn]:
    return drawn(template_settings(name), 60)


@for_each("name", ROOMS)
def test_objects_do_not_meet_nor_leave_the_room(name: str) -> None:
    overlapping = 0
    for one in _sixty(name):
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
def test_emitters_hang_outside(name: str) -> None:
    for one in _sixty(name):
        shell = one.layout.shell
        reach = max(float(np.linalg.norm(part.positions, axis=1).max()) for part in shell)
        floor = Plane(shell[0].positions)
        for emitter in one.layout.emitters:
            centre = emitter.triangle.mean(axis=0)
            assert np.linalg.norm(centre) > min(reach, 1.7)
            assert floor.height(centre) > 0


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


def _shells(ranges: SharedRoom, name: str, count: int) -> list[tuple[ShellPart, ...]]:
    """Draw whole layouts without objects."""
    settings = template_settings(name, {"families.num_objects": [0, 0]})
    family = dataclasses.replace(settings.families[0], shell=ranges)
    settings = dataclasses.replace(settings, families=(family,))
    return [one.layout.shell for one in drawn(settings, count)]


@for_each(("ranges", "name"), itertools.product([SQUARE, LOOSE], ROOMS))
def test_parts_are_flat_patches_of_128_faces_that_face_the_room(
    ranges: SharedRoom, name: str
) -> None:
    for shell in _shells(ranges, name, 20):
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


@pytest.mark.parametrize("name", ["wall", "corner", "open_box"])
def test_in_square_rooms_walls_stand_exactly_on_the_floors_edge(name: str) -> None:
    for shell in _shells(SQUARE, name, 20):
        floor = shell[0].positions
        for wall in shell[1:]:
            foot = wall.positions[wall.positions[:, 2] < floor[:, 2].max() + SUM_ROUNDING]
            assert len(foot) == 9
            gaps = np.abs(foot[:, None] - floor[None]).max(axis=-1).min(axis=1)
            assert gaps.max() < SUM_ROUNDING


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
