"""Laws of every layout: objects, emitters, surfaces and cameras lie in their stated ranges."""

import math

import numpy as np
import pytest

from scene_templates.cameras import camera_rand
from scene_templates.layout import Layout, ObjectPlacement
from scene_templates.materials import surface_rand
from scene_templates.registry import TEMPLATES
from scene_templates.sectors import Sector
from scene_templates.settings import SceneSettings
from storage.errors import Rejected

SETTINGS = SceneSettings()
ROUNDING = 1e-9
"""Far above the 1e-15 of float64 sums of numbers about 1, far below anything that matters."""


def _layouts(name: str, count: int = 60) -> list[Layout]:
    return [
        TEMPLATES[name].layout_rand(np.random.default_rng(seed), SETTINGS, 1 + seed % 3)
        for seed in range(count)
    ]


@pytest.mark.parametrize("name", list(TEMPLATES))
def test_equal_generators_give_equal_layouts(name: str) -> None:
    first, again = _layouts(name, 5), _layouts(name, 5)
    for one, other in zip(first, again, strict=True):
        for a, b in zip(one.shell, other.shell, strict=True):
            assert np.array_equal(a.positions, b.positions)
            assert a.surface == b.surface
        for c, d in zip(one.objects, other.objects, strict=True):
            assert np.array_equal(c.centre, d.centre)
            assert np.array_equal(c.rotation, d.rotation)
            assert (c.radius, c.rests, c.surface) == (d.radius, d.rests, d.surface)
        for e, f in zip(one.emitters, other.emitters, strict=True):
            assert np.array_equal(e.triangle, f.triangle)
            assert e.radiance == f.radiance


@pytest.mark.parametrize("name", list(TEMPLATES))
def test_spheres_do_not_meet_nor_leave_the_room(name: str) -> None:
    for layout in _layouts(name):
        for row, placement in enumerate(layout.objects):
            low, high = (
                SETTINGS.single_object_scale if len(layout.objects) == 1 else SETTINGS.object_scale
            )
            assert low / 4 <= placement.radius <= high / 4
            assert np.abs(placement.centre).max() <= 0.75  # the lowest floor stands at -0.7
            for other in layout.objects[:row]:
                assert _gap(layout, placement, other) > -ROUNDING
            for part in layout.shell:
                plane = _plane(part.positions)
                assert plane @ np.append(placement.centre, 1) > placement.radius - ROUNDING


def _plane(positions: np.ndarray) -> np.ndarray:
    normal = np.cross(positions[-9] - positions[0], positions[8] - positions[0])
    normal /= np.linalg.norm(normal)
    return np.append(normal, -normal @ positions[0])


def _gap(layout: Layout, a: ObjectPlacement, b: ObjectPlacement) -> float:
    """Least distance of the spheres over eleven stages on the way down of those that rest."""
    gaps = []
    for s in np.linspace(0, 1, 11) if a.rests else [0.0]:
        for t in np.linspace(0, 1, 11) if b.rests else [0.0]:
            p = a.centre - s * layout.floor.height(a.centre) * layout.floor.normal
            q = b.centre - t * layout.floor.height(b.centre) * layout.floor.normal
            gaps.append(float(np.linalg.norm(p - q)) - a.radius - b.radius)
    return min(gaps)


def test_the_way_down_of_resting_objects_is_free() -> None:
    """Sizes that differ much: a large object could well be lowered onto a small one beside it."""
    settings = SceneSettings(object_scale=(0.2, 2.0))
    for seed in range(200):
        layout = TEMPLATES["plane"].layout_rand(np.random.default_rng(seed), settings, 2)
        assert _gap(layout, *layout.objects) > -ROUNDING


def test_about_half_of_the_objects_rest_and_their_spheres_touch_the_floor() -> None:
    rests = []
    for layout in _layouts("plane", 200):
        for placement in layout.objects:
            height = float(layout.floor.height(placement.centre))
            rests.append(placement.rests)
            if placement.rests:
                assert abs(height - placement.radius) < ROUNDING
            else:
                assert height > placement.radius - ROUNDING
    # 400 coin tosses have a standard deviation of 0.025. A resting object claims the way down, so
    # that arrangements with fewer of them fit more often: hence 0.4 and not five deviations.
    assert 0.4 < np.mean(rests) < 0.6


def test_objects_that_cannot_fit_are_rejected_with_a_reason() -> None:
    settings = SceneSettings(object_scale=(2.0, 2.0))
    with pytest.raises(Rejected) as caught:
        TEMPLATES["open_box"].layout_rand(np.random.default_rng(0), settings, 3)
    assert caught.value.reason == "no_room"


