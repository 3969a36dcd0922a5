"""What triangles receive: closed forms for direct light, and energy for bounces."""

import numpy as np
import pytest

from model.hits.radiosity import BOUNCES, scene_light
from tests.model.hits.kit import FLOOR, LAMP, lit_scene
from tests.pipeline.renders.closed_forms import lambert_irradiance
from tests.pipeline.renders.scene_kit import box, join, light, material, quad


def test_direct_light_is_that_of_lamberts_formula() -> None:
    plate = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    scene = join([quad(plate, material(diffuse=0.5)), light(LAMP, 7.0)])
    got = scene_light(lit_scene(scene)).direct_2T3
    wanted = lambert_irradiance(np.zeros((1, 3)), np.array([0, 0, 1.0]), np.array(LAMP), 7.0)
    # four points of a lamp that is seen under a few degrees
    assert got[0, :2].mean() == pytest.approx(float(wanted[0]) / np.pi, rel=0.05)
    assert not got[1, :2].any(), "the back of the plate is dark"


def test_a_closed_room_reflects_as_often_as_is_added_up() -> None:
    """Whatever leaves a wall arrives at another: with albedo a, sum of a^k for the bounces."""
    albedo = 0.5
    lamp = [[-0.2, -0.2, 0.1], [0.2, -0.2, 0.1], [0, 0.2, 0.1]]
    scene = lit_scene(join([box([0, 0, 0], 2.0, material(diffuse=albedo)), light(lamp, 10.0)]))
    found = scene_light(scene)
    inner = 1  # corners run counter-clockwise seen from outside
    walls = scene.area[:12, None]
    direct = (found.direct_2T3[inner, :12] * walls).sum()
    indirect = (found.indirect_2T3[inner, :12] * walls).sum()
    wanted = sum(albedo**k for k in range(1, BOUNCES + 1))
    # 12 triangles with 32 rays each, and a lamp that stands in the way of 2 % of them
    assert indirect / direct == pytest.approx(wanted, rel=0.1)
    assert not found.direct_2T3[0, :12].any(), "outside it is dark"


def test_the_unit_is_the_mean_light_and_never_zero() -> None:
    lamps = [light(LAMP, [8.0, 1e-3, 2.0])]
    parts = [quad(FLOOR, material(diffuse=0.5)), *lamps]
    unit = scene_light(lit_scene(join(parts))).mean_3
    assert unit[0] > unit[2] > unit[1] > 0
    assert unit[1] == pytest.approx(0.03 * unit[0])
