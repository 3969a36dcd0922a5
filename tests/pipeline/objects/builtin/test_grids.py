"""Built-in families that are one grid of vertices, with volumes that are known on paper."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.objects.builtin.gear import GearParams, gear
from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.superquadric import SuperquadricParams, superquadric
from pipeline.objects.builtin.torus_knot import TorusKnotParams, torus_knot
from pipeline.objects.builtin.vase import VaseParams, vase
from tests.for_each import for_each
from tests.pipeline.objects.builtin.test_builtin import volume


def _superquadric(profile: float, plan: float, **changes: float) -> Mesh:
    shape = {"taper": 0.0, "twist_rad": 0.0} | changes
    return superquadric(
        SuperquadricParams(
            exponent_profile=profile,
            exponent_plan=plan,
            half_sizes=(1.0, 0.8, 0.5),
            rings=63,
            columns=64,
            **shape,
        )
    )


@pytest.mark.parametrize(
    ("profile", "plan", "share", "tolerance"),
    [
        # Shares of the box: pi / 6, 1 / 6 and 1; inscribed polyhedra of 64 x 64 miss about 0.3 %,
        # and an exponent of 0.01 is a box but for 2 % of its edges.
        (1.0, 1.0, np.pi / 6, 0.004),
        (2.0, 2.0, 1 / 6, 0.004),
        (0.01, 0.01, 1.0, 0.02),
    ],
)
def test_superquadrics_have_known_volumes(
    profile: float, plan: float, share: float, tolerance: float
) -> None:
    expected = share * 2.0 * 1.6 * 1.0
    assert volume(_superquadric(profile, plan)) == pytest.approx(expected, rel=tolerance)


def test_twist_keeps_the_volume() -> None:
    plain, twisted = _superquadric(0.5, 0.5), _superquadric(0.5, 0.5, twist_rad=0.8)
    # Exactly so for the smooth surface; flat faces cut a little off the twisted one.
    assert volume(twisted) == pytest.approx(volume(plain), rel=0.005)


def _ring(windings: tuple[int, int], **changes: int) -> TorusKnotParams:
    return TorusKnotParams(
        windings=windings,
        minor_radius=0.4,
        fill=0.95,
        ribs=0,
        rib_depth=0.3,
        rib_turns=0,
        flatten=1.0,
        **({"segments": 256, "sides": 48} | changes),
    )


def test_the_unknot_is_a_torus_of_known_volume() -> None:
    positions, faces = torus_knot(_ring((1, 0)))
    tube = (np.ptp(positions[:, 2])) / 2
    centre = 1.4
    # Pappus: area of the section times the way of its centre; 48-gons miss 0.3 %.
    expected = np.pi * tube**2 * 2 * np.pi * centre
    assert volume((positions, faces)) == pytest.approx(expected, rel=0.005)


@for_each("windings", [(2, 3), (3, 2), (2, 5), (3, 4), (1, 5), (4, 3), (5, 2)])
def test_strands_of_a_knot_do_not_meet(windings: tuple[int, int]) -> None:
    params = _ring(windings, segments=240, sides=8)
    positions, _ = torus_knot(params)
    rings = positions.reshape(240, 8, 3)
    centre = rings.mean(axis=1)
    tube = np.linalg.norm(rings - centre[:, None], axis=2).max()
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    apart = np.abs(np.arange(240)[:, None] - np.arange(240)[None])
    apart = np.minimum(apart, 240 - apart)
    step = np.linalg.norm(centre - np.roll(centre, 1, axis=0), axis=1).min()
    far_along = apart * step > np.pi * tube
    assert distance[far_along].min() > 2 * tube * 0.99


def _gear(**changes: float) -> Mesh:
    shape = {
        "teeth": 12, "tooth_depth": 0.2, "half_thickness": 0.2, "chamfer": 0.0, "bore": 0.2,
        "hub_width": 0.1, "hub_height": 1.0, "rim_width": 0.15, "web_height": 1.0,
        "helix_rad": 0.0, "cone": 0.0,
    }  # fmt: skip
    return gear(GearParams(**(shape | changes)))  # type: ignore[arg-type]


def test_a_plain_gear_is_its_outline_times_its_thickness() -> None:
    mesh = _gear()
    tip = mesh[0].reshape(72, -1, 3)[:, 0, :2]
    x, y = tip.T
    outline = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    # The bore is a regular polygon of 72 corners.
    bore = 0.5 * 72 * 0.2**2 * np.sin(2 * np.pi / 72)
    assert volume(mesh) == pytest.approx(0.4 * (outline - bore), rel=1e-9)


def test_the_web_takes_material_away_and_the_hub_adds_some() -> None:
    assert volume(_gear(web_height=0.5)) < volume(_gear()) < volume(_gear(hub_height=1.5))


@pytest.mark.parametrize(
    "make", [lambda: _gear(helix_rad=0.3), lambda: _gear(cone=0.1, chamfer=0.03)]
)
def test_other_gears_stay_outward(make: Callable[[], Mesh]) -> None:
    assert 0.8 * volume(_gear()) < volume(make()) < 1.2 * volume(_gear())


def test_a_helix_turns_the_teeth_and_nothing_else() -> None:
    plain, turned = (_gear(helix_rad=angle)[0].reshape(72, 14, 3) for angle in (0.0, 0.3))
    inner = slice(2, 12)
    assert np.array_equal(plain[:, inner], turned[:, inner])
    assert not np.allclose(plain[:, 0], turned[:, 0])


def test_the_wall_of_a_vase_is_even() -> None:
    params = VaseParams(
        height=1.0, radii=(0.3, 0.5, 0.2, 0.4), wall=0.05, flutes=0, flute_depth=0.0,
        swirl_rad=0.0, rings=200, columns=8,
    )  # fmt: skip
    rings = vase(params)[0][:-2].reshape(400, 8, 3)
    radius, height = np.linalg.norm(rings[:, 0, :2], axis=1), rings[:, 0, 2]
    inner = slice(399, 199, -1)
    outside = np.interp(height[inner], height[:200], radius[:200])
    # Linear interpolation between 200 rings of a curve of unit height: 1e-4.
    np.testing.assert_allclose(outside - radius[inner], 0.05, atol=1e-4)


def test_a_straight_vase_is_a_cup_of_known_volume() -> None:
    params = VaseParams(
        height=1.0,
        radii=(0.5, 0.5, 0.5, 0.5),
        wall=0.05,
        flutes=0,
        flute_depth=0.3,
        swirl_rad=0.4,
        rings=16,
        columns=96,
    )
    polygon = 0.5 * 96 * np.sin(2 * np.pi / 96)
    expected = polygon * (0.5**2 * 1.0 - 0.45**2 * 0.95)
    assert volume(vase(params)) == pytest.approx(expected, rel=1e-9)