@pytest.mark.parametrize("name", list(TEMPLATES))
def test_emitters_hang_outside(name: str) -> None:
    counts = set()
    for layout in _layouts(name):
        counts.add(len(layout.emitters))
        total = sum(emitter.radiance for emitter in layout.emitters)
        assert 2500 <= total <= 5000
        reach = max(float(np.linalg.norm(part.positions, axis=1).max()) for part in layout.shell)
        for emitter in layout.emitters:
            centre = emitter.triangle.mean(axis=0)
            # At most 0.2 per axis from a point 2.1 to 2.7 from the origin.
            assert 2.1 - 0.2 * math.sqrt(3) < np.linalg.norm(centre) < 2.7 + 0.2 * math.sqrt(3)
            assert np.linalg.norm(centre) > min(reach, 1.7)
            assert layout.floor.height(centre) > 0
            edges = np.linalg.norm(emitter.triangle - np.roll(emitter.triangle, 1, axis=0), axis=1)
            assert (edges > 2.0 * 0.0707 * 0.999).all()
            assert (edges < 2.5 * 0.0708).all()
    assert counts == set(range(1, 9))


@pytest.mark.parametrize("name", list(TEMPLATES))
def test_emitters_keep_to_their_sector_and_apart(name: str) -> None:
    """Measured without jitter, as seen from the origin, on a sphere of radius 0.866."""
    settings = SceneSettings(target_jitter=0.0, num_lights=(8, 8))
    sector = TEMPLATES[name].lights
    for seed in range(50):
        layout = TEMPLATES[name].layout_rand(np.random.default_rng(seed), settings, 1)
        centres = np.array([emitter.triangle.mean(axis=0) for emitter in layout.emitters])
        towards = centres / np.linalg.norm(centres, axis=1, keepdims=True)
        apart = np.linalg.norm(towards[:, None] - towards[None], axis=-1) * math.sqrt(0.75)
        assert apart[np.triu_indices(8, 1)].min() > 0.3, seed
        azimuth_deg = np.degrees(np.arctan2(towards[:, 1], towards[:, 0]))
        off = np.abs((azimuth_deg - sector.azimuth_deg + 180) % 360 - 180)
        assert off.max() <= sector.half_width_deg + ROUNDING
        assert np.degrees(np.arcsin(towards[:, 2])).min() >= sector.elevation_deg[0] - ROUNDING


def test_surfaces_keep_their_energy_and_shares() -> None:
    rng = np.random.default_rng(0)
    surfaces = [surface_rand(rng, SETTINGS) for _ in range(4000)]
    for surface in surfaces:
        assert 0.9 <= surface.diffuse_scale + surface.specular <= 1 + ROUNDING
        assert 0 <= min(surface.diffuse_rgb)
        assert max(surface.diffuse_rgb) <= surface.diffuse_scale
        assert 0.01 <= surface.roughness <= 1
        assert surface.smooth or not surface.coloured
    # Five standard deviations of a share among 4000: one false alarm in two million.
    for share, expected in (
        (np.mean([surface.smooth for surface in surfaces]), 0.5),
        (np.mean([surface.coloured for surface in surfaces]), 0.25),
        # exp(U(ln 0.06, ln 1.055)) - 0.05 < 0.2 is U below ln(0.25 / 0.06) / ln(1.055 / 0.06).
        (
            np.mean([surface.roughness < 0.2 for surface in surfaces]),
            math.log(0.25 / 0.06) / math.log(1.055 / 0.06),
        ),
    ):
        assert abs(share - expected) < 5 * math.sqrt(expected * (1 - expected) / 4000)


def test_directions_are_uniform_by_solid_angle() -> None:
    sector = Sector(azimuth_deg=225, half_width_deg=45, elevation_deg=(3, 87))
    rng = np.random.default_rng(0)
    drawn = np.array([sector.direction_rand(rng) for _ in range(4000)])
    assert np.abs(np.linalg.norm(drawn, axis=1) - 1).max() < ROUNDING
    assert (drawn[:, :2] < ROUNDING).all()  # the quarter of -X and -Y
    low, high = math.sin(math.radians(3)), math.sin(math.radians(87))
    # Solid angle is even in z: mean (low + high) / 2, variance (high - low)^2 / 12.
    standard_error = (high - low) / math.sqrt(12 * 4000)
    assert abs(drawn[:, 2].mean() - (low + high) / 2) < 5 * standard_error


@pytest.mark.parametrize("name", list(TEMPLATES))
def test_cameras_stand_at_their_distance_and_look_near_the_origin(name: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = camera_rand(rng, SETTINGS, TEMPLATES[name].cameras)
        assert 30 <= pose.fov_deg <= 60
        eye, forward = pose.c2w[:3, 3], -pose.c2w[:3, 2]
        # The target is on the axis, 1.5 to 2.0 ahead, in the cube of the jitter.
        ahead = np.linspace(1.5, 2.0, 2001)[:, None] * forward + eye
        # Steps of 0.25 mm along the axis: half a step off at most.
        assert np.abs(ahead).max(axis=1).min() <= 0.2 + 2.5e-4
        assert eye[2] > -0.2  # above the highest floor, -0.375
        # Up within atan(0.1 sqrt 2 / 0.9) = 9 degrees of +Z, seen from the horizon or not.
        assert pose.c2w[2, 1] > 0 or abs(forward[2]) > 0.98
