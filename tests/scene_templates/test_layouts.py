"""Laws of every layout: objects, emitters, surfaces and cameras lie in their stated ranges."""

import math

import numpy as np
import pytest

from scene_templates.layout import Pose
from scene_templates.materials import MaterialSettings, sample_material
from scene_templates.placement import TOUCHING
from scene_templates.renderformer_v1 import stage_1_families
from scene_templates.rooms import plane_of
from scene_templates.sample_layout import sample_layout, scene_plan
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.scene_templates.balls import (
    BALL,
    Ball,
    Drawn,
    drawn,
    drawn_once,
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
        for row, a in enumerate(poses)
        for b in poses[:row]
    ]


def _sixty(name: str) -> list[Drawn]:
    return drawn_once(template_settings(name), 60)


@for_each("name", TEMPLATES)
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
                heights = plane_of(part.positions).height(one.points(row))
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
                assert plane_of(part.positions).height(one.points(row)).min() >= -TOUCHING


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
    with pytest.raises(Rejected) as caught:
        sample_layout(rng_for(0, "scene", 0, 0), settings, plan, [BALL] * 3)
    assert caught.value.reason == "no_room"
    overlapping = template_settings("open_box", {**changes, "placement.overlap_share": 1.0})
    assert len(one_drawn(overlapping, 0).layout.objects) == 3


@for_each("name", TEMPLATES)
def test_emitters_hang_outside(name: str) -> None:
    counts = set()
    for one in _sixty(name):
        layout = one.layout
        counts.add(len(layout.emitters))
        for channel in range(3):
            total = sum(emitter.radiance_rgb[channel] for emitter in layout.emitters)
            assert 2500 <= total <= 5000
        reach = max(float(np.linalg.norm(part.positions, axis=1).max()) for part in layout.shell)
        floor = plane_of(layout.shell[0].positions)
        for emitter in layout.emitters:
            centre = emitter.triangle.mean(axis=0)
            # At most 0.2 per axis from a point 2.1 to 2.7 from the origin.
            assert 2.1 - 0.2 * math.sqrt(3) < np.linalg.norm(centre) < 2.7 + 0.2 * math.sqrt(3)
            assert np.linalg.norm(centre) > min(reach, 1.7)
            assert floor.height(centre) > 0
            edges = np.linalg.norm(emitter.triangle - np.roll(emitter.triangle, 1, axis=0), axis=1)
            assert (edges > 2.0 * 0.0707 * 0.999).all()
            assert (edges < 2.5 * 0.0708).all()
    assert counts == set(range(1, 9))


@for_each("name", TEMPLATES)
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
